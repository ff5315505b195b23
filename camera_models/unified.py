"""Unified camera (Mei) as `cv2.omnidir` parametrises it: a unit sphere, a pinhole xi behind its centre, Brown-Conrady distortion.

    x = X / (Z + xi n),  y = Y / (Z + xi n),  n = |(X, Y, Z)|,  r2 = x^2 + y^2,  q = 1 + k1 r2 + k2 r2^2
    xd = x q + 2 p1 x y + p2 (r2 + 2 x^2),  yd = y q + p1 (r2 + 2 y^2) + 2 p2 x y
    u = fx xd + skew yd + cx,  v = fy yd + cy

C. Mei, P. Rives, Single view point omnidirectional camera calibration from planar grids, ICRA 2007. It is `Pinhole` of the point
(X, Y, Z + xi n). Valid for Z > -xi n up to xi = 1, where the image is infinite at that angle, and for Z > -n / xi beyond, where
it ends at r = 1 / sqrt(xi^2 - 1); the distortion may end it earlier.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._arrays import Array
from camera_models._model import CameraModel
from camera_models._radial import named_vector
from camera_models._sphere import FURTHEST_RADIUS, START_MARGIN, local_minima, nearest_curves, onto_sphere, refuse_mirror, within
from camera_models.pinhole import Pinhole
from camera_models.repeatable import least_squares


class Unified(CameraModel):
    """xi = 0 is the pinhole camera, xi = 1 the stereographic lens and the parabolic mirror."""

    NAME = "unified"
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "skew", "xi", "k1", "k2", "p1", "p2")

    def __init__(self, parameters: Array | Sequence[float | int], image_size: tuple[int, int], *, trial: bool = False) -> None:
        super().__init__(parameters, image_size, trial=trial)
        # Made here, not on first use: that may lie inside a `no_grad` block and would then cut the gradients for good.
        values = torch.cat([self.parameters[:5], self.parameters[6:], self.parameters.new_zeros(4)])
        self._pinhole = Pinhole(values, self.image_size, trial=True)

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Unified":
        """The model of named parameters; skew and distortion may be left out and are zero."""
        return cls(named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME, ("skew", "k1", "k2", "p1", "p2")), image_size)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "Unified":
        """The best of a grid of xi that holds the samples without distortion, then least squares for f, f k1 and f k2."""
        refuse_mirror(cls.NAME, mirror)
        xi, allowed, curves = _curves(theta)
        error, focal = nearest_curves(curves, allowed, rho_px)
        best = int(error.argmin())
        plain = cls(
            [float(focal[best]), float(focal[best]), *centre.tolist(), 0.0, float(xi[best]), 0.0, 0.0, 0.0, 0.0], image_size
        )
        for terms in (3, 2):
            powers = curves[best, :, None] ** (2 * torch.arange(terms, dtype=theta.dtype) + 1)
            solution = least_squares(powers, rho_px[:, None])[:, 0]
            f = float(solution[0])
            k1, k2 = [*(solution[1:] / f).tolist(), 0.0][:2]
            model = cls([f, f, *centre.tolist(), 0.0, float(xi[best]), k1, k2, 0.0, 0.0], image_size)
            if f > 0 and model.max_angle > START_MARGIN * float(theta.max()):
                return model
        return plain

    @classmethod
    def examples(cls) -> Sequence["Unified"]:
        """A 190 degree lens, a 220 degree lens with skew, a stereographic lens, one whose distortion folds first, and xi = 0."""
        return (
            cls([560.0, 561.0, 642.3, 478.1, 0.0, 1.2, -0.08, 0.02, 2e-4, -3e-4], (1280, 960)),
            cls([310.0, 311.0, 640.2, 480.7, 0.8, 0.95, 0.01, -0.001, -1e-4, 2e-4], (1280, 960)),
            cls([300.0, 300.0, 500.0, 500.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], (1001, 1001)),
            cls([1300.0, 1301.0, 318.2, 241.5, 0.0, 2.2, -1.6, 0.4, 1e-4, 1e-4], (640, 480)),
            cls([1000.0, 1002.0, 640.3, 478.9, 0.0, 0.0, -0.3, 0.03, 2e-4, -3e-4], (1280, 960)),
        )

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """All but the skew, which is held."""
        return torch.eye(10, dtype=torch.float64)[:, [0, 1, 2, 3, *range(5, 10)]]

    def rivals(self, largest_angle: float) -> Sequence["Unified"]:
        """The minima over xi where k1 and k2 make up for it: several of them may be within a tenth of a pixel of each other."""
        theta = torch.linspace(0, min(largest_angle, 0.98 * self.max_angle), 101, dtype=torch.float64)[1:]
        fx, fy, cx, cy, skew, own, k1, k2, p1, p2 = self.parameters.detach().tolist()
        r = torch.sin(theta) / (torch.cos(theta) + own)
        xi, allowed, curves = _curves(theta)
        powers = curves[..., None] ** torch.tensor([1, 3, 5])
        distorted = (r * (1 + r**2 * (k1 + k2 * r**2)))[:, None].expand(len(xi), -1, 1)
        solution = least_squares(powers, distorted)
        error = ((powers @ solution - distorted) ** 2).sum((-2, -1))
        found = local_minima(torch.where(allowed, error, torch.inf))
        # The minimum that this model is in is no rival.
        others = sorted(found, key=lambda i: abs(float(xi[i]) - own))[1:]
        models = []
        for i in others:
            f, f1, f2 = solution[i, :, 0].tolist()
            if f <= 0:
                continue
            named = [fx * f, fy * f, cx, cy, skew * f, float(xi[i]), f1 / f, f2 / f, p1, p2]
            models.append(type(self)(named, self.image_size))
        return tuple(model for model in models if float(model.parameters[0]) > 0 and model.max_angle > largest_angle)

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    @cached_property
    def max_radius(self) -> float:
        """The hypot(x, y) up to which the model is one-to-one; zero for xi <= -1."""
        xi = float(self.parameters.detach()[5])
        fold = (xi * xi - 1) ** -0.5 if xi > 1 else FURTHEST_RADIUS
        return min(fold, self._pinhole.max_slope) if xi > -1 else 0.0

    @cached_property
    def max_angle(self) -> float:
        """The angle at `max_radius`."""
        with torch.no_grad():
            x, _, z = self._ray(torch.tensor([self.max_radius, 0.0], dtype=torch.float64)).tolist()
        return math.atan2(x, z)

    def _ray(self, plane: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        return onto_sphere(plane, torch.ones_like(plane[..., 0]), self.parameters[5])

    def _shifted(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(X, Y, Z + xi n) and n of points drawn back into the domain, and whether they were inside."""
        points, valid = within(points, self.max_angle)
        n = points.norm(dim=-1)
        return torch.cat([points[..., :2], (points[..., 2] + self.parameters[5] * n)[..., None]], -1), n, valid

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        shifted, _, valid = self._shifted(points)
        pixels, seen = self._pinhole._project(shifted)
        return pixels, valid & seen

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        plane, valid = self._pinhole._ideal(pixels)
        valid = valid & ((plane.detach() ** 2).sum(-1) <= self.max_radius**2)
        return self._ray(torch.where(valid[..., None], plane, torch.zeros_like(plane))), valid

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """Chain rule through the shifted point: d(Z + xi n) = dZ + xi X' dX / n + n dxi."""
        shifted, n, valid = self._shifted(points)
        pixels, seen, by_shifted, by_pinhole = self._pinhole.project_with_jacobians(shifted)
        valid = valid & seen
        direction = torch.where(valid[..., None], points, torch.zeros_like(points)) / n[..., None]
        by_point = by_shifted + self.parameters[5] * by_shifted[..., 2:] * direction[..., None, :]
        by_xi = by_shifted[..., 2:] * n[..., None, None]
        by_parameter = torch.cat([by_pinhole[..., :5], by_xi, by_pinhole[..., 5:9]], -1)
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)


def _curves(theta: Float[Tensor, " n"]) -> tuple[Float[Tensor, " g"], Bool[Tensor, " g"], Float[Tensor, "g n"]]:
    """xi on a grid, which of them hold theta with a margin, and their curves r(theta)."""
    xi = torch.linspace(-0.5, 3.0, 141, dtype=theta.dtype)
    top = torch.cos(torch.clamp(START_MARGIN * theta.max(), max=0.5 * (torch.pi + float(theta.max()))))
    return xi, (top + xi > 0) & (1 + xi * top > 0), torch.sin(theta) / (torch.cos(theta) + xi[:, None])
