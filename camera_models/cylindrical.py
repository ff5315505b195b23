"""Cylindrical panorama: longitude is linear in u, the tangent of latitude in v; upright lines stay straight.

    u = cx + fx lambda,  lambda = atan2(x, z);   v = cy + fy h,  h = y / hypot(x, z)

For projection, not calibrated. Where the width is 2 pi fx (to a millionth of a pixel) the image closes around the axis of the
cylinder and is periodic in u; a narrower one ends at lambda = +-pi. Valid everywhere but at the poles (x = z = 0), which are
infinitely far out, and, where the image is not closed, straight behind (x = 0, z < 0).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._model import CameraModel
from camera_models._radial import named_vector
from camera_models.errors import InputError

_CLOSED_PX = 1e-6


class Cylindrical(CameraModel):
    """A panorama on a cylinder round the camera's y axis; the pixel (cx, cy) looks along +z."""

    NAME = "cylindrical"
    PARAMETER_NAMES = ("fx", "fy", "cx", "cy")
    CALIBRATED = False

    @property
    def PERIODIC(self) -> bool:  # type: ignore[override]
        """Whether this instance goes all the way round."""
        return abs(2.0 * math.pi * float(self.parameters[0].detach()) - self.image_size[0]) < _CLOSED_PX

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Cylindrical":
        """The model of named parameters; focal lengths in pixels per radian and per unit of tan(latitude)."""
        values = named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME)
        if min(values[:2]) <= 0:
            raise InputError(f"Camera model {cls.NAME} expects fx and fy above 0, found {values[0]:g} and {values[1]:g}.")
        return cls(values, image_size)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "Cylindrical":
        """Raises InputError: no lens has this form."""
        raise InputError(
            "Camera model cylindrical is not calibrated, found a lens to fit it to; use a calibrated model such as scaramuzza."
        )

    @classmethod
    def examples(cls) -> Sequence["Cylindrical"]:
        """A closed panorama of square pixels in the middle, and one of odd sides and other pixels."""
        return (
            cls([1024 / math.pi, 1024 / math.pi, 1023.5, 383.5], (2048, 768)),
            cls([1001 / (2 * math.pi), 170.0, 497.3, 240.2], (1001, 501)),
        )

    @property
    def max_angle(self) -> float:
        """pi: all but the poles."""
        return math.pi

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """The pixel that looks along +z."""
        return self.parameters[2:]

    def calibration_basis(self) -> Float[Tensor, "p q"]:
        """No direction: nothing is estimated."""
        return torch.zeros(4, 0, dtype=torch.float64)

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        valid = (points[..., 0] != 0) | ((points[..., 2] != 0) if self.PERIODIC else (points[..., 2] > 0))
        x, y, z = torch.where(valid[..., None], points, points.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
        plane = torch.stack([torch.atan2(x, z), y / torch.hypot(x, z)], -1)
        return plane * self.parameters[:2] + self.parameters[2:], valid

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        longitude, height = ((pixels - self.parameters[2:]) / self.parameters[:2]).unbind(-1)
        rays = torch.stack([torch.sin(longitude), height, torch.cos(longitude)], -1)
        within = torch.ones_like(longitude, dtype=torch.bool) if self.PERIODIC else longitude.abs() < math.pi
        return rays / torch.sqrt(1.0 + height**2)[..., None], within

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """d lambda = (z dx - x dz) / a^2, d h = dy / a - y (x dx + z dz) / a^3 with a = hypot(x, z)."""
        pixels, valid = self._project(points)
        x, y, z = torch.where(valid[..., None], points, torch.ones_like(points)).unbind(-1)
        a = torch.hypot(x, z)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        by_longitude = torch.stack([z, zero, -x], -1) / (a * a)[..., None]
        by_height = torch.stack([-x * y / (a * a), one, -z * y / (a * a)], -1) / a[..., None]
        by_point = self.parameters[:2, None] * torch.stack([by_longitude, by_height], -2)
        longitude, height = torch.atan2(x, z), y / a
        by_parameter = torch.stack(
            [torch.stack([longitude, zero, one, zero], -1), torch.stack([zero, height, zero, one], -1)], -2
        )
        seen = valid[..., None, None]
        return pixels, valid, torch.where(seen, by_point, 0.0), torch.where(seen, by_parameter, 0.0)
