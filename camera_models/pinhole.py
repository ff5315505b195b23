"""Pinhole camera with skew and Brown-Conrady distortion, polynomial (k1 k2 p1 p2 k3) or rational (k4 k5 k6), as OpenCV orders it.

    x = X / Z, y = Y / Z, r2 = x^2 + y^2, q = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    xd = x q + 2 p1 x y + p2 (r2 + 2 x^2),  yd = y q + p1 (r2 + 2 y^2) + 2 p2 x y
    u = fx xd + skew yd + cx,  v = fy yd + cy

Valid in front of the camera up to the radius at which the distortion stops being one-to-one.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._coefficients import WithCoefficients
from camera_models._distortion import (
    FURTHEST_SLOPE,
    Distorted,
    distort,
    first_fold,
    solve_symmetric,
    undistort,
)
from camera_models._radial import named_vector
from camera_models.errors import InputError
from camera_models.repeatable import least_squares


class Pinhole(WithCoefficients):
    """Perspective camera; zero distortion coefficients make it the ideal one."""

    NAME = "pinhole"
    COEFFICIENTS = (0, 5, 8)
    VARIANTS = ({"coefficients": 5}, {"coefficients": 8})
    OPTIONAL_TERMS = (("k1",), ("k2",), ("p1", "p2"), ("k3",), ("k4", "k5", "k6"))
    LARGEST_ANGLE = math.pi / 2
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Pinhole":
        """The model of named parameters; skew and distortion may be left out and are zero."""
        rational = any(parameters.get(name, 0.0) != 0.0 for name in ("k4", "k5", "k6"))
        values = named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME, optional=cls.PARAMETER_NAMES[4:])
        return cls(values, image_size, 8 if rational else 5)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        *,
        coefficients: int = 5,
        **options: Any,
    ) -> "Pinhole":
        """Least squares for f, f k1 and f k2 in rho = f (t + k1 t^3 + k2 t^5), t = tan(theta), samples below 80 degrees."""
        if mirror:
            raise InputError("Camera model pinhole expects a lens that looks along +z, found `mirror`; use `model` scaramuzza.")
        seen = theta < math.radians(80)
        if int(seen.sum()) < 3:
            seen = theta <= torch.sort(theta).values[min(2, len(theta) - 1)]
        t, rho = torch.tan(theta[seen].clamp_max(math.radians(85))), rho_px[seen]
        for terms in (3, 2, 1):
            powers = t[:, None] ** (2 * torch.arange(terms, dtype=t.dtype) + 1)
            solution = least_squares(powers, rho[:, None])[:, 0]
            f = float(solution[0])
            if f > 0:
                k = [*(solution[1:] / f).tolist(), 0.0, 0.0][:2]
                model = cls([f, f, *centre.tolist(), 0.0, *k, *([0.0] * 6)], image_size, coefficients)
                if model.max_angle > float(theta[seen].max()) + 0.02:
                    return model
        f = float((rho * t).sum() / (t * t).sum())
        return cls([f, f, *centre.tolist(), *([0.0] * 9)], image_size, coefficients)

    @classmethod
    def examples(cls) -> Sequence["Pinhole"]:
        """Barrel with tangential terms, rational wide angle, pincushion with skew, the dissertation's ideal camera, one that
        ends at a pole, and one of square pixels."""
        return (
            cls([600.0, 602.0, 640.3, 478.9, 0.0, -0.28, 0.09, 2e-4, -3e-4, -0.012, 0, 0, 0], (1280, 960)),
            cls([450.0, 451.0, 655.0, 370.0, 0.0, 0.9, 0.05, -1e-4, 2e-4, 0.001, 1.2, 0.22, 0.01], (1280, 720), 8),
            cls([900.0, 905.0, 330.0, 245.0, 1.5, 0.06, 0.01, 0.0, 0.0, 0.0, 0, 0, 0], (640, 480)),
            cls([1520.4, 1525.9, 302.32, 246.87, *([0.0] * 9)], (640, 480), 0),
            cls([900.0, 901.0, 640.2, 480.4, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, -0.05, 0.0], (1280, 960), 8),
            cls([820.0, 820.0, 651.2, 470.6, 0.0, -0.21, 0.06, 1e-4, -2e-4, -0.008, 0, 0, 0], (1280, 960)),
        )

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """fx fy cx cy and the chosen number of distortion coefficients; skew is held."""
        return torch.eye(13, dtype=torch.float64)[:, [0, 1, 2, 3, *range(5, 5 + self.coefficients)]]

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    @cached_property
    def max_slope(self) -> float:
        """tan of `max_angle`: first radius at which the distortion folds in some direction."""
        return first_fold(self.parameters.detach()[5:].tolist())

    @cached_property
    def max_angle(self) -> float:
        """atan of the first radius at which the distortion folds; 90 degrees for the ideal camera."""
        return math.atan(self.max_slope) if self.max_slope < FURTHEST_SLOPE else math.pi / 2

    def _plane(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x / z and y / z drawn back to the edge of the domain where outside, whether inside, and a z safe to divide by."""
        x, y, z = points.unbind(-1)
        s2 = x * x + y * y
        valid = (z > 0) & (s2 <= (self.max_slope * z) ** 2)
        if bool(valid.all()):
            return x / z, y / z, valid, z
        # Divided by this, points inside become x / z and points outside come to the edge.
        length = torch.where(valid | (s2 == 0), 1.0, s2).sqrt()
        divisor = torch.where(valid, z, length / max(self.max_slope, 1e-300))
        return x / divisor, y / divisor, valid, torch.where(valid, z, 1.0)

    def _pixels(self, xd: Tensor, yd: Tensor) -> Tensor:
        fx, fy, cx, cy, skew = self.parameters[:5].unbind()
        return torch.stack([fx * xd + skew * yd + cx, fy * yd + cy], -1)

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        x, y, valid, _ = self._plane(points)
        at = distort(self.parameters[5:].unbind(), x, y)
        return self._pixels(at.x, at.y), valid

    def _ideal(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """x / z and y / z of pixels, and where there is such a point."""
        fx, fy, cx, cy, skew = self.parameters[:5].unbind()
        yd = (pixels[..., 1] - cy) / fy
        xd = (pixels[..., 0] - cx - skew * yd) / fx
        with torch.no_grad():
            target = torch.stack([xd, yd], -1).reshape(-1, 2)
            plane, found = undistort(self.parameters[5:].tolist(), self.max_slope, target)
        plane, found = plane.view(pixels.shape), found.view(xd.shape)
        if not (torch.is_grad_enabled() and (pixels.requires_grad or self.parameters.requires_grad)):
            return plane, found
        # One Newton step with gradients: the implicit-function theorem, exact at the solution.
        x, y = plane.unbind(-1)
        at = distort(self.parameters[5:].unbind(), x, y)
        frozen = at._replace(xx=at.xx.detach(), cross=at.cross.detach(), yy=at.yy.detach())
        step = solve_symmetric(frozen, at.x - xd, at.y - yd)
        return plane - torch.where(found[..., None], torch.stack(step, -1), 0.0), found

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        plane, found = self._ideal(pixels)
        x, y = plane.unbind(-1)
        z = torch.rsqrt(x * x + y * y + 1)
        return torch.stack([x * z, y * z, z], -1), found

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """Chain rule through the ideal plane; all terms closed."""
        x, y, valid, z = self._plane(points)
        values = self.parameters.detach().tolist()
        fx, fy, cx, cy, skew = values[:5]
        at = distort(values[5:], x, y)
        over = 1 / z
        ux, uy = (fx * at.xx + skew * at.cross) * over, (fx * at.cross + skew * at.yy) * over
        fy_over = fy * over
        vx, vy = fy_over * at.cross, fy_over * at.yy
        by_point = torch.stack([ux, uy, -(ux * x + uy * y), vx, vy, -(vx * x + vy * y)], -1).unflatten(-1, (2, 3))
        pixels = torch.stack([fx * at.x + skew * at.y + cx, fy * at.y + cy], -1)
        by_parameter = _by_parameter(values, at, x, y)
        if bool(valid.all()):
            return pixels, valid, by_point, by_parameter
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)


def _by_parameter(values: list[float], at: Distorted, x: Tensor, y: Tensor) -> Float[Tensor, "*batch 2 p"]:
    """d pixel / d parameters at a point of the ideal plane."""
    fx, fy, _, _, skew = values[:5]
    r2, q, _, over = at.radial
    u, v = fx * x + skew * y, fy * y
    first = r2 * over
    u1, v1 = u * first, v * first
    u2, v2 = u1 * r2, v1 * r2
    u3, v3 = u2 * r2, v2 * r2
    xy, wide, high = 2 * x * y, r2 + 2 * x * x, r2 + 2 * y * y
    lower, zero, one = -q, torch.zeros_like(x), torch.ones_like(x)
    by_u = [at.x, zero, one, zero, at.y, u1, u2, fx * xy + skew * high, fx * wide + skew * xy, u3]
    by_v = [zero, at.y, zero, one, zero, v1, v2, fy * high, fy * xy, v3]
    columns = [*by_u, u1 * lower, u2 * lower, u3 * lower, *by_v, v1 * lower, v2 * lower, v3 * lower]
    return torch.stack(columns, -1).unflatten(-1, (2, 13))
