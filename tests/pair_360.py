"""A rendered 360 degree camera: two lenses of 200 degrees back to back, 3 cm apart, their images side by side in one file."""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from rig_views import BOARD, boards_at, looking_along

from calib_patterns import pattern
from calib_patterns.rendering import graded_background, pixel_grid, render_target
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.pipelines.render import RenderOptions, render_scene
from omnilines.pipelines.rendered import RenderedScene
from omnilines.scenes import build_scene, scene_poses

NAMES = ("left", "right")
BOARDS = "charuco:7x5:60mm:45mm:DICT_4X4_50"
AXES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])


def mounts() -> Pose:
    """cam_from_rig, the rig frame being that of the first lens."""
    from_middle = looking_along(AXES, 0.015 * AXES)
    return from_middle @ from_middle[0].inverse()


def write_boards(folder: Path, models: tuple[CameraModel, CameraModel], frames: int, seed: int = 0) -> None:
    """Photos of a board that is held around the camera, near it, in every second one between both lenses."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    board, from_middle = pattern(BOARDS), looking_along(AXES, 0.015 * AXES)
    directions = rng.standard_normal((frames, 3))
    directions[:, 2] = np.copysign(np.abs(directions[:, 2]) + 0.5, np.where(np.arange(frames) % 4 < 2, -1.0, 1.0))
    directions[::2, 2] *= 0.1
    poses = boards_at(directions, rng.uniform(0.22, 0.4, frames), rng, 35.0)
    middle = torch.as_tensor(board.points_m.mean(0) - BOARD.mean(0))
    poses = Pose(poses.rotation, poses.translation - poses.rotation @ middle)
    backgrounds = [graded_background(model, np.random.default_rng(c)) for c, model in enumerate(models)]
    circles = [_circle(model) for model in models]
    for f in range(frames):
        parts = [
            np.where(
                circles[c],
                render_target(
                    board, model, from_middle[c] @ poses[f], supersample=3, blur_px=0.5, noise_grey=2.0,
                    background=backgrounds[c], seed=2 * f + c,
                ),
                0,
            )
            for c, model in enumerate(models)
        ]  # fmt: skip
        cv2.imwrite(str(folder / f"{f:03d}.png"), np.hstack(parts))


def _circle(model: CameraModel) -> np.ndarray:
    """(h, w): what the lens shows, out to 100 degrees off axis."""
    bearings, valid = model.unproject(pixel_grid(range(model.image_size[1]), model.image_size[0]))
    return np.asarray(valid) & (np.asarray(bearings)[..., 2] > math.cos(math.radians(100.0)))


def write_room(
    folder: Path, models: tuple[CameraModel, CameraModel], instants: int, seed: int = 0
) -> tuple[RenderedScene, RenderedScene]:
    """Photos of the furnished room from all over it, both lenses side by side; what each lens sees, with its truth."""
    folder.mkdir(parents=True)
    poses = scene_poses(build_scene("room", seed), instants, seed, models[0])
    cam_from_rig, options = mounts(), RenderOptions(fov_deg=200.0, seed=seed)
    left, right = (render_scene("room", model, options, poses=cam_from_rig[c] @ poses) for c, model in enumerate(models))
    for name in left.photos:
        cv2.imwrite(str(folder / name), np.hstack([left.photos[name], right.photos[name]]))
    return left, right
