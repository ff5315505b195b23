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

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._arrays import Array
from camera_models._model import CameraModel
from camera_models._radial import first_sign_change, named_vector
from camera_models.errors import InputError

FURTHEST_SLOPE = 1e8
"""tan(theta) that stands for 90 degrees: beyond it a point counts as beside the camera, not in front of it."""


class Pinhole(CameraModel):
    """Perspective camera; zero distortion coefficients make it the ideal one."""

    NAME = "pinhole"
    LARGEST_ANGLE = math.pi / 2
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

    def __init__(self, parameters: Array | Sequence[float | int], image_size: tuple[int, int], coefficients: int = 5) -> None:
        super().__init__(parameters, image_size)
        self.coefficients = coefficients
        if coefficients not in (0, 5, 8):
            raise InputError(
                f"Camera model pinhole estimates 0, 5 or 8 distortion coefficients, found {coefficients}; choose one."
            )

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
        coefficients: int = 5,
        **options: Any,
    ) -> "Pinhole":
        """Least squares for f, f k1 and f k2 in rho = f (t + k1 t^3 + k2 t^5), t = tan(theta), samples below 80 degrees."""
        if mirror:
            raise InputError("Camera model pinhole expects a lens that looks along +z, found --mirror; use --model scaramuzza.")
        seen = theta < math.radians(80)
        if int(seen.sum()) < 3:
            seen = theta <= torch.sort(theta).values[min(2, len(theta) - 1)]
        t, rho = torch.tan(theta[seen].clamp_max(math.radians(85))), rho_px[seen]
        for terms in (3, 2, 1):
            powers = t[:, None] ** (2 * torch.arange(terms, dtype=t.dtype) + 1)
            solution = torch.linalg.lstsq(powers, rho[:, None]).solution[:, 0]
            f = float(solution[0])
            k = [*(solution[1:] / f).tolist(), 0.0, 0.0][:2]
            model = cls([f, f, *centre.tolist(), 0.0, *k, *([0.0] * 6)], image_size, coefficients)
            if f > 0 and model.max_angle > float(theta[seen].max()) + 0.02:
                return model
        f = float((rho * t).sum() / (t * t).sum())
        return cls([f, f, *centre.tolist(), *([0.0] * 9)], image_size, coefficients)

    @classmethod
    def examples(cls) -> Sequence["Pinhole"]:
        """Barrel with tangential terms, rational wide angle, pincushion with skew, and the dissertation's ideal camera."""
        return (
            cls([600.0, 602.0, 640.3, 478.9, 0.0, -0.28, 0.09, 2e-4, -3e-4, -0.012, 0, 0, 0], (1280, 960)),
            cls([450.0, 451.0, 655.0, 370.0, 0.0, 0.9, 0.05, -1e-4, 2e-4, 0.001, 1.2, 0.22, 0.01], (1280, 720), 8),
            cls([900.0, 905.0, 330.0, 245.0, 1.5, 0.06, 0.01, 0.0, 0.0, 0.0, 0, 0, 0], (640, 480)),
            cls([1520.4, 1525.9, 302.32, 246.87, *([0.0] * 9)], (640, 480), 0),
        )

    def with_parameters(self, parameters: Array | Sequence[float | int]) -> "Pinhole":
        """The same model and image with another parameter vector."""
        return type(self)(parameters, self.image_size, self.coefficients)

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
        k1, k2, p1, p2, k3, k4, k5, k6 = self.parameters.detach()[5:].tolist()
        numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
        denominator = np.polynomial.Polynomial([1.0, k4, k5, k6])
        r2 = np.polynomial.Polynomial([0.0, 1.0])
        # d (r q) / d r > 0 and q, denominator > 0, all as polynomials in r^2.
        growth = (numerator + 2 * r2 * numerator.deriv()) * denominator - 2 * r2 * numerator * denominator.deriv()
        edge = min(first_sign_change(p.coef, 1.0) for p in (growth, numerator, denominator))
        slope = min(math.sqrt(edge), FURTHEST_SLOPE)
        return slope if p1 == 0 and p2 == 0 else self._first_fold(slope)

    def _first_fold(self, slope: float) -> float:
        """Smallest radius up to `slope` at which the Jacobian of the distortion is singular in some direction."""
        angles = torch.linspace(0, 2 * math.pi, 65, dtype=torch.float64)[:-1]
        ring = torch.stack([torch.cos(angles), torch.sin(angles)], -1)

        def sound(radii: Tensor) -> Tensor:
            with torch.no_grad():
                return (_determinant(self._distort(radii[:, None, None] * ring)[1]) > 0).all(-1)

        grid = [*np.linspace(0.01, 1, 100), *np.geomspace(1, FURTHEST_SLOPE, 200)]
        radii = torch.tensor([r for r in grid if r < slope] + [slope * (1 - 1e-12)], dtype=torch.float64)
        # Each round looks between the last sound radius and the first folded one, 64 times finer than the one before.
        for _ in range(7):
            folded = torch.nonzero(~sound(radii))
            if len(folded) == 0:
                return slope
            first = int(folded[0])
            low, high = (float(radii[first - 1]) if first else 0.0), float(radii[first])
            radii = torch.linspace(low, high, 65, dtype=torch.float64)[1:]
        return low

    @cached_property
    def max_angle(self) -> float:
        """atan of the first radius at which the distortion folds; 90 degrees for the ideal camera."""
        return math.atan(self.max_slope) if self.max_slope < FURTHEST_SLOPE else math.pi / 2

    def _distort(self, plane: Tensor) -> tuple[Tensor, Tensor]:
        """Distorted (xd, yd) and its 2x2 Jacobian with respect to (x, y)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.parameters[5:]
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        numerator, denominator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        q = numerator / denominator
        by_r2 = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - q * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / denominator
        xd = x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        cross = 2 * x * y * by_r2 + 2 * p1 * x + 2 * p2 * y
        xx = q + 2 * x * x * by_r2 + 2 * p1 * y + 6 * p2 * x
        yy = q + 2 * y * y * by_r2 + 6 * p1 * y + 2 * p2 * x
        return torch.stack([xd, yd], -1), torch.stack([torch.stack([xx, cross], -1), torch.stack([cross, yy], -1)], -2)

    @property
    def _matrix(self) -> Tensor:
        fx, fy, _, _, skew = self.parameters[:5]
        return torch.stack([torch.stack([fx, skew]), torch.stack([torch.zeros_like(fx), fy])])

    def _plane(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(x / z, y / z) drawn back to the edge of the domain where outside, whether inside, and a z safe to divide by."""
        z = points[..., 2]
        s2 = (points[..., :2] ** 2).sum(-1)
        valid = (z > 0) & (s2 <= (self.max_slope * z) ** 2)
        safe = torch.where(valid, z, torch.ones_like(z))
        length = torch.where(valid | (s2 == 0), torch.ones_like(s2), s2).sqrt()
        edge = points[..., :2] * (self.max_slope / length)[..., None]
        return torch.where(valid[..., None], points[..., :2] / safe[..., None], edge), valid, safe

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        plane, valid, _ = self._plane(points)
        return self._distort(plane)[0] @ self._matrix.mT + self.parameters[2:4], valid

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        target = (pixels - self.parameters[2:4]) @ torch.linalg.inv(self._matrix).mT
        with torch.no_grad():
            plane = self._undistort(target)
        # One Newton step with gradients: the implicit-function theorem, exact at the solution.
        value, jacobian = self._distort(plane)
        residual = value - target
        scale = 1 + target.detach().norm(dim=-1)
        sound = (residual.detach().norm(dim=-1) < 1e-9 * scale) & (plane.norm(dim=-1) <= self.max_slope)
        step = _solve(jacobian.detach(), residual)
        plane = plane - torch.where(sound[..., None], step, torch.zeros_like(step))
        ray = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        return ray / ray.norm(dim=-1, keepdim=True), sound

    def _undistort(self, target: Tensor) -> Tensor:
        """Newton on the 2D distortion with step halving, kept inside the one-to-one disc; a point that does not converge is
        told apart by its residual."""
        limit = self.max_slope
        plane = target * torch.clamp(0.5 * limit / target.norm(dim=-1, keepdim=True).clamp_min(1e-300), max=1.0)
        value, jacobian = self._distort(plane)
        error = (value - target).norm(dim=-1)
        for _ in range(60):
            step = _solve(jacobian, value - target)
            best, best_error = plane, error
            for shrink in (1.0, 0.5, 0.125, 0.02):
                trial = plane - shrink * step
                trial = trial * torch.clamp(limit / trial.norm(dim=-1, keepdim=True).clamp_min(1e-300), max=1.0)
                trial_error = (self._distort(trial)[0] - target).norm(dim=-1)
                better = trial_error < best_error
                best = torch.where(better[..., None], trial, best)
                best_error = torch.where(better, trial_error, best_error)
                if bool((better | (error == 0)).all()):
                    break
            stalled = bool((best_error >= error).all())
            plane, error = best, best_error
            value, jacobian = self._distort(plane)
            if stalled:
                break
        return plane

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """Chain rule through the ideal plane; all terms closed."""
        plane, valid, z = self._plane(points)
        distorted, by_plane = self._distort(plane)
        matrix = self._matrix
        x, y = plane[..., 0], plane[..., 1]
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        ideal = torch.stack([torch.stack([one, zero, -x], -1), torch.stack([zero, one, -y], -1)], -2) / z[..., None, None]
        k4, k5, k6 = self.parameters[10:]
        r2 = x * x + y * y
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        q = (1 + r2 * (self.parameters[5] + r2 * (self.parameters[6] + r2 * self.parameters[9]))) / denominator
        powers = torch.stack([r2, r2**2, r2**3], -1)
        upper, lower = powers / denominator[..., None], -powers * (q / denominator)[..., None]
        tangential = torch.stack([torch.stack([2 * x * y, r2 + 2 * x * x], -1), torch.stack([r2 + 2 * y * y, 2 * x * y], -1)], -2)
        by_upper, by_lower = plane[..., :, None] * upper[..., None, :], plane[..., :, None] * lower[..., None, :]
        by_distortion = matrix @ torch.cat([by_upper[..., :2], tangential, by_upper[..., 2:], by_lower], -1)
        xd, yd = distorted[..., 0], distorted[..., 1]
        by_u = torch.stack([xd, zero, one, zero, yd], -1)
        by_v = torch.stack([zero, yd, zero, one, zero], -1)
        by_parameter = torch.cat([torch.stack([by_u, by_v], -2), by_distortion], -1)
        keep = valid[..., None, None]
        by_point = torch.where(keep, matrix @ by_plane @ ideal, 0.0)
        return distorted @ matrix.mT + self.parameters[2:4], valid, by_point, torch.where(keep, by_parameter, 0.0)


def _determinant(symmetric: Tensor) -> Tensor:
    """Determinants of symmetric 2x2 matrices, without the cost of a batched LU."""
    return symmetric[..., 0, 0] * symmetric[..., 1, 1] - symmetric[..., 0, 1] ** 2


def _solve(symmetric: Tensor, right: Tensor) -> Tensor:
    """x with A x = b for symmetric 2x2 matrices; b itself where A is singular."""
    a, b, c = symmetric[..., 0, 0], symmetric[..., 0, 1], symmetric[..., 1, 1]
    determinant = a * c - b * b
    singular = determinant.abs() < 1e-14
    safe = torch.where(singular, torch.ones_like(determinant), determinant)
    x, y = right[..., 0], right[..., 1]
    solution = torch.stack([c * x - b * y, a * y - b * x], -1) / safe[..., None]
    return torch.where(singular[..., None], right, solution)
