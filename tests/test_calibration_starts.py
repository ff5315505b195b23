"""No guess is asked for, and no bad corner or view stops a calibration: the ladder of issue 3, and what is done to spoil it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from board_views import BOARD, COLUMNS, ROWS, board_corners, board_views

from camera_models import CameraModel, OpenCVFisheye, Scaramuzza
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.single import calibrate_camera
from omnilines.evaluation.cameras import bearing_error_deg
from omnilines.records import Corners

SIZE = (1280, 960)
LADDER_LENS = OpenCVFisheye([320.0, 320.0, 639.5, 479.5, 0.01, -0.005, 0.001, 0.0], SIZE)
WIDE_LENS = OpenCVFisheye([255.0, 255.0, 639.5, 479.5, 0.01, -0.005, 0.001, 0.0], SIZE)
REACHES_DEG = (50.0, 69.5, 89.0, *(pytest.param(reach, marks=pytest.mark.full) for reach in (56.5, 63.0, 76.0, 82.5)))
BEYOND_DEG = 105.0
VIEWS, NOISE_PX = 20, 0.2
SPHERES = ("unified", "extended-unified", "double-sphere")


def ladder_corners(lens: CameraModel, reach_deg: float, seed: int) -> Corners:
    return board_corners(lens, board_views(lens, reach_deg, VIEWS, 1000 * int(reach_deg) + seed), NOISE_PX, seed)


def assert_at_noise_level(result: CameraCalibration, truth: CameraModel, reach_deg: float) -> None:
    """All views kept, residuals as large as the noise, and the bearings of the truth."""
    assert [view.reason for view in result.views if not view.used] == []
    # 1,080 corners: the standard deviation of the RMS is 0.0045 px.
    assert abs(result.rms_px_per_axis - NOISE_PX) < 0.025
    assert bearing_error_deg(result.model, truth, math.radians(min(reach_deg, result.max_angle_deg)))[0] < 0.15


@pytest.mark.parametrize("model", ["opencv-fisheye", "scaramuzza"])
@pytest.mark.parametrize("reach_deg", REACHES_DEG)
@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 20), marks=pytest.mark.full)], ids=["2", "all"])
def test_ladder(model, reach_deg, seeds):
    """140 pose sets in all, each from corners alone; cv2.fisheye.calibrate without a guess converges in 1 of its 140."""
    for seed in seeds:
        result = calibrate_camera(ladder_corners(LADDER_LENS, reach_deg, seed), SIZE, model)
        assert_at_noise_level(result, LADDER_LENS, reach_deg)
        assert result.kept.mean() > 0.995
    assert len(seeds) in (2, 18)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["opencv-fisheye", "scaramuzza"])
@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 20), marks=pytest.mark.full)], ids=["3", "all"])
def test_boards_out_to_105_degrees(model, seeds):
    for seed in seeds:
        result = calibrate_camera(ladder_corners(WIDE_LENS, BEYOND_DEG, seed), SIZE, model)
        assert_at_noise_level(result, WIDE_LENS, BEYOND_DEG)
        assert result.max_angle_deg > 90
    assert len(seeds) in (3, 17)


@pytest.mark.slow
@pytest.mark.parametrize("model", SPHERES)
@pytest.mark.parametrize(
    "reach_deg", [pytest.param(50.0, marks=pytest.mark.full), pytest.param(76.0, marks=pytest.mark.full), 89.0]
)
def test_sphere_models_start_too(model, reach_deg):
    """On another model's lens, which they hold to a small share of the noise."""
    result = calibrate_camera(ladder_corners(LADDER_LENS, reach_deg, 0), SIZE, model)
    assert_at_noise_level(result, LADDER_LENS, reach_deg)


@pytest.mark.parametrize("turn", ["mirrored", "transposed", "both"])
def test_other_numberings_give_the_same_camera(turn):
    """A numbering mirrored, transposed or both in all views is another pose of the same plane."""
    corners = ladder_corners(LADDER_LENS, 76.0, 3)
    board = corners.board_m.copy()
    if turn != "transposed":
        board[:, 0] = BOARD[:, 0].max() - board[:, 0]
    if turn != "mirrored":
        board = board[:, [1, 0, 2]]
    plain = calibrate_camera(corners, SIZE, "opencv-fisheye")
    other = calibrate_camera(replace(corners, board_m=board), SIZE, "opencv-fisheye")
    np.testing.assert_allclose(other.model.parameters, plain.model.parameters, rtol=1e-5, atol=1e-6)


def test_mirror_cameras():
    """A camera that looks at a mirror sees backwards (a0 < 0); planar boards leave the sign to --mirror."""
    mirror = Scaramuzza([644.0, 476.0, 1.0, 0.0, 0.0, -320.0, 9e-4, 0.0, 1e-9], SIZE)
    poses = board_views(mirror, 80.0, VIEWS, 5, mirror=True)
    assert float(poses.transform(torch.as_tensor(BOARD))[..., 2].mean()) < 0
    corners = board_corners(mirror, poses, NOISE_PX, 5)
    result = calibrate_camera(corners, SIZE, "scaramuzza", mirror=True)
    assert_at_noise_level(result, mirror, 80.0)
    assert result.model.named_parameters()["a0"] < 0


