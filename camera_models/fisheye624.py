"""Fisheye with decentring and thin prism terms: fisheye624 of Project Aria, COLMAP's RAD_TAN_THIN_PRISM_FISHEYE.

    theta = atan2(hypot(x, y), z),  r = theta (1 + k0 theta^2 + k1 theta^4 + ... + k5 theta^12)
    d = r (x, y) / hypot(x, y),  p = (p0, p1)
    T = d + 2 (p . d) d + r^2 p + (s0 r^2 + s1 r^4, s2 r^2 + s3 r^4)
    u = fx T_x + cx,  v = fy T_y + cy

Project Aria documentation, "Camera intrinsic models". Valid up to the first angle at which r stops growing, or at which T may
fold, at most pi.

A calibration estimates k0 to k3 and p unless more is asked for: to second order in theta s0 = -3 p0 and s2 = -3 p1 are a turn of
the camera with a shift of its centre, so that with s too the axis, and where cameras of a rig look, are hardly known.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._coefficients import WithCoefficients
from camera_models._equidistant import bearings_of_plane, clamped, curve, grows_until, nearest_terms, scale_of, slopes_of
from camera_models._radial import angle_over_distance, invert_monotone, named_vector
from camera_models._sphere import refuse_mirror
from camera_models._thin_prism import displaced, one_to_one_until, replaced, step_back

_MORE = {6: (), 8: ("s0", "s2"), 12: ("k4", "k5", "s0", "s1", "s2", "s3")}
"""What a calibration estimates beside fx fy cx cy k0 k1 k2 k3 p0 p1, by the number of its coefficients."""


class Fisheye624(WithCoefficients):
    """An odd polynomial of degree 13 in theta, then a map of the plane; all zero but fx fy cx cy is the equidistant lens."""

    NAME = "fisheye624"
    COEFFICIENTS = tuple(_MORE)
    VARIANTS = ({"coefficients": 6},)
    OPTIONAL_TERMS = (("k0",), ("k1",), ("p0", "p1"), ("k2",), ("k3",), ("s0", "s2"), ("k4", "k5", "s1", "s3"))
    PARAMETER_NAMES = (
        *("fx", "fy", "cx", "cy"), *("k0", "k1", "k2", "k3", "k4", "k5"), *("p0", "p1"), *("s0", "s1", "s2", "s3"),
    )  # fmt: skip

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Fisheye624":
        """The model of named parameters; distortion may be left out and is zero."""
        values = named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME, optional=cls.PARAMETER_NAMES[4:])
        present = {name for name in _MORE[12] if parameters.get(name, 0.0) != 0.0}
        return cls(values, image_size, next(count for count, more in _MORE.items() if present <= {*more}))

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        *,
        coefficients: int = 6,
        **options: Any,
    ) -> "Fisheye624":
        """Least squares for f and f k_i, of as high a degree as keeps the curve growing over the samples."""
        refuse_mirror(cls.NAME, mirror)
        f, k = nearest_terms(rho_px, theta, 4)
        return cls([f, f, *centre.tolist(), *k, *([0.0] * 8)], image_size, coefficients)

    @classmethod
    def examples(cls) -> Sequence["Fisheye624"]:
        """A lens as Project Aria's devices have, a 220 degree lens with a decentred element, a 190 degree lens behind a plate
        that is not level, and an ideal equidistant lens."""
        aria = [0.4, -0.42, 0.21, 0.06, -0.09, 0.023, 3e-4, -2e-4, 1.2e-3, -4e-4, -8e-4, 2e-4]
        return (
            cls([609.3, 609.3, 714.2, 703.8, *aria], (1408, 1408), 12),
            cls([285.0, 286.0, 642.1, 398.7, 0.01, -0.006, 0.0015, -0.0002, 0.0, 0.0, 2e-3, -1e-3, *([0.0] * 4)], (1280, 800)),
            cls([320.0, 321.0, 639.5, 479.5, -0.012, 0.004, -0.002, 2e-4, 0, 0, 0, 0, 3e-3, -5e-4, -2e-3, 4e-4], (1280, 960), 8),
            cls([400.0, 400.0, 500.0, 500.0, *([0.0] * 12)], (1001, 1001)),
        )

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """fx fy cx cy and the chosen number of distortion coefficients."""
        held = {*_MORE[12]} - {*_MORE[self.coefficients]}
        free = [index for index, name in enumerate(self.PARAMETER_NAMES) if name not in held]
        return torch.eye(len(self.PARAMETER_NAMES), dtype=torch.float64)[:, free]

    @cached_property
    def max_angle(self) -> float:
        """First theta with dr / dtheta = 0, or at which T may fold, or pi."""
        k, plane = self.parameters.detach()[4:10].tolist(), self.parameters.detach()[10:].tolist()
        largest, radius = grows_until(k), one_to_one_until(plane)
        limit, _ = curve(k, torch.tensor(largest, dtype=torch.float64))
        if radius >= float(limit):
            return largest
        return float(invert_monotone(lambda angle: curve(k, angle), torch.tensor(radius, dtype=torch.float64), largest))

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        theta, ratio, valid = clamped(*angle_over_distance(points), self.max_angle)
        scale = scale_of(points, self.parameters[4:10].unbind(), theta, ratio, valid)
        at = displaced(self.parameters[10:].unbind(), points[..., 0] * scale, points[..., 1] * scale)
        pixels = self.parameters[:2] * torch.stack([at.x, at.y], -1) + self.parameters[2:4]
        return pixels, valid & (points.abs().sum(-1) > 0)

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        target = (pixels - self.parameters[2:4]) / self.parameters[:2]
        k, terms = self.parameters[4:10], self.parameters[10:]
        with torch.no_grad():
            limit, _ = curve(k.tolist(), torch.tensor(self.max_angle, dtype=torch.float64))
            flat, found = replaced(terms.tolist(), float(limit), target.reshape(-1, 2))
            d, found = flat.view(target.shape), found.view(target.shape[:-1])
            at = displaced(terms.tolist(), d[..., 0], d[..., 1])
        # One more Newton step with gradients: the implicit-function theorem, exact at the solution.
        value = displaced(terms.unbind(), d[..., 0], d[..., 1])
        step = torch.stack(step_back(at, value.x - target[..., 0], value.y - target[..., 1]), -1)
        # At the rim, where J may be singular, the solution itself is kept.
        bearings, valid = bearings_of_plane(d - torch.where(found[..., None], step, 0.0), k, self.max_angle)
        return bearings, valid & found

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """Chain rule through d: d = g (x, y), then T."""
        theta, ratio, valid = clamped(*angle_over_distance(points), self.max_angle)
        fx, fy, cx, cy, *rest = self.parameters.detach().tolist()
        k, terms = rest[:6], rest[6:]
        x, y, _ = points.unbind(-1)
        valid = valid & (points.abs().sum(-1) > 0)
        g, by_s, over = slopes_of(points, k, theta, ratio)
        dx, dy = x * g, y * g
        at = displaced(terms, dx, dy)
        pixels = torch.stack([fx * at.x + cx, fy * at.y + cy], -1)
        cross = x * y * by_s
        by_d = torch.stack([fx * at.xx, fx * at.xy, fy * at.yx, fy * at.yy], -1).unflatten(-1, (2, 2))
        d_by_point = torch.stack([g + x * x * by_s, cross, -x * over, cross, g + y * y * by_s, -y * over], -1)
        by_point = by_d @ d_by_point.unflatten(-1, (2, 3))
        zero, one, r2, t2 = torch.zeros_like(x), torch.ones_like(x), dx * dx + dy * dy, theta * theta
        radial = (ratio * t2)[..., None] * t2[..., None] ** torch.arange(6, dtype=t2.dtype, device=t2.device)
        by_k = (by_d @ points[..., :2, None]) * radial[..., None, :]
        by_u = [at.x, zero, one, zero, *(fx * part for part in (2 * dx * dx + r2, 2 * dx * dy, r2, r2 * r2, zero, zero))]
        by_v = [zero, at.y, zero, one, *(fy * part for part in (2 * dx * dy, 2 * dy * dy + r2, zero, zero, r2, r2 * r2))]
        others = torch.stack([*by_u, *by_v], -1).unflatten(-1, (2, 10))
        by_parameter = torch.cat([others[..., :4], by_k, others[..., 4:]], -1)
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)
