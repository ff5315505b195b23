"""What every cost of a line against its observed arcs has in common.

A cost is a residual r of the normal M of the line's projection plane (camera frame, any length) and of the end bearings of the
arc; r does not depend on the length of M. From r and d r / d M all Jacobians follow by the chain rule through
`LineChart.projection_normal`, and d r / d bearings by automatic differentiation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines.geometry.line_chart import LineChart

CostFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(end bearings (n, 2, 3), M (n, 3)) -> residuals (n, m) and d r / d M (n, m, 3)."""
NODES = 3
"""Places along the image of each arc at which costs integrate."""


@dataclass(frozen=True)
class ArcNodes:
    """Places along the image of each arc at which an integral over its pixel length is evaluated (Gauss-Legendre)."""

    share: Float[Tensor, " k"]
    """Of the way from the first end bearing to the second along the great circle."""
    by_pixel: Float[Tensor, "n k 3 2"]
    """d bearing / d pixel."""
    length_px: Float[Tensor, "n k"]
    """Weight of each node; the weights of an arc add up to its length in the image."""


@runtime_checkable
class ObservedArcs(Protocol):
    """What a cost needs to know of n observed arcs."""

    @property
    def bearings(self) -> Float[Tensor, "n 2 3"]:
        """End bearings, unit, camera frame."""
        ...

    @property
    def by_pixel(self) -> Float[Tensor, "n 2 3 2"]:
        """d bearing / d pixel of both ends."""
        ...

    @property
    def covariance_px2(self) -> Float[Tensor, "n 2 2 2"]:
        """Of both end points."""
        ...

    @property
    def nodes(self) -> ArcNodes | None:
        """Places along the arcs, where they are known."""
        ...


def scaled_distance(
    bearings: Float[Tensor, "n k 3"], spread: Float[Tensor, "n k 3 3"], normal: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k 3"]]:
    """h = V . M / w with w^2 = M' B M, and d h / d M = V' / w - h (B M)' / w^2.

    With B = J J' of d bearing / d pixel J, h is the distance in pixels from the line's image, to first order; with B = J Sigma J'
    it is in standard deviations.
    """
    m = normal[:, None, :, None]
    across = spread @ m
    width2 = (m.mT @ across)[..., 0, 0]
    width = width2.sqrt()
    h = (bearings[..., None, :] @ m)[..., 0, 0] / width
    return h, bearings / width[..., None] - (h / width2)[..., None] * across[..., 0]


def plane_distance(
    rows: Float[Tensor, "n m 3"], normal: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m 3"]]:
    """r = F Mh and d r / d M = (F - r Mh') / |M|."""
    length = normal.norm(dim=-1, keepdim=True)
    unit = normal / length
    r = (rows @ unit[..., None])[..., 0]
    return r, (rows - r[..., None] * unit[:, None]) / length[..., None]


def _themselves(bearings: Tensor) -> Tensor:
    return bearings


@dataclass(frozen=True)
class ScaledRows:
    """Two residuals r_a = F_a . M / w_a: what the compiled engine takes."""

    rows: Callable[[Tensor], Tensor] = _themselves
    """F (n, 2, 3) from the end bearings (n, 2, 3)."""
    spread: Callable[[Tensor, Tensor], Tensor] | None = None
    """B (n, 2, 3, 3) with w_a^2 = M' B_a M, from d bearing / d pixel (n, 2, 3, 2) and the covariance of the end points in px^2
    (n, 2, 2, 2); without one w = |M|."""

    def of_arcs(self, arcs: ObservedArcs) -> CostFunction:
        """The cost of observed arcs."""
        own = arcs.bearings
        rows_of_own = self.rows(own)
        spread = None if self.spread is None else self.spread(arcs.by_pixel, arcs.covariance_px2)

        def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
            rows = rows_of_own if bearings is own else self.rows(bearings)
            return plane_distance(rows, normal) if spread is None else scaled_distance(rows, spread, normal)

        return evaluate


@dataclass(frozen=True)
class Cost:
    """A cost, and what the adjustment has to know of it."""

    of_arcs: Callable[[ObservedArcs], CostFunction]
    scaled_rows: ScaledRows | None = None
    """The same for the compiled engine; costs without are adjusted by the general one."""
    distances_in: Literal["px", "sigma"] | None = None
    """Unit of residuals that are the distances of both ends from the image of the line, pixels or their own standard deviations:
    these have no other weights, which would have to be held while cameras move."""
    integrates: bool = False
    """Whether it asks for the `ArcNodes` of arcs."""

    @property
    def is_whitened(self) -> bool:
        """Whether residuals have unit variance for the stated noise."""
        return self.distances_in == "sigma"

    @staticmethod
    def of_rows(scaled_rows: ScaledRows, distances_in: Literal["px", "sigma"] | None = None) -> "Cost":
        """A cost in the form that the compiled engine takes."""
        return Cost(scaled_rows.of_arcs, scaled_rows, distances_in)


def mixed_distances(mix: Float[Tensor, "n m 2"]) -> CostFunction:
    """The cost with residuals mix @ (V . Mh), the distances of both ends from the plane."""

    def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        return plane_distance(mix @ bearings, normal)

    return evaluate


def by_bearings(cost: CostFunction, bearings: Float[Tensor, "n 2 3"], normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n m 2 3"]:
    """d r / d end bearings, by automatic differentiation: one backward pass for each residual of an observation."""
    leaf = bearings.detach().requires_grad_()
    residual, _ = cost(leaf, normal.detach())
    parts = [torch.autograd.grad(residual[:, k].sum(), leaf, retain_graph=True)[0] for k in range(residual.shape[1])]
    return torch.stack(parts, 1)


def line_residual(
    cost: CostFunction, bearings: Float[Tensor, "n 2 3"], chart: LineChart, cam_from_world: Pose
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m 6"], Float[Tensor, "n m 4"]]:
    """Residuals of observations with their lines and poses (one row each), and the Jacobians with respect to the left
    perturbation exp(delta) T of the pose, delta = (rotation_rad, translation_m), and to the retraction of the chart.

    The line must not pass through the camera centre (M = 0).
    """
    normal, normal_by_pose, normal_by_line = chart.projection_normal(cam_from_world)
    r, by_normal = cost(bearings, normal)
    return r, by_normal @ normal_by_pose, by_normal @ normal_by_line
