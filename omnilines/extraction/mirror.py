"""What a photo of a mirror shows beside the scene: its mount in the middle, and around it what the camera sees past its rim."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from camera_models import CameraModel
from omnilines.extraction.bearings import axis_of, bearings_at, pixels_at
from omnilines.extraction.image_circle import margin_px
from omnilines.extraction.options import ExtractionOptions

DIRECTIONS = 360
"""Around the centre."""
_BEYOND = 1.1
"""So many times as far off the centre as a cone is, a pixel is outside it, whichever way the sensor is tilted."""


def off_mount(model: CameraModel, points: Float32[np.ndarray, "n 4"], least_rad: float) -> Bool[np.ndarray, " n"]:
    """Which edge points lie at least so far off the bearing of the centre pixel."""
    result = np.ones(len(points), dtype=bool)
    if least_rad > 0.0:
        off = np.linalg.norm(points[:, :2] - _centre(model), axis=-1)
        near = np.flatnonzero(off < _BEYOND * _cone_px(model, least_rad).max())
        result[near] = bearings_at(model, points[near, :2].astype(np.float64))[0] @ axis_of(model) < np.cos(least_rad)
    return result


def within_rim(
    model: CameraModel, points: Float32[np.ndarray, "n 4"], most_rad: float, options: ExtractionOptions
) -> Bool[np.ndarray, " n"]:
    """Which edge points lie inside the rim of a mirror: all where none is found, and for a camera that looks forwards.

    Beyond `most_rad` off the bearing of the centre pixel, the innermost circle around that pixel on which edge points that
    follow it lie in nearly all directions, as far as the image goes: a line of the world is on it in few.
    """
    result = np.ones(len(points), dtype=bool)
    if axis_of(model)[2] >= 0.0 or not most_rad < model.max_angle:
        return result
    circle, way = options.image_circle, points[:, :2] - _centre(model)
    off = np.maximum(np.linalg.norm(way, axis=-1), 1e-9)
    begin = float(_cone_px(model, most_rad).min())
    follows = np.abs((way * points[:, 2:]).sum(-1)) > options.support.min_cosine * off
    rows = np.flatnonzero(follows & (off > begin))
    if not len(rows):
        return result
    # Rings of half the width that counts as one circle, each a direction at a time.
    ring = np.floor(np.log(off[rows] / begin) / np.log1p(circle.same_share)).astype(np.int64)
    direction = ((np.arctan2(way[rows, 1], way[rows, 0]) / (2.0 * np.pi) % 1.0) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    hit = np.zeros((ring.max() + 2, DIRECTIONS), dtype=bool)
    hit[ring, direction] = True
    radius = begin * (1.0 + circle.same_share) ** np.arange(1, len(hit))
    seen = _inside(model, radius)
    share = ((hit[:-1] | hit[1:]) & seen).sum(-1) / np.maximum(seen.sum(-1), 1)
    rims = np.flatnonzero((share > circle.min_rim) & (seen.mean(-1) >= circle.min_agreeing))
    return off < radius[rims[0]] - margin_px(radius[rims[0]], circle) if len(rims) else result


def _centre(model: CameraModel) -> Float[np.ndarray, "2"]:
    centre: Float[np.ndarray, 2] = model.centre_px.detach().numpy()
    return centre


def _cone_px(model: CameraModel, angle_rad: float) -> Float[np.ndarray, " n"]:
    """Distances from the centre of the pixels of rays at an angle off its bearing."""
    axis = axis_of(model)
    turn = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(axis, first)
    pixels, _ = pixels_at(model, np.cos(angle_rad) * axis + np.sin(angle_rad) * around)
    return np.linalg.norm(pixels - _centre(model), axis=-1)


def _inside(model: CameraModel, radius: Float[np.ndarray, " k"]) -> Bool[np.ndarray, "k d"]:
    """In which directions circles around the centre pass through the image."""
    turn = 2.0 * np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    pixels = _centre(model) + radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    return ((pixels > 0.0) & (pixels < np.array(model.image_size) - 1.0)).all(-1)
