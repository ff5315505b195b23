"""The part of the image in which a camera sees the world, and how well its projection is known all over it."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.uncertainty import projection_jacobian, supported_grid, worst_sigma_px

MAP_STEPS, SEARCH_STEPS = 64, 24
"""Places along the longer side of the image at which the projection uncertainty is stated, and at which poses are compared."""
VIEWS_AT_ONCE = 128
"""Whose uncertainties are in memory together."""
EDGE_RAYS, EDGE_STEPS = 120, 250
"""Rays from the centre, and places along each, at which the edge of the field is looked for."""


@dataclass(frozen=True, eq=False)
class ImageField:
    """The image within the rim of its lens or mirror, outside a blind centre, where the model has a bearing."""

    model: CameraModel
    rim_px: float | None = None
    """Distance from the centre pixel beyond which nothing is seen; None: the whole image shows the world."""
    blind_rad: float = 0.0
    """Up to this angle off axis a mirror shows its camera."""

    def shows(self, pixels: Float[Tensor, "*n 2"], margin_px: float = 0.0) -> Bool[Tensor, "*n"]:
        """Whether the world is seen at pixels, this far from the edge; the bearing's own domain is left to who projects."""
        size = torch.tensor(self.model.image_size, dtype=pixels.dtype)
        inside = ((pixels >= margin_px) & (pixels <= size - 1 - margin_px)).all(-1)
        if self.rim_px is not None:
            inside = inside & ((pixels - self.model.centre_px.detach()).norm(dim=-1) <= self.rim_px - margin_px)
        if self.blind_rad > 0:
            angle = angles_off_axis(self.model, pixels.reshape(-1, 2)).reshape(pixels.shape[:-1])
            inside = inside & (angle >= self.blind_rad)
        return inside

    def grid(self, steps: int) -> Float[Tensor, "n 2"]:
        """Pixels of a uniform grid over the field."""
        pixels = supported_grid(self.model, torch.pi, points=steps)
        return pixels[self.shows(pixels)]

    @cached_property
    def edge_px(self) -> Float[Tensor, "k 2"]:
        """The outermost pixels of the field from the centre of the image in EDGE_RAYS directions, the first to the right, then
        downwards."""
        turn = 2 * torch.pi * torch.arange(EDGE_RAYS, dtype=torch.float64) / EDGE_RAYS
        reach = self.model.image_radius_px * torch.linspace(0, 1, EDGE_STEPS + 1, dtype=torch.float64)
        pixels = self.model.centre_px.detach() + reach[:, None, None] * torch.stack([turn.cos(), turn.sin()], -1)
        _, valid = self.model.unproject(pixels.reshape(-1, 2))
        seen = valid.reshape(pixels.shape[:-1]) & self.shows(pixels)
        last = (seen * torch.arange(1, EDGE_STEPS + 2)[:, None]).argmax(0)
        return pixels[last, torch.arange(EDGE_RAYS)]

    def shares_of_the_way(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """How far from the centre towards the edge of the field pixels lie."""
        centre = self.model.centre_px.detach()
        off = pixels - centre
        ray = torch.round(torch.atan2(off[:, 1], off[:, 0]) / (2 * torch.pi) * EDGE_RAYS).long() % EDGE_RAYS
        return off.norm(dim=-1) / (self.edge_px - centre).norm(dim=-1)[ray].clamp_min(1.0)


@dataclass(frozen=True, eq=False)
class KnownProjection:
    """How far the projection all over a field is known: unknowns of unit variance, and what they move there."""

    field: ImageField
    factor: Float[Tensor, "p r"]
    """F of the covariance F F' of the parameters."""
    pixels: Float[Tensor, "n 2"]
    moved: Float[Tensor, "n 2 r"]
    """d pixel / d unknowns after the best common rotation (`calibration.uncertainty`)."""

    @staticmethod
    def of(
        field: ImageField,
        covariance: Float[Tensor, "p p"],
        min_angle_rad: float,
        max_angle_rad: float,
        steps: int = MAP_STEPS,
    ) -> "KnownProjection":
        """Of a camera whose corners reach between these angles off axis, at so many places along the longer side of its image."""
        pixels = field.grid(steps)
        jacobian, valid = projection_jacobian(field.model, pixels, supported_grid(field.model, max_angle_rad, min_angle_rad))
        # Parameters have many units and trade off against one another: the factor is that of their correlations.
        sigma = covariance.diagonal().clamp_min(0).sqrt()
        unit = torch.where(sigma > 0, 1 / sigma.clamp_min(1e-300), torch.zeros_like(sigma))
        values, vectors = torch.linalg.eigh(covariance * unit[:, None] * unit)
        sound = values > values[-1] * len(values) * torch.finfo(torch.float64).eps
        factor = sigma[:, None] * vectors[:, sound] * values[sound].sqrt()
        return KnownProjection(field, factor, pixels[valid], jacobian[valid] @ factor)

    @property
    def sigma_px(self) -> Float[Tensor, " n"]:
        """Standard deviation of the projection in its worst direction."""
        return worst_sigma_px(self.moved @ self.moved.mT)

    def sigma_after_px(self, information: Float[Tensor, "k r r"]) -> Float[Tensor, "k n"]:
        """The same with the information of each of k views about the unknowns."""
        return torch.cat([self._after(part) for part in information.split(VIEWS_AT_ONCE)])

    def _after(self, information: Float[Tensor, "k r r"]) -> Float[Tensor, "k n"]:
        root = torch.linalg.cholesky(torch.eye(self.factor.shape[1], dtype=torch.float64) + information)
        rows = self.moved.reshape(-1, self.moved.shape[-1]).mT
        found = torch.linalg.solve_triangular(root, rows.expand(len(root), *rows.shape), upper=False)
        u, v = found.reshape(*found.shape[:2], -1, 2).unbind(-1)
        entries = [(u * u).sum(1), (u * v).sum(1), (u * v).sum(1), (v * v).sum(1)]
        return worst_sigma_px(torch.stack(entries, -1).unflatten(-1, (2, 2)))

    def with_view(self, information: Float[Tensor, "r r"]) -> tuple["KnownProjection", Float[Tensor, "r r"]]:
        """What is known with one view more, and the matrix L^-1 that takes information about the old unknowns to that about
        the new ones, L^-1 M L^-T."""
        root = torch.linalg.cholesky(torch.eye(len(information), dtype=torch.float64) + information)
        change = torch.linalg.inv(root)
        return KnownProjection(self.field, self.factor @ change.mT, self.pixels, self.moved @ change.mT), change
