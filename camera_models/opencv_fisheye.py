"""Kannala-Brandt fisheye camera, as OpenCV's `fisheye` module parametrises it, but also beyond 90 degrees off axis.

    theta = atan2(hypot(x, y), z),  r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    u = fx r x / hypot(x, y) + cx,  v = fy r y / hypot(x, y) + cy

J. Kannala and S. Brandt, A generic camera model and calibration method for conventional, wide-angle and fish-eye lenses,
PAMI 2006. Valid up to the first angle at which r stops growing, at most pi.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._model import CameraModel
from camera_models._radial import angle_over_distance, first_sign_change, invert_monotone, named_vector
from camera_models.errors import InputError
from camera_models.repeatable import least_squares


class OpenCVFisheye(CameraModel):
    """u = fx r(theta) cos(phi) + cx, v = fy r(theta) sin(phi) + cy with r an odd polynomial of degree 9."""

    NAME = "opencv-fisheye"
    OPTIONAL_TERMS = (("k1",), ("k2",), ("k3",), ("k4",))
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "OpenCVFisheye":
        """The model of named parameters; k1 to k4 may be left out."""
        return cls(named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME, optional=("k1", "k2", "k3", "k4")), image_size)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "OpenCVFisheye":
        """Least squares for f and f k_i, of as high a degree as keeps the curve growing over the samples."""
        if mirror:
            raise InputError(
                "Camera model opencv-fisheye expects a lens that looks along +z, found `mirror`; use `model` scaramuzza."
            )
        top = float(theta.max())
        for terms in (5, 4, 3, 2, 1):
            powers = theta[:, None] ** (2 * torch.arange(terms, dtype=theta.dtype) + 1)
            scale = powers.norm(dim=0)
            solution = least_squares(powers / scale, rho_px[:, None])[:, 0] / scale
            f = float(solution[0])
            if f > 0:
                k = [*(solution[1:] / f).tolist(), 0.0, 0.0, 0.0, 0.0][:4]
                model = cls([f, f, *centre.tolist(), *k], image_size)
                if model.max_angle > 1.02 * top:
                    return model
        f = float((rho_px * theta).sum() / (theta * theta).sum())
        return cls([f, f, *centre.tolist(), 0.0, 0.0, 0.0, 0.0], image_size)

    @classmethod
    def examples(cls) -> Sequence["OpenCVFisheye"]:
        """A 190 degree lens, a 220 degree lens, a phone add-on whose curve turns over, and an ideal equidistant lens."""
        return (
            cls([320.0, 321.0, 639.5, 479.5, -0.012, 0.004, -0.002, 0.0002], (1280, 960)),
            cls([285.0, 286.0, 642.1, 398.7, 0.01, -0.006, 0.0015, -0.0002], (1280, 800)),
            cls([700.0, 698.0, 950.0, 545.0, -0.05, -0.01, 0.0, 0.0], (1920, 1080)),
            cls([400.0, 400.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0], (1001, 1001)),
        )

    @cached_property
    def max_angle(self) -> float:
        """First theta with dr / dtheta = 0, or pi."""
        k = self.parameters.detach()[4:].tolist()
        slope = np.array([1.0, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])
        return math.sqrt(min(first_sign_change(slope, 1.0), math.pi**2))

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    def _clamped(self, theta: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        valid = theta < self.max_angle if self.max_angle >= math.pi else theta <= self.max_angle
        used = torch.where(valid, theta, torch.full_like(theta, self.max_angle))
        return used, torch.where(valid, ratio, used * ratio / theta.clamp_min(1e-300)), valid

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        theta, ratio = angle_over_distance(points)
        theta, ratio, valid = self._clamped(theta, ratio)
        s2 = (points[..., :2] ** 2).sum(-1)
        # theta^2 = ratio^2 s2 keeps the gradient on the axis; beyond max_angle the clamped angle is a constant.
        t2 = torch.where(valid, ratio**2 * s2, theta * theta)
        scale = ratio * _factor(self.parameters[4:].unbind(), t2)
        pixels = self.parameters[:2] * points[..., :2] * scale[..., None] + self.parameters[2:4]
        return pixels, valid & (points.abs().sum(-1) > 0)

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        plane = (pixels - self.parameters[2:4]) / self.parameters[:2]
        r2 = (plane**2).sum(-1)
        zero = r2 == 0
        r = torch.where(zero, torch.ones_like(r2), r2).sqrt()
        radius = torch.where(zero, torch.zeros_like(r), r)
        with torch.no_grad():
            numbers = self.parameters[4:].tolist()
            theta = invert_monotone(lambda angle: _curve(numbers, angle), radius, self.max_angle)
            limit, _ = _curve(numbers, torch.tensor(self.max_angle, dtype=r.dtype, device=r.device))
        # One more Newton step with gradients: the implicit-function theorem, exact at the solution.
        value, slope = _curve(self.parameters[4:].unbind(), theta)
        valid = (radius <= limit) if self.max_angle < math.pi else (radius < limit)
        # At the rim the slope is zero: there the solution itself is kept and carries no gradient.
        step = torch.where(valid & (slope > 1e-12), (value - radius) / slope.detach().clamp_min(1e-12), torch.zeros_like(value))
        theta = theta - step
        sin_over_r = torch.where(zero, torch.ones_like(r), torch.sin(theta) / r)
        bearings = torch.cat([plane * sin_over_r[..., None], torch.cos(theta)[..., None]], -1)
        return bearings, valid

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """With g = r / s: d g / d s = (r' z / n^2 - g) / s and d g / d z = -r' / n^2, n = |point|."""
        theta, ratio = angle_over_distance(points)
        theta, ratio, valid = self._clamped(theta, ratio)
        x, y, z = points.unbind(-1)
        s2 = x * x + y * y
        n2 = s2 + z * z
        valid = valid & (points.abs().sum(-1) > 0)
        fx, fy, cx, cy, *k = self.parameters.detach().tolist()
        t2 = theta * theta
        slope = _slope(k, t2)
        g = ratio * _factor(k, t2)
        over = slope / n2.clamp_min(1e-300)
        by_s = torch.where(s2 > 0, (over * z - g) / s2.clamp_min(1e-300), 0.0)
        xy = x * y * by_s
        by_u = [fx * (g + x * x * by_s), fx * xy, -fx * x * over]
        by_v = [fy * xy, fy * (g + y * y * by_s), -fy * y * over]
        by_point = torch.stack([*by_u, *by_v], -1).unflatten(-1, (2, 3))
        mx, my = x * g, y * g
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        first = ratio * t2
        u1, v1 = fx * x * first, fy * y * first
        u2, v2 = u1 * t2, v1 * t2
        u3, v3 = u2 * t2, v2 * t2
        columns = [mx, zero, one, zero, u1, u2, u3, u3 * t2, zero, my, zero, one, v1, v2, v3, v3 * t2]
        by_parameter = torch.stack(columns, -1).unflatten(-1, (2, 8))
        pixels = torch.stack([fx * mx + cx, fy * my + cy], -1)
        if bool(valid.all()):
            return pixels, valid, by_point, by_parameter
        keep = valid[..., None, None]
        return pixels, valid, torch.where(keep, by_point, 0.0), torch.where(keep, by_parameter, 0.0)


def _factor(k: Sequence[Tensor] | Sequence[float], t2: Tensor) -> Tensor:
    """r / theta of theta^2."""
    return 1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))


def _curve(k: Sequence[Tensor] | Sequence[float], theta: Tensor) -> tuple[Tensor, Tensor]:
    """r and dr / dtheta."""
    t2 = theta * theta
    return theta * _factor(k, t2), _slope(k, t2)


def _slope(k: Sequence[Tensor] | Sequence[float], t2: Tensor) -> Tensor:
    """dr / dtheta of theta^2."""
    return 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * (9 * k[3]))))