def with_gross_errors(corners: Corners, rng: np.random.Generator) -> tuple[Corners, np.ndarray]:
    """A fifth of all corners moved by 5 to 60 px in both directions."""
    wrong = np.zeros(len(corners), bool)
    wrong[rng.choice(len(corners), len(corners) // 5, replace=False)] = True
    pixels = corners.pixels.copy()
    pixels[wrong] += rng.uniform(5, 60, (wrong.sum(), 2)) * rng.choice([-1, 1], (wrong.sum(), 2))
    return replace(corners, pixels=pixels), wrong


def with_mislabelled_views(corners: Corners, rng: np.random.Generator) -> tuple[Corners, list[int]]:
    """Two views whose corners are in no order, or in that of columns instead of rows."""
    views = sorted(rng.choice(len(corners.view_names), 2, replace=False).tolist())
    pixels = corners.pixels.copy()
    for view, by_columns in zip(views, rng.permutation([True, False]), strict=True):
        own = np.flatnonzero(corners.view == view)
        grid = pixels[own].reshape(ROWS, COLUMNS, 2)
        pixels[own] = grid.transpose(1, 0, 2).reshape(-1, 2) if by_columns else rng.permutation(pixels[own])
    return replace(corners, pixels=pixels), views


@pytest.mark.parametrize("model", ["opencv-fisheye", "scaramuzza", "double-sphere"])
@pytest.mark.parametrize("reach_deg", [pytest.param(50.0, marks=pytest.mark.full), 89.0])
def test_survives_a_fifth_of_gross_errors_and_two_mislabelled_views(model, reach_deg):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        corners, wrong = with_gross_errors(ladder_corners(LADDER_LENS, reach_deg, seed), rng)
        corners, views = with_mislabelled_views(corners, rng)
        result = calibrate_camera(corners, SIZE, model)
        assert [v for v, view in enumerate(result.views) if not view.used] == views
        assert all("do not fit" in (result.views[v].reason or "") for v in views)
        good = ~np.isin(corners.view, views)
        assert not result.kept[wrong & good].any()
        assert result.kept[~wrong & good].mean() > 0.99
        assert abs(result.rms_px_per_axis - NOISE_PX) < 0.025
        assert bearing_error_deg(result.model, LADDER_LENS, math.radians(min(reach_deg, result.max_angle_deg)))[0] < 0.2
        assert any("corners, in 18 views, were rejected" in note for note in result.notes)
        rejecting = [view for view in result.views if view.used and view.corners_rejected > 5]
        assert rejecting and all("corners rejected: more than" in view.remarks[0] for view in rejecting)


def test_kept_corners_are_fitted_by_plain_least_squares():
    """With no gross error, the robust default gives the plain fit of the corners that it keeps, not the one of the loss."""
    corners = ladder_corners(LADDER_LENS, 76.0, 7)
    robust = calibrate_camera(corners, SIZE, "opencv-fisheye")
    rows = np.flatnonzero(robust.kept)
    kept = replace(corners, view=corners.view[rows], board_m=corners.board_m[rows], pixels=corners.pixels[rows])
    plain = calibrate_camera(kept, SIZE, "opencv-fisheye", loss="none")
    np.testing.assert_allclose(robust.model.parameters, plain.model.parameters, rtol=1e-7, atol=1e-8)


def test_screening_finds_gross_errors_without_a_camera():
    """On views of a strongly bent image: nearly every error above 20 px is found, and few good corners are lost."""
    corners, wrong = with_gross_errors(ladder_corners(LADDER_LENS, 89.0, 2), np.random.default_rng(8))
    points = BoardPoints(torch.as_tensor(corners.view), VIEWS, torch.as_tensor(corners.board_m), torch.as_tensor(corners.pixels))
    clean = LADDER_LENS.project(board_views(LADDER_LENS, 89.0, VIEWS, 89002).transform(torch.as_tensor(BOARD)))[0].reshape(-1, 2)
    far = np.linalg.norm(corners.pixels - clean.numpy(), axis=-1) > 20
    kept, in_order = smooth_corners(points)
    assert far.sum() > 100 and kept.numpy()[far].mean() < 0.03
    assert kept.numpy()[~wrong].mean() > 0.95
    assert bool(in_order.all())
    spoilt, views = with_mislabelled_views(corners, np.random.default_rng(1))
    _, in_order = smooth_corners(replace_pixels(points, spoilt))
    assert torch.nonzero(~in_order).flatten().tolist() == views


def replace_pixels(points: BoardPoints, corners: Corners) -> BoardPoints:
    return BoardPoints(points.view, points.views, points.board, torch.as_tensor(corners.pixels))
