"""Bearings of many places in a photo.

They change smoothly from pixel to pixel: the camera model is asked for nodes STEP_PX apart, and bicubics through them give the
rest. Where fourth differences of the nodes say that the bicubics are not good enough, the model is asked for every place.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models import CameraModel
from omnilines.extraction.kernels.bearing import read_bearings, smooth_cells

STEP_PX = 16.0
MOST_ERROR_PX = 3e-4
"""Of places that are interpolated."""
_BEYOND = 3
"""Nodes around the image."""
_AHEAD = (0.0, 0.0, 1.0)
"""Stands for a bearing that is none."""
AT_A_TIME = 8_000
"""Places or rays of which the model is asked at a time: what lies below 32768 numbers torch does without threads of its own,
which burn more time than they save where every core looks at a photo already."""
FARTHEST_PX = 1e6
"""From the first pixel; a place beyond is taken to be there, and not seen. Compiled loops count places in whole numbers,
and a model with coefficients of any size may put one anywhere."""


def bearings_at(model: CameraModel, places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """`model.unproject` of places in or near the image, to MOST_ERROR_PX; the bearings have a length of 1 to the same share of
    a pixel's angle."""
    width, height = model.image_size
    if len(places) < (width / STEP_PX + 2 * _BEYOND) * (height / STEP_PX + 2 * _BEYOND):
        return _asked(model, places)
    origin = -_BEYOND * STEP_PX
    u, v = (np.arange(origin, side + _BEYOND * STEP_PX, STEP_PX) for side in (width, height))
    nodes, seen = _asked(model, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    node, seen = nodes.reshape(len(v), len(u), 3), seen.reshape(len(v), len(u))
    good = smooth_cells(node, seen, MOST_ERROR_PX / STEP_PX)
    bearings, valid = read_bearings(node, good, origin, STEP_PX, places)
    rows = np.flatnonzero(~valid)
    bearings[rows], valid[rows] = _asked(model, places[rows])
    return bearings, valid


def _asked(model: CameraModel, places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    bearings, valid = np.empty((len(places), 3)), np.zeros(len(places), dtype=bool)
    for start in range(0, len(places), AT_A_TIME):
        part = slice(start, start + AT_A_TIME)
        with torch.no_grad():
            bearings[part], valid[part] = model.unproject(places[part])
    lost = ~np.isfinite(bearings).all(-1)
    bearings[lost], valid[lost] = _AHEAD, False
    return bearings, valid


def pixels_at(model: CameraModel, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
    """`model.project` of many rays, finite and at most FARTHEST_PX away whatever the model."""
    flat = rays.reshape(-1, 3)
    pixels, valid = np.empty((len(flat), 2)), np.zeros(len(flat), dtype=bool)
    for start in range(0, len(flat), AT_A_TIME):
        part = slice(start, start + AT_A_TIME)
        with torch.no_grad():
            pixels[part], valid[part] = model.project(flat[part])
    valid &= (np.abs(pixels) <= FARTHEST_PX).all(-1)
    pixels = np.nan_to_num(pixels, copy=False, nan=FARTHEST_PX).clip(-FARTHEST_PX, FARTHEST_PX)
    return pixels.reshape(*rays.shape[:-1], 2), valid.reshape(rays.shape[:-1])
