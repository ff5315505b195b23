"""Where the photos of a scene are taken from: spread over its free space or walked through it, looking in all directions."""

import math

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.views import axis_from_camera
from omnilines.scenes.polygon_scene import Dome, PolygonScene
from omnilines.synthetic.targets import generator

CLEARANCE_M = 0.3
"""Least distance of a camera from furniture."""
STEP_M = 1.5
"""Along a way, from photo to photo; more photos than this leaves room for are nearer to each other."""
_ALONG_M, _ASIDE_M, _UP_M = 0.05, 0.12, 0.08
"""Largest distance of a photo from its place on the way."""
_TRIES = 4000
PITCH_DEG, ROLL_DEG = 20.0, 8.0
"""Largest angle of the optical axis with the horizon, and of the image with the upright."""
AIM_DEG = 3.0
"""How far a photo that looks at something has it beside its middle."""
LEVEL_DEG = 5.0
"""The same of both along a way."""


def scene_poses(scene: PolygonScene, views: int, seed: int, camera: CameraModel | None = None) -> Pose:
    """cam_from_world of a batch of views: positions as far apart as free space allows, each looking across the scene, or those of
    a walk where the scene has one.

    Directions are spread evenly around. They are those of +z, or where a `camera` is given of its optical axis, which is -z of a
    mirror. Raises InputError for fewer than one view, GeometryError where there is no free space.
    """
    if views < 1:
        raise InputError(f"At least 1 view was expected, found {views}; give more.")
    rng = generator(seed, "scene poses")
    if scene.dome is not None:
        return _from_dome(scene.dome, views, rng, camera)
    places = _scattered(scene, views, rng) if scene.walk_m is None else _walked(scene, scene.walk_m, views, rng)
    azimuth = 2.0 * math.pi * (np.arange(views) + rng.uniform(-0.3, 0.3, views)) / views + rng.uniform(0.0, 2.0 * math.pi)
    if scene.walk_m is None:
        heading = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
        # Each direction goes to a place that has the scene before it.
        inward = 0.5 * (scene.low_m + scene.high_m)[:2] - places[:, :2]
        _, taken = linear_sum_assignment(inward @ heading.T, maximize=True)
    else:
        taken = rng.permutation(views)
    tilt = (PITCH_DEG, ROLL_DEG) if scene.walk_m is None else (LEVEL_DEG, LEVEL_DEG)
    pitch, roll = np.radians(rng.uniform(-1.0, 1.0, (2, views)) * np.array(tilt)[:, None])
    rotation = _upright(azimuth[taken], pitch, roll)
    if camera is not None:
        rotation = axis_from_camera(camera).T @ rotation
    return Pose.of(rotation, -np.einsum("nij,nj->ni", rotation, places))


def _from_dome(dome: Dome, views: int, rng: np.random.Generator, camera: CameraModel | None) -> Pose:
    """From one side to the other, at uneven heights and distances, the origin near the middle of each photo."""
    share = (np.arange(views) + 0.5 + rng.uniform(-0.3, 0.3, views)) / views
    azimuth = np.radians(-90.0 + dome.aside_deg * (2.0 * share - 1.0))
    height = np.radians(rng.uniform(*dome.height_deg, views))
    flat = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) * np.cos(height)[:, None]
    places = rng.uniform(*dome.distance_m, views)[:, None] * np.column_stack([flat, np.sin(height)])
    off, roll = np.radians(rng.uniform(-1.0, 1.0, (2, views)) * np.array([AIM_DEG, ROLL_DEG])[:, None])
    rotation = _upright(azimuth + np.pi + off, -height, roll)
    if camera is not None:
        rotation = axis_from_camera(camera).T @ rotation
    return Pose.of(rotation, -np.einsum("nij,nj->ni", rotation, places))


def _scattered(scene: PolygonScene, views: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Places in free space, as far apart as it allows."""
    free = rng.uniform(scene.low_m, scene.high_m, (_TRIES, 3))
    free = free[~scene.boxes.near(free, CLEARANCE_M)]
    if len(free) < views:
        raise GeometryError(
            f"Free space for {views} cameras was expected in the scene, found {len(free)} places for one; take fewer views."
        )
    return _spread(free, views)


def _walked(
    scene: PolygonScene, way_m: Float[np.ndarray, "k 3"], views: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Places along a way, one step apart, each a little beside it where that is free."""
    leg = np.diff(way_m, axis=0)
    reached = np.append(0.0, np.cumsum(np.linalg.norm(leg, axis=-1)))
    at = np.arange(views) * min(STEP_M, reached[-1] / max(views - 1, 1))
    places = np.stack([np.interp(at, reached, column) for column in way_m.T], -1)
    tangent = leg[np.clip(np.searchsorted(reached, at) - 1, 0, len(leg) - 1)]
    along = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    axes = np.stack([along, np.cross([0.0, 0.0, 1.0], along), np.tile([0.0, 0.0, 1.0], (views, 1))], 1)
    step = rng.uniform(-1.0, 1.0, (_TRIES // 100, views, 3)) * [_ALONG_M, _ASIDE_M, _UP_M]
    tried = places + np.einsum("kni,nij->knj", step, axes)
    free = ~scene.boxes.near(tried.reshape(-1, 3), CLEARANCE_M).reshape(tried.shape[:2])
    if not free.any(0).all():
        raise GeometryError(
            f"A way clear of furniture was expected in the scene, found place {int(free.any(0).argmin())} of {views} taken; "
            "take another seed."
        )
    return tried[free.argmax(0), np.arange(views)]


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
