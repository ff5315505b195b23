"""What detected corners are worth: cameras calibrated from rendered photos against those from true corners with noise."""

import math

import cv2
import numpy as np
import pytest
import torch
from board_views import SQUARE_M

from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pose import Pose
from omnilines.calibration.single import calibrate_camera
from omnilines.records import Corners

BOARD = pattern(f"checkerboard:8x6:{1000 * SQUARE_M:g}mm")
LENS = OpenCVFisheye([286.0, 287.0, 641.5, 477.5, -0.01, 0.003, -0.001, 0.0001], (1280, 960))
VIEWS, TRUE_CORNER_NOISE_PX, MAX_ANGLE_DEG = 20, 0.06, 85.0


def corners_of(found: list[tuple[np.ndarray, np.ndarray]]) -> Corners:
    """Ids and pixels of every view as a table."""
    names = tuple(f"{v:02d}.png" for v in range(len(found)))
    ids = np.concatenate([ids for ids, _ in found])
    view = np.repeat(np.arange(len(found)), [len(ids) for ids, _ in found])
    return Corners(view, names, names, BOARD.points_m[ids], np.concatenate([pixels for _, pixels in found]))


def bearing_rms_rad(corners: Corners) -> float:
    """Of the camera calibrated from them, up to MAX_ANGLE_DEG, after the rotation that suits best."""
    model = calibrate_camera(corners, LENS.image_size, "opencv-fisheye").model
    u, v = np.meshgrid(np.arange(0.0, 1280.0, 16.0), np.arange(0.0, 960.0, 16.0))
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    true, valid = LENS.unproject(pixels)
    near = valid & (np.arctan2(np.hypot(true[:, 0], true[:, 1]), true[:, 2]) < math.radians(MAX_ANGLE_DEG))
    estimated, also = model.unproject(pixels)
    assert near.sum() > 1000 and also[near].all()
    left, _, right = np.linalg.svd(true[near].T @ estimated[near])
    turned = estimated[near] @ (left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right).T
    return float(np.sqrt((np.linalg.norm(np.cross(turned, true[near]), axis=1) ** 2).mean()))


def photo_and_truth(seed: int) -> tuple[Corners, Corners]:
    """Corners found in rendered photos, and the true ones with noise."""
    rng = np.random.default_rng(seed)
    poses = random_board_poses(BOARD, LENS, VIEWS, math.radians(MAX_ANGLE_DEG), seed=seed)
    detected, noisy = [], []
    for index in range(VIEWS):
        image = render_target(BOARD, LENS, poses[index], blur_px=0.5, noise_grey=2.0, seed=1000 * seed + index)
        found, reason = BOARD.detect(image)
        assert reason is None
        truth = LENS.project(poses[index].transform(torch.as_tensor(BOARD.points_m)))[0].numpy()
        detected.append((found.ids, found.pixels))
        noisy.append((np.arange(len(truth)), truth + rng.normal(0.0, TRUE_CORNER_NOISE_PX, truth.shape)))
    return corners_of(detected), corners_of(noisy)


@pytest.mark.full
def test_cameras_from_photos_are_as_good_as_from_true_corners() -> None:
    """50 sets of 20 photos: bearing error at most 1.2 times that of true corners with 0.06 px noise."""
    errors = np.array([[bearing_rms_rad(corners) for corners in photo_and_truth(seed)] for seed in range(50)])
    from_photos, from_truth = np.sqrt((errors**2).mean(0))
    assert len(errors) == 50 and from_photos <= 1.2 * from_truth, (from_photos, from_truth)


SMALL = OpenCVFisheye([150.0, 150.0, 319.5, 239.5, -0.01, 0.003, -0.001, 0.0001], (640, 480))


def corner_photo(pose: Pose, truth: np.ndarray, seed: int, *, covered: bool) -> tuple[np.ndarray, np.ndarray]:
    """A photo with SMALL, a grey disc over one of the outermost corners where it is to be covered; which corners are seen."""
    image = render_target(BOARD, SMALL, pose, blur_px=0.5, noise_grey=2.0, seed=seed)
    seen = np.ones(len(truth), dtype=bool)
    if covered:
        hidden, inwards = ((0, 9), (7, 14), (40, 33), (47, 38))[seed % 4]
        radius_px = 0.85 * float(np.linalg.norm(truth[hidden] - truth[inwards]))
        cv2.circle(image, (round(truth[hidden, 0]), round(truth[hidden, 1])), round(radius_px), 120, -1, cv2.LINE_AA)
        # What touches a corner's window spoils its fit, and shows in what the fit leaves.
        seen = np.linalg.norm(truth - truth[hidden], axis=1) > 2.0 * radius_px
    return image, seen


@pytest.mark.slow
@pytest.mark.parametrize(("asked", "covered"), [("8x6", False), ("8x6", True), ("9x7", False)])
def test_outermost_corners_are_as_good_as_stated(asked: str, covered: bool) -> None:
    """Whole boards, boards with one corner covered and boards that are smaller than was said, with squares from 10 px on: the
    places that the search starts from (some lie in the margin, some are pixels off) do not bend the windows at the border."""
    board = pattern(f"checkerboard:{asked}:{1000 * SQUARE_M:g}mm")
    poses = random_board_poses(BOARD, SMALL, 10, math.radians(80.0), min_spacing_px=10.0, seed=1)
    ratios = []
    for index in range(10):
        truth = SMALL.project(poses[index].transform(torch.as_tensor(BOARD.points_m)))[0].numpy()
        image, seen = corner_photo(poses[index], truth, index, covered=covered)
        found, reason = board.detect(image)
        assert reason is None and len(found) >= 40
        distance = np.linalg.norm(found.pixels[:, None] - truth, axis=-1)
        nearest, column, row = distance.argmin(1), distance.argmin(1) % 8, distance.argmin(1) // 8
        border = seen[nearest] & ((column == 0) | (column == 7) | (row == 0) | (row == 5))
        ratios.append(distance.min(1)[border] / found.sigma_px[border])
    over = np.concatenate(ratios) / math.sqrt(2.0)
    assert len(over) > 180 and np.sqrt((over**2).mean()) < 0.9 and over.max() < 4.0
