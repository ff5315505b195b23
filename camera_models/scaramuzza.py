"""Scaramuzza's omnidirectional camera (OCamCalib), in the frame of this project.

    u - cx = x + e y,  v - cy = d x + c y,  rho = hypot(x, y),  bearing ~ (x, y, f(rho))
    f(rho) = a0 + a2 rho^2 + a3 rho^3 + ...   (a1 = 0; all in pixels)

D. Scaramuzza, A. Martinelli, R. Siegwart, A flexible technique for accurate omnidirectional camera calibration and structure
from motion, ICVS 2006. a0 > 0 for a camera that looks along +z, a0 < 0 for a mirror that looks along -z. OCamCalib's
coefficients have the opposite sign, its x is the row. Projection solves the polynomial to full accuracy.
Valid up to the radius at which theta(rho) stops growing, and at most RADIUS_LIMIT image radii.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._arrays import Array, as_tensor
from camera_models._model import CameraModel
from camera_models._radial import SMALL_SLOPE, first_sign_change, horner, invert_monotone, named_vector
from camera_models.errors import InputError
from camera_models.repeatable import least_squares

RADIUS_LIMIT = 4.0
"""The polynomial says nothing far outside the image: the domain ends at this many times the farthest image corner."""


class Scaramuzza(CameraModel):
    """Polynomial of any degree >= 2 with centre and affine matrix; parameters cx cy c d e a0 a2 a3 ... a_degree."""

    NAME = "scaramuzza"
    VARIANTS = tuple({"degree": degree} for degree in range(3, 9))
    NESTED_VARIANTS = True
    AXIS_SIGN_OPEN = True

    def __init__(self, parameters: Array | Sequence[float | int], image_size: tuple[int, int], *, trial: bool = False) -> None:
        self.parameters = as_tensor(parameters)
        if self.parameters.ndim != 1 or len(self.parameters) < 7:
            raise InputError(
                f"Camera model scaramuzza expects cx cy c d e a0 a2 and possibly a3 a4 ..., found {len(self.parameters)} "
                "numbers; give at least 7."
            )
        self.degree = len(self.parameters) - 5
        self.PARAMETER_NAMES = names_of_degree(self.degree)
        super().__init__(parameters, image_size, trial=trial)
        c, d, e, *a = self.parameters[2:]
        one, zero = torch.ones_like(c), torch.zeros_like(c)
        # Made here, not on first use: that may lie inside a `no_grad` block and would then cut the gradients for good.
        self._affine = torch.stack([torch.stack([one, e]), torch.stack([d, c])])
        self._coefficients = [a[0], zero, *a[1:]]
        self._numbers = torch.stack([part.detach() for part in self._coefficients]).cpu().numpy()

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Scaramuzza":
        """The model of named parameters; the highest a_k present sets the degree, c d e default to 1 0 0, a_k between to 0."""
        orders = [int(name[1:]) for name in parameters if name[:1] == "a" and name[1:].isdigit()]
        names = names_of_degree(max([2, *orders]))
        values = {"c": 1.0, **parameters}
        optional = ("c", "d", "e", *names[6:])
        return cls(named_vector(names, values, cls.NAME, optional), image_size)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        *,
        degree: int = 4,
        **options: Any,
    ) -> "Scaramuzza":
        """Least squares for f(rho) sin(theta) = rho cos(theta), of as high a degree as keeps theta growing over the samples."""
        scale, top = float(rho_px.max()), float(rho_px.max())
        sign = -1.0 if mirror else 1.0
        for order in range(degree, 1, -1):
            powers = (rho_px / scale)[:, None] ** torch.tensor([0, *range(2, order + 1)], dtype=theta.dtype)
            weights = torch.sin(theta)[:, None]
            a = least_squares(powers * weights, (rho_px * torch.cos(theta))[:, None])[:, 0]
            a = a / torch.tensor([scale**k for k in (0, *range(2, order + 1))], dtype=a.dtype)
            padded = torch.cat([a, torch.zeros(degree - order, dtype=a.dtype)])
            model = cls(torch.cat([centre, torch.tensor([1.0, 0.0, 0.0], dtype=a.dtype), sign * padded]), image_size)
            if float(a[0]) > 0 and model.max_radius_px > 1.02 * top:
                return model
        a0 = float((rho_px * torch.cos(theta) * torch.sin(theta)).sum() / (torch.sin(theta) ** 2).sum())
        return cls([*centre.tolist(), 1.0, 0.0, 0.0, sign * (abs(a0) or scale), *([0.0] * (degree - 1))], image_size)

    @classmethod
    def examples(cls) -> Sequence["Scaramuzza"]:
        """A 190 degree lens, a 220 degree lens with a slanted chip, a mirror camera, and degrees 2 and 6."""
        return (
            cls([543.8, 377.8, 0.9989, 0.0003, -0.0004, 338.4, -1.2e-3, 1.27e-6, -2.85e-9], (1032, 778)),
            cls([640.2, 480.7, 1.0004, 0.0021, -0.0017, 361.0, -1.55e-3, 5.0e-7, -1.9e-9], (1280, 960)),
            cls([318.2, 241.5, 0.9997, 0.0001, 0.0002, -121.0, 2.4e-3, -1.0e-6, 2.0e-9], (640, 480)),
            cls([400.0, 300.0, 1.0, 0.0, 0.0, 420.0, -6.0e-4], (801, 601)),
            cls([639.5, 479.5, 1.0, 0.0, 0.0, 340.0, -1.1e-3, 2e-7, -4e-10, -1e-13, -1e-16], (1280, 960)),
        )

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """All but the rotation about the axis, which free poses absorb: e = d, the symmetric affine form."""
        p = len(self.PARAMETER_NAMES)
        basis = torch.eye(p, dtype=torch.float64)
        basis[4, 3] = 1.0
        return basis[:, [i for i in range(p) if i != 4]]

    def calibrated_form(self) -> "Scaramuzza":
        """The same camera turned about its axis until its affine matrix is symmetric (e = d).

        With A = [[1, e], [d, c]] and a turn R by alpha, tan(alpha) = (d - e) / (1 + c), A R' = k [[1, e'], [e', c']] has the
        polar form. Plane coordinates become k R (x, y), so that a_j turns into k^(1-j) a_j and every bearing is turned by R
        about z.
        """
        cx, cy, c, d, e, *a = self.parameters.detach().tolist()
        alpha = math.atan2(d - e, 1.0 + c)
        cos, sin = math.cos(alpha), math.sin(alpha)
        k = cos - e * sin
        shear = (sin + e * cos) / k
        orders = (0, *range(2, self.degree + 1))
        scaled = [value * k ** (1 - order) for order, value in zip(orders, a, strict=True)]
        return Scaramuzza([cx, cy, (d * sin + c * cos) / k, shear, shear, *scaled], self.image_size)

    def reversed(self) -> "Scaramuzza":
        """f(rho) with the opposite sign."""
        return Scaramuzza(torch.cat([self.parameters[:5], -self.parameters[5:]]), self.image_size)

    @property
    def variant(self) -> Mapping[str, int]:
        """Its degree."""
        return {"degree": self.degree}

    def of_variant(self, variant: Mapping[str, int], rho_px: Float[Tensor, " n"]) -> "Scaramuzza":
        """The polynomial of another degree that is nearest to this one at some radii."""
        degree = variant["degree"]
        if degree >= self.degree:
            return Scaramuzza([*self.parameters.tolist(), *([0.0] * (degree - self.degree))], self.image_size)
        theta = torch.atan2(rho_px, self.sign * self._height(rho_px))
        near = self.from_radial_curve(rho_px, theta, self.centre_px, self.image_size, mirror=self.sign < 0, degree=degree)
        return Scaramuzza(torch.cat([self.parameters[:5], near.parameters[5:]]), self.image_size)

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """(cx, cy), the image of the axis."""
        return self.parameters[:2]

    @property
    def sign(self) -> float:
        """+1 for a camera that looks along +z, -1 for a mirror (a0 < 0)."""
        return 1.0 if self._numbers[0] >= 0 else -1.0

    @cached_property
    def max_radius_px(self) -> float:
        """First rho with d theta / d rho = 0, that is f = rho f', or RADIUS_LIMIT image radii."""
        a = self.sign * self._numbers
        growth = a * (1 - np.arange(len(a)))
        return min(first_sign_change(growth, self.image_radius_px), RADIUS_LIMIT * self.image_radius_px)

    @cached_property
    def max_angle(self) -> float:
        """theta at `max_radius_px`, from the bearing of the centre pixel."""
        rho = self.max_radius_px
        return math.atan2(rho, self.sign * float(np.polynomial.polynomial.polyval(rho, self._numbers)))

    def _height(self, rho: Tensor) -> Tensor:
        """f, with gradients."""
        return horner(self._coefficients, rho)

    def _height_and_slope(self, rho: Tensor) -> tuple[Tensor, Tensor]:
        """f and f', without gradients by the parameters."""
        numbers = self._numbers.tolist()
        return horner(numbers, rho), horner([k * c for k, c in enumerate(numbers)][1:], rho)

    def _radius(self, sine: Tensor, cosine: Tensor) -> Tensor:
        """rho of a ray at theta from the centre pixel's bearing, (sine, cosine) of any scale; the domain's end where beyond."""
        numbers = (self.sign * self._numbers).tolist()
        # f - rho f' = sum (1 - k) a_k rho^k.
        growth = [(1 - k) * c for k, c in enumerate(numbers)]

        def angle(rho: Tensor) -> tuple[Tensor, Tensor]:
            f = horner(numbers, rho)
            return torch.atan2(rho, f), horner(growth, rho) / (rho * rho + f * f)

        with torch.no_grad():
            return invert_monotone(angle, torch.atan2(sine, cosine), self.max_radius_px)

    def _solve(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """(rho, rho / s, valid, s2, near) of points, without gradients."""
        with torch.no_grad():
            x, y, depth = points.unbind(-1)
            s2, z = x * x + y * y, self.sign * depth
            near = (z > 0) & (s2 < (SMALL_SLOPE * z) ** 2)
            s = s2.sqrt()
            rho = self._radius(s, z)
            valid = (torch.atan2(s, z) <= self.max_angle) & ((s2 > 0) | (z > 0))
            over = rho / torch.where(s2 > 0, s, 1.0)
            if bool(near.any()):
                height = self.sign * self._height_and_slope(rho)[0]
                over = torch.where(near, height / torch.where(near, z, 1.0), over)
        return rho, over, valid, s2, near

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        rho, _, valid, _, near = self._solve(points)
        s2 = (points[..., :2] ** 2).sum(-1)
        z = points[..., 2]
        s = torch.where(near | (s2 == 0), torch.ones_like(s2), s2).sqrt()
        # One Newton step on h = rho z - s f(rho) with gradients: the implicit-function theorem, exact at the solution.
        f, (_, slope) = self._height(rho), self._height_and_slope(rho)
        steep = (z - s * slope).detach()
        stepped = rho - (rho * z - s * f) / torch.where(steep == 0, torch.ones_like(steep), steep)
        rho = torch.where(valid & ~near, stepped, rho)
        over = torch.where(near, self._height(rho) / torch.where(near, z, torch.ones_like(z)), rho / s)
        pixels = (points[..., :2] * over[..., None]) @ self._affine.mT + self.parameters[:2]
        return pixels, valid

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        inverse, singular = torch.linalg.inv_ex(self._affine)
        plane = (pixels - self.parameters[:2]) @ inverse.mT
        rho2 = (plane**2).sum(-1)
        zero = rho2 == 0
        rho = torch.where(zero, torch.ones_like(rho2), rho2).sqrt()
        rho = torch.where(zero, torch.zeros_like(rho), rho)
        valid = rho <= self.max_radius_px
        if not bool(valid.all()):
            # Drawn back to the edge of the domain: far outside the polynomial overflows.
            back = torch.where(valid, 1.0, self.max_radius_px / rho)
            plane, rho = plane * back[..., None], rho.clamp(max=self.max_radius_px)
        ray = torch.cat([plane, self._height(rho)[..., None]], -1)
        length = ray.norm(dim=-1, keepdim=True)
        known = (singular == 0) & (length > 0) & torch.isfinite(length)
        if not bool(known.all()):
            # Of numbers that no lens has: the polynomial vanishes or overflows inside of the image.
            ray = torch.where(known, ray, ray.new_tensor([0.0, 0.0, 1.0]))
            length, valid = torch.where(known, length, 1.0), valid & known[..., 0]
        return ray / length, valid

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """From h = rho z - s f(rho) = 0: d rho = (f ds - rho dz + s df) / (z - s f'); x = m rho / s, pixel = A x + c."""
        rho, over, valid, s2, near = self._solve(points)
        x, y, z = points.unbind(-1)
        cx, cy, c, d, e = self.parameters.detach()[:5].tolist()
        f, slope = self._height_and_slope(rho)
        s = s2.sqrt()
        steep = z - s * slope
        inverse = 1 / torch.where(steep == 0, 1.0, steep)
        # (d rho / d s - rho / s) / s, zero on the axis where m m' vanishes anyway.
        by_s = torch.where(near | (s2 == 0), 0.0, (f * inverse - over) / s2.clamp_min(1e-300))
        xx, xy, yy, by_z = over + x * x * by_s, x * y * by_s, over + y * y * by_s, -over * inverse
        by_u = [xx + e * xy, xy + e * yy, (x + e * y) * by_z]
        by_v = [d * xx + c * xy, d * xy + c * yy, (d * x + c * y) * by_z]
        by_point = torch.stack([*by_u, *by_v], -1).unflatten(-1, (2, 3))
        px, py = x * over, y * over
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        # d rho / d a_k = s rho^k / steep.
        powers = [inverse, inverse * rho * rho]
        while len(powers) < self.degree:
            powers.append(powers[-1] * rho)
        ux, vx = x + e * y, d * x + c * y
        columns = [one, zero, zero, zero, py, *(ux * power for power in powers)]
        columns += [zero, one, py, px, zero, *(vx * power for power in powers)]
        by_parameter = torch.stack(columns, -1).unflatten(-1, (2, 5 + self.degree))
        pixels = torch.stack([px + e * py + cx, d * px + c * py + cy], -1)
        if bool(valid.all()):
            return pixels, valid, by_point, by_parameter
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)


def names_of_degree(degree: int) -> tuple[str, ...]:
    """cx cy c d e a0 a2 a3 ... a_degree."""
    return ("cx", "cy", "c", "d", "e", "a0", *(f"a{k}" for k in range(2, degree + 1)))
