"""The map from the board to the photo around its corners, as a camera and a pose of the board have it."""

import numpy as np
import torch
from jaxtyping import Bool, Float

from calib_patterns.local_map import LocalMap
from camera_models._model import CameraModel
from camera_models.pose import Pose

_STEP = 0.02
"""Step of the numerical derivatives along the board, in spacings: they are exact to some 1e-6 px."""


def camera_map(
    model: CameraModel, cam_from_board: Pose, points_m: Float[np.ndarray, "n 3"], spacing_m: float, sigma_px: float
) -> tuple[LocalMap, Bool[np.ndarray, " n"]]:
    """The map at some points of the board, its derivatives by spacings, and which points the camera sees with their surroundings.

    `sigma_px` is what the camera is thought to be right to.
    """
    offsets = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=np.float64)
    around = points_m[:, None] + _STEP * spacing_m * offsets
    pixels, valid = projected(model, cam_from_board, around)
    at, right, left, down, up = np.moveaxis(pixels, 1, 0)
    first = np.stack([right - left, down - up], -1) / (2 * _STEP)
    second = np.stack([right - 2 * at + left, down - 2 * at + up], -1) / _STEP**2
    return LocalMap(at, first, second, np.full(len(points_m), sigma_px)), np.asarray(valid.all(1))


def projected(
    model: CameraModel, cam_from_board: Pose, points_m: Float[np.ndarray, "n k 3"]
) -> tuple[Float[np.ndarray, "n k 2"], Bool[np.ndarray, "n k"]]:
    """Pixels of points of the board, and which of them the camera sees."""
    with torch.no_grad():
        pixels, valid = model.project(cam_from_board.transform(torch.as_tensor(points_m.reshape(-1, 3))))
    return pixels.numpy().reshape(*points_m.shape[:2], 2), valid.numpy().reshape(points_m.shape[:2])
