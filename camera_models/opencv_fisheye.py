"""Kannala-Brandt fisheye camera, as OpenCV's `fisheye` module parametrises it, but also beyond 90 degrees off axis.

    theta = atan2(hypot(x, y), z),  r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    u = fx r x / hypot(x, y) + cx,  v = fy r y / hypot(x, y) + cy

J. Kannala and S. Brandt, A generic camera model and calibration method for conventional, wide-angle and fish-eye lenses,
PAMI 2006. Valid up to the first angle at which r stops growing, at most pi.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._equidistant import bearings_of_plane, clamped, grows_until, nearest_terms, scale_of, slopes_of
from camera_models._model import CameraModel
from camera_models._radial import angle_over_distance, named_vector
from camera_models.errors import InputError


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
        f, k = nearest_terms(rho_px, theta, 4)
        return cls([f, f, *centre.tolist(), *k], image_size)

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
        return grows_until(self.parameters.detach()[4:].tolist())

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """Principal point (cx, cy)."""
        return self.parameters[2:4]

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        theta, ratio, valid = clamped(*angle_over_distance(points), self.max_angle)
        scale = scale_of(points, self.parameters[4:].unbind(), theta, ratio, valid)
        pixels = self.parameters[:2] * points[..., :2] * scale[..., None] + self.parameters[2:4]
        return pixels, valid & (points.abs().sum(-1) > 0)

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        plane = (pixels - self.parameters[2:4]) / self.parameters[:2]
        return bearings_of_plane(plane, self.parameters[4:], self.max_angle)

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """By the chain rule through `slopes_of`."""
        theta, ratio, valid = clamped(*angle_over_distance(points), self.max_angle)
        x, y, _ = points.unbind(-1)
        valid = valid & (points.abs().sum(-1) > 0)
        fx, fy, cx, cy, *k = self.parameters.detach().tolist()
        t2 = theta * theta
        g, by_s, over = slopes_of(points, k, theta, ratio)
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
