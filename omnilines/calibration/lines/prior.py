"""What is known of a camera before any line is seen: about where its start is.

Straight lines leave a camera open along whole directions: any linear map of the bearings keeps straight lines straight, and lines
that meet meeting. Right angles close these. So that what they do not close stays where it was, and is stated as uncertain, the
camera is held near the start by as much as its projection may be off, over a grid of pixels u with the motion B(u) d of a change
d of the parameters:

    d' P d = mean_u |B(u) d|^2 / s^2,        s = prior_share of half the image's longer side.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.uncertainty import bearing_jacobian, supported_grid
from omnilines.least_squares import KeptPrior

LEAST_SHARE = 1e-14


@dataclass(frozen=True)
class CameraPrior:
    """Residuals of the parameters, whitened."""

    start: Float[Tensor, " p"]
    wide: Float[Tensor, "q q"]
    """P = wide' wide, along the basis."""
    usual: Float[Tensor, "u q"]
    """What is usual of any camera: square pixels, the centre in the middle; or what boards say of this one."""
    basis: Float[Tensor, "p q"]
    boards: bool = False
    """Whether boards say it."""
    held: Float[Tensor, " q"] | None = None
    """Derivative of the focal length, over the standard deviation that it is left about its start: where lines do not tell it, or
    something beside them does."""
    scale_sigma: float | None = None
    """That of its logarithm, where something beside lines tells it."""

    @staticmethod
    def of(
        model: CameraModel,
        basis: Float[Tensor, "p q"],
        seen_px: Float[Tensor, "n 2"],
        share: float,
        *,
        aspect_sigma: float,
        centre_share: float,
    ) -> "CameraPrior":
        """About a start camera, over the part of the image in which edges are seen."""
        reach = float(angles_off_axis(model, seen_px).max())
        grid = supported_grid(model, reach)
        _, valid, by_parameter, by_point = bearing_jacobian(model, grid)
        motion = (by_point @ by_parameter @ basis)[valid]
        sigma = share * 0.5 * max(model.image_size)
        information = torch.einsum("nik,nil->kl", motion, motion) / (len(motion) * sigma**2)
        unit = information.diagonal().clamp_min(1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(information * unit[:, None] * unit)
        values = values.clamp_min(LEAST_SHARE)
        wide, usual = values.sqrt()[:, None] * vectors.mT / unit, _usual(model, aspect_sigma, centre_share) @ basis
        return CameraPrior(model.parameters.detach().clone(), wide, usual, basis)

    def with_boards(self, model: CameraModel, covariance: Float[Tensor, "p p"]) -> "CameraPrior":
        """What boards say of the camera, with its covariance, in the place of what is usual. What they hold is held."""
        own = self.basis.mT @ covariance @ self.basis
        least = LEAST_SHARE**0.5 * (self.basis.mT @ model.parameters).abs().clamp_min(1.0)
        unit = own.diagonal().clamp_min(0.0).sqrt().maximum(least)
        values, vectors = torch.linalg.eigh(own / (unit[:, None] * unit))
        told = (values.clamp_min(LEAST_SHARE).rsqrt()[:, None] * vectors.mT) / unit
        return CameraPrior(model.parameters.detach().clone(), self.wide, told, self.basis, boards=True)

    def with_scale(self, by_parameter: Float[Tensor, " p"], focal_px: float, sigma: float, *, told: bool) -> "CameraPrior":
        """With the focal length of the start, which has that derivative and this standard deviation of its logarithm; `told` by
        what, beside lines, tells it."""
        row = by_parameter @ self.basis / (sigma * focal_px)
        return replace(self, held=row, scale_sigma=sigma if told else None)

    @property
    def root(self) -> Float[Tensor, "r q"]:
        """Rows of all that is known, and of what is held."""
        rows = torch.cat([self.wide, self.usual])
        return rows if self.held is None else torch.cat([rows, self.held[None]])

    @property
    def information(self) -> Float[Tensor, "q q"]:
        """Of all that is known."""
        return self.wide.mT @ self.wide + self.usual.mT @ self.usual

    def residuals(self, model: CameraModel, kept: int) -> KeptPrior:
        """Of a camera, the first of `kept` columns being its own."""
        change = self.basis.mT @ (model.parameters - self.start)
        padding = self.root.new_zeros(len(self.root), kept - self.root.shape[1])
        return KeptPrior(self.root @ change, torch.cat([self.root, padding], -1))


def _usual(model: CameraModel, aspect_sigma: float, centre_share: float) -> Float[Tensor, "u p"]:
    """Derivatives, by the parameters, of the ratio of both focal lengths and of the centre, over their standard deviations."""
    values = model.named_parameters()
    place = {name: k for k, name in enumerate(values)}
    centre = centre_share * 0.5 * max(model.image_size)
    rows = [{"cx": 1.0 / centre}, {"cy": 1.0 / centre}, {"c": 1.0 / aspect_sigma}, {"d": 1.0 / aspect_sigma}]
    if "fx" in values and "fy" in values:
        rows.append({"fx": -1.0 / (aspect_sigma * values["fx"]), "fy": 1.0 / (aspect_sigma * values["fy"])})
    table = torch.zeros(len(rows), len(values), dtype=torch.float64)
    for row, entries in zip(table, rows, strict=True):
        for name, value in entries.items():
            if name in place:
                row[place[name]] = value
    return table
