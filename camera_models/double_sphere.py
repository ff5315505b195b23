"""Double sphere camera: a point goes onto one unit sphere, from there onto a second one, then through a pinhole.

    d1 = |X|,  zeta = xi d1 + z,  d2 = sqrt(x^2 + y^2 + zeta^2),  D = alpha d2 + (1 - alpha) zeta
    u = fx x / D + cx,  v = fy y / D + cy

V. Usenko, N. Demmel, D. Cremers, The double sphere camera model, 3DV 2018. Meant for -1 < xi <= 1 and 0 <= alpha <= 1.
Valid for zeta > -w1 d2 with w1 = alpha / (1 - alpha) up to alpha = 1/2, where the image is infinite at that angle, and
w1 = (1 - alpha) / alpha beyond, where it ends at the radius hypot(x, y) / D = 1 / sqrt(2 alpha - 1); xi > 1 adds z > -d1 / xi.
The paper's bound z > -w2 d1 lies inside this domain and does not reach its edge.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._sphere import (
    START_MARGIN,
    SphereModel,
    fold_radius,
    least_cosine,
    local_minima,
    nearest_curves,
    onto_sphere,
    ray_height,
    refuse_mirror,
)


class DoubleSphere(SphereModel):
    """xi is the distance between the centres of the two spheres, alpha / (1 - alpha) that of the second from the pinhole."""

    NAME = "double-sphere"
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "xi", "alpha")

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "DoubleSphere":
        """The best of a grid of xi and alpha that holds the samples, with the focal length by least squares."""
        refuse_mirror(cls.NAME, mirror)
        f, xi, alpha = _minima(rho_px, theta)[0]
        return cls([f, f, *centre.tolist(), xi, alpha], image_size)

    @classmethod
    def examples(cls) -> Sequence["DoubleSphere"]:
        """Two published 195 degree lenses, a 240 degree lens, one whose image is infinite at 120 degrees, and xi above 1."""
        return (
            cls([158.28, 158.27, 254.96, 256.36, -0.172, 0.594], (512, 512)),
            cls([313.21, 313.21, 638.66, 514.39, -0.18, 0.59], (1280, 1024)),
            cls([330.0, 331.0, 642.1, 478.7, 0.12, 0.56], (1280, 960)),
            cls([450.0, 448.0, 310.2, 245.6, 0.15, 0.3], (640, 480)),
            cls([800.0, 800.0, 500.0, 500.0, 1.1, 0.4], (1001, 1001)),
        )

    def rivals(self, largest_angle: float) -> Sequence["DoubleSphere"]:
        """The minima over xi: curves of quite different xi differ by less than a tenth of a pixel, with a ridge between them."""
        with torch.no_grad():
            theta = torch.linspace(0, min(largest_angle, 0.98 * self.max_angle), 101, dtype=torch.float64)[1:]
            ring = torch.stack([torch.sin(theta), torch.zeros_like(theta), torch.cos(theta)], -1)
            fx, fy, cx, cy, own, _ = self.parameters.tolist()
            found = _minima(ring[:, 0] / self._denominator(ring), theta)
        # The minimum that this model is in is no rival.
        nearest = min(found, key=lambda minimum: abs(minimum[1] - own))
        others = [minimum for minimum in found if minimum is not nearest]
        return tuple(type(self)([fx * f, fy * f, cx, cy, xi, alpha], self.image_size) for f, xi, alpha in others)

    @property
    def max_radius(self) -> float:
        """The smaller of the radii at which the second and (xi > 1) the first sphere is seen edge on; zero for xi <= -1."""
        xi, alpha = self.parameters.detach()[4:].tolist()
        radius = fold_radius(alpha)
        if xi > 1:
            # The first sphere is seen under asin(1 / xi) from the centre of the second.
            radius = min(radius, 1 / (alpha * xi + (1 - alpha) * math.sqrt(xi * xi - 1)))
        return radius if xi > -1 else 0.0

    def _ray(self, plane: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        xi, alpha = self.parameters[4:]
        return onto_sphere(plane, ray_height(alpha, (plane**2).sum(-1)), xi)

    def _denominator(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        xi, alpha = self.parameters[4:]
        zeta = xi * points.norm(dim=-1) + points[..., 2]
        d2 = torch.sqrt(((points[..., :2] ** 2).sum(-1) + zeta * zeta).clamp_min(1e-300))
        return (alpha * d2 + (1 - alpha) * zeta).clamp_min(1e-300)

    def _slopes(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 2"]]:
        xi, alpha = self.parameters[4:]
        d1 = points.norm(dim=-1)
        zeta = xi * d1 + points[..., 2]
        d2 = torch.sqrt(((points[..., :2] ** 2).sum(-1) + zeta * zeta).clamp_min(1e-300))
        up, flat = points.new_tensor([0.0, 0.0, 1.0]), points.new_tensor([1.0, 1.0, 0.0])
        zeta_by_point = xi * points / d1[..., None] + up
        d2_by_point = (points * flat + zeta[..., None] * zeta_by_point) / d2[..., None]
        by_zeta = alpha * zeta / d2 + 1 - alpha
        return alpha * d2_by_point + (1 - alpha) * zeta_by_point, torch.stack([by_zeta * d1, d2 - zeta], -1)


def _minima(rho: Float[Tensor, " n"], theta: Float[Tensor, " n"]) -> list[tuple[float, float, float]]:
    """(f, xi, alpha) of the local minima over xi of the squared error of rho, the best first."""
    xi = torch.linspace(-0.7, 1.3, 41, dtype=theta.dtype)[:, None]
    alpha = torch.linspace(0.0, 1.0, 21, dtype=theta.dtype).expand(len(xi), -1)
    top = torch.clamp(START_MARGIN * theta.max(), max=0.5 * (torch.pi + float(theta.max())))
    edge = xi + torch.cos(top)
    edge = edge / torch.hypot(torch.sin(top), edge)
    sine, zeta = torch.sin(theta), (xi + torch.cos(theta))[:, None]
    rows = torch.arange(len(xi))
    # For every xi the best alpha of a grid that is drawn closer three times.
    for spread in (0.05, 0.006, 7e-4, 0.0):
        curves = sine / (alpha[..., None] * torch.hypot(sine, zeta) + (1 - alpha[..., None]) * zeta)
        allowed = (edge > least_cosine(alpha)) & ((1 + xi * torch.cos(top) > 0) | (xi <= 1))
        error, focal = nearest_curves(curves, allowed, rho)
        best = error.argmin(-1)
        error, focal, chosen = error[rows, best], focal[rows, best], alpha[rows, best]
        offsets = torch.linspace(-spread, spread, 17, dtype=theta.dtype)
        alpha = (chosen[:, None] + offsets).clamp(0.0, 1.0)
    found = [(float(error[i]), float(focal[i]), float(xi[i]), float(chosen[i])) for i in local_minima(error)]
    return [(f, x, a) for _, f, x, a in sorted(found)]
