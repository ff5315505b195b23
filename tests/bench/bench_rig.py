"""Calibration of rigs: time against the number of frames, and beside cv2.calibrateMultiview on a pinhole pair.

Seconds depend on the machine and are only printed; what is asserted are ratios in the same run.
"""

import cv2
import numpy as np
import torch
from rig_views import BOARD, FISHEYE_220, PINHOLE, RigScene, boards_at, looking_along, scene, setups
from timing import SMALL, best_of, print_table

from camera_models import CameraModel
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.records import Corners

PEER_LIMIT = 0.3
"""Most of the peer's time for PAIR_FRAMES frames of a pair."""
PAIR_FRAMES = 20 if SMALL else 100
FRAMES = (10, 20) if SMALL else (50, 100, 200)
LINEAR = 1.3
"""Time a frame at the most frames over that at the fewest."""


def side_by_side(models: tuple[CameraModel, ...], frames: int) -> tuple[RigScene, Corners]:
    """Cameras 0.1 m apart that look the same way and all see the whole board in every frame; and their corners with noise."""
    rng = np.random.default_rng(0)
    count = 4 * frames
    centres = np.column_stack([0.1 * np.arange(len(models)), np.zeros((len(models), 2))])
    directions = np.array([0.15, 0.0, 1.0]) + 0.2 * rng.standard_normal((count, 3))
    boards = boards_at(directions, rng.uniform(0.7, 1.2, count), rng)
    cameras = looking_along(np.tile([0.0, 0.0, 1.0], (len(models), 1)), centres)
    rig = scene(models, cameras, boards)
    whole = np.bincount(rig.corners.view) == len(BOARD)
    seen = np.bincount(
        [int(frame) for frame, all_of in zip(rig.corners.frames or (), whole, strict=True) if all_of], minlength=count
    )
    chosen = np.flatnonzero(seen == len(models))[:frames]
    assert len(chosen) == frames
    rig = scene(models, cameras, boards[torch.as_tensor(chosen)])
    return rig, rig.noisy(0.2, 1)


def bench_rig_is_linear_in_frames() -> None:
    """Four cameras of two kinds, from corners to the rig with covariance."""
    rows, each = [], {}
    for frames in FRAMES:
        rig, corners = side_by_side((PINHOLE, FISHEYE_220, PINHOLE, FISHEYE_220), frames)
        seconds = best_of(2, lambda: calibrate_rig(corners, setups(rig)))  # noqa: B023
        each[frames] = seconds / frames
        rows.append([str(frames), str(len(corners)), f"{seconds:.2f}", f"{1e3 * each[frames]:.1f}"])
    print_table("A rig of 4 cameras, one thread", ["frames", "corners", "seconds", "ms a frame"], rows)
    assert SMALL or each[FRAMES[-1]] < LINEAR * each[FRAMES[0]]


def bench_rig_against_opencv() -> None:
    """A pinhole pair; the peer estimates the same parameters and starts, like ours, from nothing."""
    rig, corners = side_by_side((PINHOLE, PINHOLE), PAIR_FRAMES)
    boards = [BOARD.astype(np.float32)] * PAIR_FRAMES
    by_view = [corners.pixels[corners.view == v].astype(np.float32) for v in range(2 * PAIR_FRAMES)]
    pixels = [by_view[:PAIR_FRAMES], by_view[PAIR_FRAMES:]]
    mask, kinds = np.ones((2, PAIR_FRAMES), np.uint8), np.zeros(2, np.uint8)

    def with_opencv() -> float:
        sizes = [PINHOLE.image_size] * 2
        return float(cv2.calibrateMultiview(boards, pixels, sizes, mask, kinds, [None] * 2, [None] * 2, None, None)[0])

    # Of few frames the peer stops a little above the minimum.
    excess = calibrate_rig(corners, setups(rig)).rms_px_per_point - with_opencv()
    assert excess < 2e-3 and (SMALL or excess > -2e-3)
    ours, peer = best_of(6, lambda: calibrate_rig(corners, setups(rig))), best_of(4, with_opencv)
    row = [f"{1e3 * ours:.0f}", f"{1e3 * peer:.0f}", f"{ours / peer:.2f}", f"{PEER_LIMIT:.2f}"]
    print_table(f"A pinhole pair, {PAIR_FRAMES} frames, one thread", ["ours ms", "cv2 ms", "ours / cv2", "limit"], [row])
    assert SMALL or ours / peer <= PEER_LIMIT
