"""One view out of the photos of cameras that stand beside each other: each direction from the camera that looks most at it.

A seam runs where a direction is equally far from the axes of two cameras. There their photos are blended, over a few degrees.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Shaped

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.pose import Pose
from camera_models.resampling import SamplingGrid, resample, sampling_grid
from camera_models.views import View, axis_from_camera


@dataclass(frozen=True)
class BlendedGrid:
    """Where the pixels of a view lie in the photos of several cameras, and how much each of them counts."""

    grids: tuple[SamplingGrid, ...]
    weights: Float[np.ndarray, "cameras h w"]
    """Single precision; they add up to 1, or to 0 where no camera sees anything."""

    @staticmethod
    def of(grid: SamplingGrid) -> "BlendedGrid":
        """Of a single photo."""
        return BlendedGrid((grid,), grid.valid[None].astype(np.float32))

    @property
    def shown_share(self) -> float:
        """Share of the view that is seen by some camera."""
        return float((self.weights.sum(0) > 0).mean())


def axis_from_rig(cameras: Sequence[CameraModel], cam_from_rig: Pose) -> Pose:
    """The frame of views of a whole rig: in the mean of its cameras' centres, looking along the optical axis of the first one."""
    turn = torch.as_tensor(axis_from_camera(cameras[0])) @ cam_from_rig.rotation[0]
    return Pose(turn, -(turn @ cam_from_rig.centre.mean(0)))


def blended_grid(
    view: View,
    cameras: Sequence[CameraModel],
    cam_from_axis: Pose,
    distance_m: float = math.inf,
    blend_deg: float = 4.0,
) -> BlendedGrid:
    """Pixels of a view in the photos of several cameras; `cam_from_axis` are these, from the frame that the view is turned in.

    Photos are blended over `blend_deg`, by how much farther a direction is from the axis of one camera than from that of the
    nearest. What lies at `distance_m` is seen once; what is nearer or farther is seen twice in the seam, by the distance between
    the cameras over its own. Raises InputError for a distance that is not above zero, an angle outside of 0 to 90 degrees, or
    an image that is too large.
    """
    if not distance_m > 0:
        raise InputError(f"`distance_m` was expected above 0, found {distance_m:g}; give metres, or leave it out for far away.")
    if not 0.0 < blend_deg <= 90.0:
        raise InputError(f"`blend_deg` was expected above 0 and up to 90 degrees, found {blend_deg:g}; give such an angle.")
    grids, off_axis = [], []
    bearings = _bearings(view.camera)
    for k, camera in enumerate(cameras):
        cam_from_view = cam_from_axis.rotation[k].numpy() @ view.view_from_axis.T
        grid = sampling_grid(view.camera, camera, cam_from_view, cam_from_axis.translation[k] / distance_m)
        axis = (axis_from_camera(camera) @ cam_from_view)[2].astype(np.float32)
        angle = np.degrees(np.arccos(np.clip(bearings @ axis, -1.0, 1.0)))
        grids.append(grid)
        off_axis.append(np.where(grid.valid, angle, np.float32(np.inf)))
    angles = np.stack(off_axis)
    nearest = angles.min(0)
    farther = angles - np.where(np.isfinite(nearest), nearest, 0.0)
    weights = np.clip(1.0 - farther / blend_deg, 0.0, 1.0).astype(np.float32)
    return BlendedGrid(tuple(grids), weights / np.maximum(weights.sum(0), 1e-12))


def blended(images: Sequence[Shaped[np.ndarray, "_ _ *channels"]], grid: BlendedGrid) -> Shaped[np.ndarray, "h w *channels"]:
    """The view out of photos of one instant, in the order of the cameras; what none shows is black.

    Raises InputError where a photo has not the size of its camera, or some are grey and others in colour.
    """
    if len(images) == 1:
        return resample(images[0], grid.grids[0])
    if len({(image.dtype, image.shape[2:]) for image in images}) > 1:
        raise InputError("Photos of one instant were expected all grey or all in colour, of equal depth; convert them.")
    total = np.zeros((*grid.weights.shape[1:], *images[0].shape[2:]), np.float32)
    for image, own, weight in zip(images, grid.grids, grid.weights, strict=True):
        total += weight.reshape(weight.shape + (1,) * (image.ndim - 2)) * resample(image, own)
    return np.rint(total).astype(images[0].dtype)


def _bearings(camera: CameraModel) -> Float[np.ndarray, "h w 3"]:
    """Of all pixels, single precision."""
    width, height = camera.image_size
    with torch.no_grad():
        u, v = torch.arange(width, dtype=torch.float64), torch.arange(height, dtype=torch.float64)
        bearings, _ = camera.unproject(torch.stack(torch.meshgrid(u, v, indexing="xy"), -1))
    return bearings.numpy().astype(np.float32)
