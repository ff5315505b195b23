"""Arcs as curves of points in a photo, and which points of two sets of curves lie beside each other."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from camera_models import CameraModel
from omnilines.geometry.sphere import angle_between, arc_normal, points_on_arc

SPACING_PX = 0.5
WITHIN_PX = 1.0
PARALLEL_DEG = 10.0
"""Arcs that cross an edge do not lie on it."""
_COARSE = 64
"""Points of a curve from which its length in pixels is estimated first."""


@dataclass(frozen=True)
class Curves:
    """Curves in a photo as points SPACING_PX apart: owner, pixel, unit tangent and the length that the point stands for."""

    owner: Int[np.ndarray, " n"]
    pixel: Float[np.ndarray, "n 2"]
    tangent: Float[np.ndarray, "n 2"]
    length: Float[np.ndarray, " n"]


def on_arrays(function: Callable[..., torch.Tensor], *arrays: np.ndarray) -> np.ndarray:
    """A function of tensors on arrays."""
    return function(*(torch.as_tensor(array) for array in arrays)).numpy()


def normalised(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Brought to length one."""
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def photo_curves(camera: CameraModel, ends: Float[np.ndarray, "n 2 3"]) -> Curves:
    """Arcs between bearings as points in the photo."""
    count = len(ends)
    coarse = on_arrays(points_on_arc, ends[:, 0], ends[:, 1], np.linspace(0.0, 1.0, _COARSE + 1))
    with torch.no_grad():
        pixel, _ = camera.project(coarse)
    length = np.linalg.norm(_steps(camera, pixel), axis=-1).sum(-1)
    each = np.maximum(np.ceil(length / SPACING_PX), 2).astype(np.int64)
    owner = np.repeat(np.arange(count), each)
    place = (np.arange(len(owner)) - np.repeat(np.cumsum(each) - each, each) + 0.5) / each[owner]
    # Three points about each place: its pixel, and the direction and length of its step.
    share = place[:, None] + np.array([-0.5, 0.0, 0.5]) / each[owner, None]
    normal = on_arrays(arc_normal, ends[:, 0], ends[:, 1])[owner]
    first = ends[owner, 0]
    angle = on_arrays(angle_between, ends[:, 0], ends[:, 1])[owner, None] * share
    rays = np.cos(angle)[..., None] * first[:, None] + np.sin(angle)[..., None] * np.cross(normal, first)[:, None]
    with torch.no_grad():
        pixel, _ = camera.project(rays)
    step = _steps(camera, pixel).sum(1)
    pace = np.linalg.norm(step, axis=-1)
    return Curves(owner, pixel[:, 1], step / np.maximum(pace, 1e-12)[:, None], pace)


def _steps(camera: CameraModel, pixel: Float[np.ndarray, "n k 2"]) -> Float[np.ndarray, "n k1 2"]:
    """Differences of neighbouring points, the shorter way round where the image closes."""
    step = np.diff(pixel, axis=1)
    if camera.PERIODIC:
        step[..., 0] -= camera.image_size[0] * np.round(step[..., 0] / camera.image_size[0])
    return step


def points_beside(camera: CameraModel, a: Curves, b: Curves) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Pairs of points of both sets of curves that lie beside each other."""
    if not (len(a.owner) and len(b.owner)):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    size, sets = None, [a.pixel, b.pixel]
    if camera.PERIODIC:
        # Only the columns close: far above the rows' number, the second period never matters.
        size = np.array([camera.image_size[0], 4.0 * camera.image_size[1]])
        sets = [np.mod(pixel + np.array([0.0, camera.image_size[1]]), size) for pixel in sets]
    reach = math.hypot(WITHIN_PX, SPACING_PX)
    trees = [cKDTree(points, boxsize=size) for points in sets]
    near = trees[0].sparse_distance_matrix(trees[1], reach, output_type="ndarray")
    i, j = near["i"].astype(np.int64), near["j"].astype(np.int64)
    across = np.stack([-b.tangent[j, 1], b.tangent[j, 0]], -1)
    step = a.pixel[i] - b.pixel[j]
    if camera.PERIODIC:
        step[:, 0] -= camera.image_size[0] * np.round(step[:, 0] / camera.image_size[0])
    distance = np.abs((step * across).sum(-1))
    parallel = np.abs((a.tangent[i] * b.tangent[j]).sum(-1)) >= math.cos(math.radians(PARALLEL_DEG))
    kept = (distance <= WITHIN_PX) & parallel
    return i[kept], j[kept]
