"""Equirectangular panorama: longitude and latitude are linear in the pixel; it has no parameters but the image size.

    longitude = atan2(x, z) = 2 pi ((u + 0.5) / W - 0.5),  latitude (down) = atan2(y, hypot(x, z)) = pi ((v + 0.5) / H - 0.5)

For projection, not calibrated. The image is periodic in u: `project` answers with -0.5 <= u <= W - 0.5, `unproject` takes any u.
Valid everywhere but at the two poles (x = z = 0), each of which is a whole row of the image.
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


class Equirectangular(CameraModel):
    """A panorama of W x H pixels that covers the whole sphere; its middle looks along +z."""

    NAME = "equirectangular"
    PARAMETER_NAMES = ()
    CALIBRATED = False
    PERIODIC = True

    @classmethod
    def from_mapping(cls, parameters: Mapping[str, float], image_size: tuple[int, int]) -> "Equirectangular":
        """The model of an image size; no parameter is expected."""
        return cls(named_vector(cls.PARAMETER_NAMES, parameters, cls.NAME), image_size)

    @classmethod
    def from_radial_curve(
        cls,
        rho_px: Float[Tensor, " n"],
        theta: Float[Tensor, " n"],
        centre: Float[Tensor, "2"],
        image_size: tuple[int, int],
        mirror: bool = False,
        **options: Any,
    ) -> "Equirectangular":
        """Raises InputError: there is nothing to fit."""
        raise InputError(
            "Camera model equirectangular has no parameters and is not calibrated, found a lens to fit it to; use a calibrated "
            "model such as scaramuzza."
        )

    @classmethod
    def examples(cls) -> Sequence["Equirectangular"]:
        """A panorama of 2:1 and one of odd sides."""
        return (cls([], (2048, 1024)), cls([], (1001, 501)))

    @property
    def max_angle(self) -> float:
        """pi: the whole sphere."""
        return math.pi

    @property
    def centre_px(self) -> Float[Tensor, "2"]:
        """The middle of the image."""
        return 0.5 * self._size - 0.5

    @property
    def _size(self) -> Tensor:
        return torch.tensor(self.image_size, dtype=torch.float64, device=self.parameters.device)

    @property
    def _pixels_per_radian(self) -> Tensor:
        return self._size / self._size.new_tensor([2 * math.pi, math.pi])

    def _project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        valid = (points[..., 0] != 0) | (points[..., 2] != 0)
        # A pole has no column of its own, and atan2(0, 0) no gradient: the middle of the image stands for it.
        x, y, z = torch.where(valid[..., None], points, points.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
        angles = torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], -1)
        return angles * self._pixels_per_radian + self.centre_px, valid

    def _unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        longitude, latitude = ((pixels - self.centre_px) / self._pixels_per_radian).unbind(-1)
        level = torch.cos(latitude)
        bearings = torch.stack([level * torch.sin(longitude), torch.sin(latitude), level * torch.cos(longitude)], -1)
        return bearings, latitude.abs() <= 0.5 * math.pi

    def unproject_jacobian(self, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 2"]:
        """In closed form, as the derivative of `project` has no limit at the poles.

        There a step in u leads nowhere, and beyond the centres of the first and last row no pixel tells where one leads: a place
        there moves sideways as it does at these centres. Else an end at a pole would count as known without any error.
        """
        longitude, latitude = ((pixels - self.centre_px) / self._pixels_per_radian).unbind(-1)
        sine, cosine, zero = torch.sin(longitude), torch.cos(longitude), torch.zeros_like(longitude)
        level = torch.cos(latitude).clamp_min(math.sin(0.5 * math.pi / self.image_size[1]))
        by_longitude = level[..., None] * torch.stack([cosine, zero, -sine], -1)
        by_latitude = torch.stack([-torch.sin(latitude) * sine, torch.cos(latitude), -torch.sin(latitude) * cosine], -1)
        return torch.stack([by_longitude, by_latitude], -1) / self._pixels_per_radian

    def project_with_jacobians(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*batch 2 3"], Float[Tensor, "*batch 2 p"]]:
        """d longitude = (z dx - x dz) / (x^2 + z^2), d latitude = (a dy - y da) / n^2 with a = hypot(x, z), n = |point|."""
        pixels, valid = self._project(points)
        x, y, z = torch.where(valid[..., None], points, torch.ones_like(points)).unbind(-1)
        a = torch.hypot(x, z)
        n2 = a * a + y * y
        by_longitude = torch.stack([z, torch.zeros_like(y), -x], -1) / (a * a)[..., None]
        by_latitude = torch.stack([-y * x / a, a, -y * z / a], -1) / n2[..., None]
        by_point = self._pixels_per_radian[:, None] * torch.stack([by_longitude, by_latitude], -2)
        return pixels, valid, torch.where(valid[..., None, None], by_point, 0.0), by_point.new_zeros(*pixels.shape, 0)
