"""Where the photos of a scene are taken from: spread over its free space, looking across it in all directions."""

import math

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.views import axis_from_camera
from omnilines.scenes.line_scene import LineScene
from omnilines.simulate import generator

CLEARANCE_M = 0.3
"""Least distance of a camera from furniture."""
_TRIES = 4000
PITCH_DEG, ROLL_DEG = 20.0, 8.0
"""Largest angle of the optical axis with the horizon, and of the image with the upright."""


def scene_poses(scene: LineScene, views: int, seed: int, camera: CameraModel | None = None) -> Pose:
    """cam_from_world of a batch of views: positions as far apart as free space allows, each looking across the scene.

    Directions are spread evenly around. They are those of +z, or where a `camera` is given of its optical axis, which is -z of a
    mirror. Raises InputError for fewer than one view, GeometryError where there is no free space.
    """
    if views < 1:
        raise InputError(f"At least 1 view was expected, found {views}; give more.")
    rng = generator(seed, "scene poses")
    free = rng.uniform(scene.low_m, scene.high_m, (_TRIES, 3))
    free = free[~scene.boxes.near(free, CLEARANCE_M)]
    if len(free) < views:
        raise GeometryError(
            f"Free space for {views} cameras was expected in the scene, found {len(free)} places for one; take fewer views."
        )
    places = _spread(free, views)
    azimuth = 2.0 * math.pi * (np.arange(views) + rng.uniform(-0.3, 0.3, views)) / views + rng.uniform(0.0, 2.0 * math.pi)
    heading = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    # Each direction goes to a place that has the scene before it.
    inward = 0.5 * (scene.low_m + scene.high_m)[:2] - places[:, :2]
    _, taken = linear_sum_assignment(inward @ heading.T, maximize=True)
    pitch, roll = np.radians(rng.uniform(-1.0, 1.0, (2, views)) * [[PITCH_DEG], [ROLL_DEG]])
    rotation = _upright(azimuth[taken], pitch, roll)
    if camera is not None:
        rotation = axis_from_camera(camera).T @ rotation
    return Pose.of(rotation, -np.einsum("nij,nj->ni", rotation, places))


def _spread(points: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "k 3"]:
    """Points chosen one after the other, each the farthest from those before."""
    chosen = [0]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=-1))
        chosen.append(int(distance.argmax()))
    return points[chosen]


def _upright(
    azimuth: Float[np.ndarray, " n"], pitch: Float[np.ndarray, " n"], roll: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Rotations cam_from_world: the axis at an azimuth from world x and a pitch above the horizon, the image turned by roll."""
    forward = np.stack([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)], -1)
    right = np.stack([np.sin(azimuth), -np.cos(azimuth), np.zeros_like(azimuth)], -1)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cos * right + sin * down, cos * down - sin * right, forward], 1)
