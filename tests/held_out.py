"""How lines lie in a photo that they were not made from: beside the segments that a detector finds there. Any camera."""

import numpy as np
import torch

from camera_models import CameraModel
from camera_models.pose import Pose

SEEN_PX = 40.0
"""So long a line must be in the photo."""
NEAR_PX, MATCHED_PX = 2.0, 5.0
"""A segment within the former confirms a line; distances are of those within the latter."""
SHIFTED_PX = 15.0
"""How far beside its place a line is drawn, to see what chance confirms."""
LEAST_COSINE = np.cos(np.radians(3.0))
SAMPLES = 101


def drawn(ends_m: np.ndarray, pose: Pose, camera: CameraModel) -> list[np.ndarray]:
    """The part inside the photo (k, 2) of each line (n 2 3), of those that are long enough."""
    share = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    points = pose.transform(torch.as_tensor(ends_m[:, None, 0] + share * (ends_m[:, None, 1] - ends_m[:, None, 0])))
    pixel, valid = (np.asarray(found) for found in camera.project(points.numpy()))
    inside = valid & ((pixel >= 0) & (pixel <= np.array(camera.image_size) - 1)).all(-1)
    curves = [unbroken(pixel[k, inside[k]], camera.image_size[0]) for k in range(len(ends_m)) if inside[k].sum() > 1]
    return [curve for curve in curves if length_px(curve) >= SEEN_PX]


def unbroken(curve: np.ndarray, width_px: int) -> np.ndarray:
    """The longest part of a curve (k 2) that does not leave a panorama by one side to go on at the other."""
    jumps = np.flatnonzero(np.abs(np.diff(curve[:, 0])) > 0.5 * width_px) + 1
    return max(np.split(curve, jumps), key=length_px)


def length_px(curve: np.ndarray) -> float:
    """Of a curve (k 2)."""
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=-1).sum())


def nearest_px(curve: np.ndarray, segments_px: np.ndarray) -> float:
    """RMS distance (px) of both ends of the nearest segment (n 2 2) that runs along a curve (k 2); infinite if none near does."""
    low, high = curve.min(0) - 2.0 * MATCHED_PX, curve.max(0) + 2.0 * MATCHED_PX
    segments_px = segments_px[((segments_px.min(1) <= high) & (segments_px.max(1) >= low)).all(-1)]
    step = np.diff(curve, axis=0)
    tangent = step / np.linalg.norm(step, axis=-1, keepdims=True)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    away = segments_px[:, :, None] - 0.5 * (curve[1:] + curve[:-1])
    at = np.argmin((away**2).sum(-1), axis=-1)
    beyond = (at == 0).all(-1) | (at == len(step) - 1).all(-1)
    off = np.abs((np.take_along_axis(away, at[..., None, None], 2)[:, :, 0] * across[at]).sum(-1))
    chord = segments_px[:, 1] - segments_px[:, 0]
    chord /= np.linalg.norm(chord, axis=-1, keepdims=True)
    middle = tangent[at].sum(1)
    middle /= np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-9)
    along = (np.abs((chord * middle).sum(-1)) >= LEAST_COSINE) & ~beyond
    return float(np.sqrt((off[along] ** 2).mean(-1)).min(initial=np.inf))


def held_out(ends_m: np.ndarray, pose: Pose, camera: CameraModel, segments_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (px) of the drawn lines from the nearest segment, in their places (n) and beside them (2n)."""
    place, beside = [], []
    for curve in drawn(ends_m, pose, camera):
        chord = curve[-1] - curve[0]
        off = SHIFTED_PX * np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
        place.append(nearest_px(curve, segments_px))
        beside += [nearest_px(curve + off, segments_px), nearest_px(curve - off, segments_px)]
    return np.array(place), np.array(beside)
