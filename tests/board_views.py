"""Simulated views of one checkerboard: random poses up to a largest angle off axis, and their corners with noise."""

import math

import numpy as np
import torch

from camera_models import CameraModel
from camera_models.pose import Pose, rotation_from_vector
from omnilines.records import Corners

COLUMNS, ROWS, SQUARE_M = 9, 6, 0.03
BOARD = np.array([[x * SQUARE_M, y * SQUARE_M, 0.0] for y in range(ROWS) for x in range(COLUMNS)])
MARGIN_PX = 2.0


def board_views(
    model: CameraModel,
    max_angle_deg: float,
    views: int,
    seed: int,
    *,
    distance_m: tuple[float, float] = (0.12, 0.5),
    tilt_deg: float = 45.0,
    mirror: bool = False,
) -> Pose:
    """`cam_from_board` of boards with every corner in the image and within `max_angle_deg` of the axis, drawn one by one
    until there are enough: direction uniform in angle and azimuth, distance uniform, tilt up to `tilt_deg`, any roll."""
    rng = np.random.default_rng(seed)
    axis = -1.0 if mirror else 1.0
    kept: list[Pose] = []
    found = 0
    while found < views:
        count = 64
        angle = np.radians(rng.uniform(0, max_angle_deg, count))
        azimuth, roll, lean = rng.uniform(0, 2 * math.pi, (3, count))
        tilt = np.radians(tilt_deg) * np.sqrt(rng.uniform(0, 1, count))
        zero = np.zeros(count)
        away = _turn(np.stack([-np.sin(azimuth) * angle, np.cos(azimuth) * angle, zero], -1))
        leaning = _turn(np.stack([np.cos(lean) * tilt, np.sin(lean) * tilt, zero], -1))
        rotation = away @ leaning @ _turn(np.stack([zero, zero, roll], -1))
        distance = torch.as_tensor(np.stack([zero, zero, rng.uniform(*distance_m, count)], -1))
        middle = rotation @ torch.as_tensor(BOARD.mean(0))
        translation = (away @ distance[..., None])[..., 0] - middle
        flip = torch.diag(torch.tensor([1.0, axis, axis], dtype=torch.float64))
        pose = Pose(flip @ rotation, translation @ flip)
        seen = pose.transform(torch.as_tensor(BOARD))
        pixels, valid = model.project(seen)
        off_axis = torch.atan2(torch.hypot(seen[..., 0], seen[..., 1]), axis * seen[..., 2])
        limit = torch.tensor(model.image_size, dtype=torch.float64) - 1 - MARGIN_PX
        inside = valid & (off_axis <= math.radians(max_angle_deg)) & ((pixels >= MARGIN_PX) & (pixels <= limit)).all(-1)
        use = inside.all(-1)
        kept.append(pose[use])
        found += int(use.sum())
    return Pose(torch.cat([p.rotation for p in kept])[:views], torch.cat([p.translation for p in kept])[:views])


def _turn(vector: np.ndarray) -> torch.Tensor:
    return rotation_from_vector(torch.as_tensor(vector))


def board_corners(model: CameraModel, poses: Pose, sigma_px: float, seed: int) -> Corners:
    """All corners of every view, with Gaussian noise of `sigma_px` on both coordinates."""
    pixels = model.project(poses.transform(torch.as_tensor(BOARD)))[0].numpy().reshape(-1, 2)
    noisy = pixels + sigma_px * np.random.default_rng(seed).standard_normal(pixels.shape)
    names = tuple(f"{v:03d}.png" for v in range(len(poses)))
    return Corners(np.repeat(np.arange(len(poses)), len(BOARD)), names, names, np.tile(BOARD, (len(poses), 1)), noisy)
