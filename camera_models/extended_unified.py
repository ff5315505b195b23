"""Extended unified camera: an ellipsoid of revolution in place of the unit sphere, two shape parameters and no distortion.

    d = sqrt(beta (x^2 + y^2) + z^2),  D = alpha d + (1 - alpha) z,  u = fx x / D + cx,  v = fy y / D + cy

B. Khomutenko, G. Garcia, P. Martinet, An enhanced unified camera model, RA-L 2016. Meant for 0 <= alpha <= 1 and beta > 0.
Valid for z > -w d with w = alpha / (1 - alpha) up to alpha = 1/2, where the image is infinite at that angle, and
w = (1 - alpha) / alpha beyond, where it ends at the radius hypot(x, y) / D = 1 / sqrt(beta (2 alpha - 1)).
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._sphere import (
    FURTHEST_RADIUS,
    START_MARGIN,
    SphereModel,
    fold_radius,
    least_cosine,
    nearest_curves,
    ray_height,
    refuse_mirror,
)


class ExtendedUnified(SphereModel):
    """alpha is how far the projection centre lies from the middle of the ellipsoid, beta how much wider than high it is."""

    NAME = "extended-unified"
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "alpha", "beta")

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "ExtendedUnified":
        """The best of a grid of alpha and beta that holds the samples, with the focal length by least squares."""
        refuse_mirror(cls.NAME, mirror)
        alphas = torch.linspace(0.0, 1.0, 51, dtype=theta.dtype)
        betas = torch.logspace(-0.7, 0.7, 29, dtype=theta.dtype)
        alpha, beta = (grid.flatten() for grid in torch.meshgrid(alphas, betas, indexing="ij"))
        sine, cosine = torch.sin(theta), torch.cos(theta)
        d = torch.sqrt(beta[:, None] * sine**2 + cosine**2)
        top = torch.clamp(START_MARGIN * theta.max(), max=0.5 * (torch.pi + float(theta.max())))
        height = torch.cos(top) / torch.sqrt(beta * torch.sin(top) ** 2 + torch.cos(top) ** 2)
        curves = sine / (alpha[:, None] * d + (1 - alpha[:, None]) * cosine)
        error, focal = nearest_curves(curves, height > least_cosine(alpha), rho_px)
        best = int(error.argmin())
        f = float(focal[best])
        return cls([f, f, *centre.tolist(), float(alpha[best]), float(beta[best])], image_size)

    @classmethod
    def examples(cls) -> Sequence["ExtendedUnified"]:
        """A published wide-angle lens, a 250 degree lens, a stereographic lens, and one whose image is infinite."""
        return (
            cls([380.95, 380.94, 365.5, 249.8, 0.63, 1.04], (752, 480)),
            cls([240.0, 241.0, 642.1, 478.7, 0.57, 0.85], (1280, 960)),
            cls([300.0, 300.0, 500.0, 500.0, 0.5, 1.0], (1001, 1001)),
            cls([420.0, 418.0, 310.2, 245.6, 0.3, 1.2], (640, 480)),
        )

    @property
    def max_radius(self) -> float:
        """1 / sqrt(beta (2 alpha - 1)) where alpha > 1/2, else infinite; zero for a beta that is not positive."""
        alpha, beta = self.parameters.detach()[4:].tolist()
        return min(fold_radius(alpha) / beta**0.5, FURTHEST_RADIUS) if beta > 0 else 0.0

    def _ray(self, plane: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        alpha, beta = self.parameters[4:]
        ray = torch.cat([plane, ray_height(alpha, beta * (plane**2).sum(-1))[..., None]], -1)
        return ray / ray.norm(dim=-1, keepdim=True)

    def _denominator(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        alpha, beta = self.parameters[4:]
        z = points[..., 2]
        d = torch.sqrt((beta * (points[..., :2] ** 2).sum(-1) + z * z).clamp_min(1e-300))
        return (alpha * d + (1 - alpha) * z).clamp_min(1e-300)

    def _slopes(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 2"]]:
        alpha, beta = self.parameters[4:]
        m, z = points[..., :2], points[..., 2]
        s2 = (m**2).sum(-1)
        d = torch.sqrt((beta * s2 + z * z).clamp_min(1e-300))
        by_point = torch.cat([alpha * beta * m / d[..., None], (alpha * z / d + 1 - alpha)[..., None]], -1)
        return by_point, torch.stack([d - z, 0.5 * alpha * s2 / d], -1)
