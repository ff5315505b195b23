"""The projection uncertainty of a camera over its image, as pages draw it and state it."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.image_field import MAP_STEPS, ImageField
from omnilines.calibration.uncertainty import (
    as_stated_px,
    most_stated_px,
    projection_covariance_px2,
    supported_grid,
    worst_sigma_px,
)


@runtime_checkable
class CertainCamera(Protocol):
    """A camera with a covariance of its parameters, and how far off axis the data reach."""

    @property
    def model(self) -> CameraModel: ...

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]: ...

    @property
    def min_angle_deg(self) -> float: ...

    @property
    def max_angle_deg(self) -> float: ...


@dataclass(frozen=True)
class UncertaintyMap:
    """Standard deviation of the projection in its worst direction, over a grid of pixels; NaN where the camera sees nothing."""

    u_px: Float[np.ndarray, " w"]
    v_px: Float[np.ndarray, " h"]
    sigma_px: Float[np.ndarray, "h w"]
    supported: Bool[np.ndarray, "h w"]
    """Within the field of view that the data support."""
    most_px: float
    """Above it a standard deviation is stated as not known."""

    @staticmethod
    def of(result: CertainCamera, field: ImageField | None = None) -> "UncertaintyMap":
        """The map of a calibration, at MAP_STEPS pixels along the longer side of its image; within a field, if one is known."""
        width, height = result.model.image_size
        step = max(width, height) / MAP_STEPS
        u, v = (np.arange(0.5 * min(step, side), side, step) - 0.5 for side in (width, height))
        pixels = torch.as_tensor(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
        low, high = float(np.radians(result.min_angle_deg)), float(np.radians(result.max_angle_deg))
        covariance, valid = _covariance_px2(result, pixels)
        angle = angles_off_axis(result.model, pixels)
        shown = torch.ones(len(pixels), dtype=torch.bool) if field is None else field.shows(pixels)
        sigma = torch.where(shown, worst_sigma_px(covariance), torch.nan)
        inside = valid & shown & (angle >= low) & (angle <= high)
        shape = len(v), len(u)
        most_px = most_stated_px(result.model)
        return UncertaintyMap(u, v, sigma.numpy().reshape(shape), inside.numpy().reshape(shape), most_px)

    def within(self, radius_px: float, centre_px: Float[np.ndarray, "2"]) -> "UncertaintyMap":
        """Not known beyond a circle, where photos are dark."""
        far = np.hypot(self.u_px - centre_px[0], (self.v_px - centre_px[1])[:, None]) > radius_px
        return replace(self, sigma_px=np.where(far, np.nan, self.sigma_px), supported=self.supported & ~far)

    @property
    def figures(self) -> tuple[float, float]:
        """Median and largest standard deviation (px) over the supported field of view."""
        inside = self.sigma_px[self.supported]
        return float(np.median(inside)), float(inside.max())

    @property
    def stated_figures(self) -> tuple[float, float]:
        """`figures` for people: infinite where they are stated as not known."""
        median, largest = (as_stated_px(value, self.most_px) for value in self.figures)
        return median, largest

    @property
    def stated_largest(self) -> tuple[float, tuple[float, float]]:
        """The largest standard deviation (px) of all the map, for people, and its pixel."""
        row, column = np.unravel_index(np.nanargmax(self.sigma_px), self.sigma_px.shape)
        return as_stated_px(float(self.sigma_px[row, column]), self.most_px), (float(self.u_px[column]), float(self.v_px[row]))

    @property
    def stated_px(self) -> Float[np.ndarray, "h w"]:
        """`sigma_px`, NaN too where it is stated as not known."""
        return np.where(self.sigma_px <= self.most_px, self.sigma_px, np.nan)


def sigma_at_px(result: CertainCamera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Standard deviation of the projection in its worst direction, at some pixels; NaN where the camera sees nothing."""
    covariance, _ = _covariance_px2(result, torch.as_tensor(pixels))
    return np.asarray(worst_sigma_px(covariance))


def _covariance_px2(result: CertainCamera, pixels: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2 2"], Bool[Tensor, " n"]]:
    low, high = float(np.radians(result.min_angle_deg)), float(np.radians(result.max_angle_deg))
    reference = supported_grid(result.model, high, low)
    return projection_covariance_px2(result.model, torch.as_tensor(result.covariance), pixels, reference)
