"""Photos that a map uncertainty takes: boards held as advised against random poses; and whether the map falls as promised."""

import math
import time

import numpy as np
import torch
from timing import SMALL, print_table

from calib_patterns import Pattern, pattern
from calib_patterns.board_poses import random_board_poses
from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.next_pose import NextViews, next_views
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import ShootingThresholds
from omnilines.synthetic.targets import board_angle_rad, example_camera, simulate_corners

ANY_GAIN = ShootingThresholds(poses=1, least_gain=0.0)
NOISE_PX, START, RANDOM = 0.2, 4, 20
CHECKERBOARD = "checkerboard:8x6:30mm"
FOV_DEG = {"opencv-fisheye": 190.0, "scaramuzza": 200.0, "double-sphere": 180.0, "pinhole": 70.0}
CASES = (*((name, CHECKERBOARD) for name in FOV_DEG), ("opencv-fisheye", "aprilgrid:4x4:35mm:0.3:36h11"))


def bench_photos_needed() -> None:
    rows, fewest = [], list[float]()
    for name, specification in CASES[:1] if SMALL else CASES:
        fov_deg = FOV_DEG[name]
        needed, promised, reached, seconds, expected_px = [], list[float](), [], list[float](), math.nan
        for seed in range(1 if SMALL else 3):
            truth, board = example_camera(name, fov_deg, (1280, 960), seed), pattern(specification)
            # In a random order: the sequence itself goes from the rim inwards.
            pool = random_board_poses(board, truth, RANDOM, board_angle_rad(fov_deg), seed=seed)
            pool = pool[torch.as_tensor(np.random.default_rng(seed).permutation(RANDOM))]
            wanted_px = _advice(truth, board, pool, seed).worst_px
            reached.append(wanted_px)
            poses, found_px = pool[:START], math.inf
            while found_px > wanted_px and len(poses) < RANDOM:
                started = time.process_time()
                advice = _advice(truth, board, poses, seed)
                seconds.append(time.process_time() - started)
                if len(poses) > START:
                    promised.append(advice.worst_px / expected_px)
                found_px = advice.worst_px
                if found_px > wanted_px:
                    expected_px, one = advice.poses[0].worst_px, advice.poses[0].cam_from_board
                    poses = Pose.stack([*(poses[k] for k in range(len(poses))), one])
            needed.append(len(poses))
        fewest.append(float(np.mean(needed)))
        rows.append(
            [
                f"{name}, {fov_deg:.0f} degrees, {board.NAME}",
                f"{np.median(reached):.2f}",
                f"{RANDOM}",
                f"{np.mean(needed):.1f} ({max(needed)})",
                f"{np.median(promised):.2f} ({min(promised):.2f} to {max(promised):.2f})",
                f"{np.median(seconds):.2f}",
            ]
        )
    assert rows and max(fewest) <= RANDOM / 2
    header = ["lens, board", "largest px", "random photos", "as advised (most)", "found / promised", "fit and advice, s"]
    print_table(f"photos for an uncertainty over the image, from {START} random ones on, corners of {NOISE_PX} px", header, rows)


def _advice(truth: CameraModel, board: Pattern, poses: Pose, seed: int) -> NextViews:
    """Of a camera calibrated from these views, over the part of the image that random boards reach."""
    corners = simulate_corners(truth, board, poses, NOISE_PX, 1000 * seed + len(poses))
    options = {"degree": 5} if truth.NAME == "scaramuzza" else None
    fit = calibrate_camera(corners, truth.image_size, truth.NAME, options=options)
    angle = board_angle_rad(FOV_DEG[truth.NAME])
    edge, _ = truth.project(torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64))
    rim_px = float((edge - truth.centre_px).norm())
    found = next_views(fit, corners, rim_px=rim_px, board_m=board.points_m, thresholds=ANY_GAIN)
    assert found is not None
    return found
