"""Which corners of a rig are near enough: those of each camera by the scale of its own residuals.

One scale for all would be that of no camera where one states its noise wrongly, or fits the rig worse than the others do.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.refine import robust_scale_px
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.robust import LEAST_SCALE_PX, own_scale
from omnilines.calibration.thresholds import RobustThresholds
from omnilines.least_squares import Loss
from omnilines.least_squares.losses import LossFunction
from omnilines.least_squares.variance import variance_factor

LEAST_SIGMA_PX = 1e-4
"""Corners are never weighted as better than this: of exact ones, rounding alone would decide the weights."""

SPREAD = 1.166
"""Standard deviation of a scale that the median of n normal values tells, in units of the scale over the root of n."""


@dataclass(frozen=True)
class CornerNoise:
    """Standard deviations per axis of a camera's corners of mean weight."""

    sigma_px: float
    """By which they are weighted: never better than they are stated to be. What a detector leaves unmodelled is alike in
    neighbours, so that residuals do not show all of it, and many corners do not average it out."""
    found_px: float
    """As the residuals of the camera alone show it."""
    stated_px: float
    """0 where nothing is."""

    @staticmethod
    def of(squares_px2: float, freedom: int, stated_px2: float | None, significance: float) -> "CornerNoise":
        """Of a sum of squared residuals with so many degrees of freedom."""
        factor = variance_factor(squares_px2, freedom, stated_px2, significance)
        sigma_px = max(math.sqrt(factor.value), LEAST_SIGMA_PX)
        return CornerNoise(sigma_px, math.sqrt(squares_px2 / freedom), math.sqrt(stated_px2 or 0.0))


@dataclass(frozen=True, eq=False)
class Scales:
    """Of the whitened residuals of each member."""

    scale: Float[Tensor, " m"]
    beside_alone: float
    """Of all residuals over those of each camera alone: 1 where corners fit the rig as well."""
    noise: tuple[CornerNoise, ...]

    @staticmethod
    def alone(noise: tuple[CornerNoise, ...]) -> "Scales":
        """Where corners fit the rig as well as each camera alone."""
        return Scales(_alone(noise), 1.0, noise)

    @staticmethod
    def of(
        residual: Float[Tensor, "n 2"],
        points: RigPoints,
        noise: tuple[CornerNoise, ...],
        thresholds: RobustThresholds,
    ) -> "Scales":
        """As whitened residuals show them, with the standard deviation of that; of members without a corner as alone."""
        scale, member = _alone(noise), points.camera[points.view]
        beside_alone = robust_scale_px(residual / scale[member, None], thresholds.many_unknowns_share)
        for k in torch.unique(member).tolist():
            own = residual[member == k]
            found = robust_scale_px(own, thresholds.many_unknowns_share) * (1 + SPREAD / math.sqrt(own.numel()))
            scale[k] = max(found, LEAST_SCALE_PX)
        return Scales(scale, max(beside_alone, LEAST_SCALE_PX), noise)

    def limits(self, points: RigPoints, reject_sigma: float) -> Float[Tensor, " n"]:
        """Length of the whitened residual of each corner beyond which it is rejected (`robust.own_scale`)."""
        member = points.camera[points.view]
        sigma_px = torch.tensor([own.sigma_px for own in self.noise], dtype=torch.float64)
        stated = torch.tensor([own.stated_px for own in self.noise], dtype=torch.float64) / sigma_px
        weight = points.weight * sigma_px[member]
        return reject_sigma * own_scale(self.scale[member], torch.minimum(self.scale, stated)[member], weight)

    def loss(self, name: str, points: RigPoints, loss_scale: float) -> LossFunction:
        """Of the squared whitened residuals of corners, scaled by those of their cameras alone, and by how much all are larger:
        what cameras contradict each other in would go to and fro between scales of their own."""
        scale = loss_scale * self.beside_alone * _alone(self.noise)[points.camera[points.view]]
        variance, loss = scale.square(), Loss(name)

        def scaled(squares: Tensor) -> tuple[Tensor, Tensor]:
            cost, weight = loss(squares / variance)
            return cost * variance, weight

        return scaled


def _alone(noise: tuple[CornerNoise, ...]) -> Float[Tensor, " m"]:
    return torch.tensor([max(own.found_px / own.sigma_px, LEAST_SCALE_PX) for own in noise], dtype=torch.float64)
