"""Calibration of one camera against published figures, against simulated truth, and against what a user can get wrong."""

import json
import math

import numpy as np
import pytest
import torch

import camera_models
from camera_models import (
    DoubleSphere,
    ExtendedUnified,
    GeometryError,
    InputError,
    OpenCVFisheye,
    Pinhole,
    Scaramuzza,
    Unified,
)
from camera_models.pose import Pose, rotation_from_vector
from omnilines.calibration.initialise import centre_candidates, radial_centres, radial_start, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.commands.calibrate import calibrate_photos
from omnilines.files import read_corners
from omnilines.pipelines.calibrate import calibrate_corners
from omnilines.records import Corners

BOARD = np.array([[x * 0.03, y * 0.03, 0.0] for y in range(6) for x in range(9)])


def facing_poses(views, max_angle_deg, seed, distance=(0.15, 0.5), tilt_deg=40.0):
    """Boards all over the field of view, their middle at most a little inside the largest angle, tilted at random."""
    rng = np.random.default_rng(seed)
    rotations, translations = [], []
    for view in range(views):
        angle = math.radians(max_angle_deg) * (0.75 if view % 2 else rng.uniform(0, 0.75))
        azimuth = 2 * math.pi * (view / views + 0.3 * rng.uniform())
        away = rotation_from_vector(torch.tensor([-math.sin(azimuth) * angle, math.cos(azimuth) * angle, 0.0]).double())
        tilt = rng.uniform(-1, 1, 3) * [math.radians(tilt_deg), math.radians(tilt_deg), math.pi]
        turn = rotation_from_vector(torch.as_tensor(tilt))
        middle = torch.tensor([0.0, 0.0, rng.uniform(*distance)]).double()
        rotations.append(away @ turn)
        translations.append(away @ middle - rotations[-1] @ torch.as_tensor(BOARD.mean(0)))
    return Pose(torch.stack(rotations), torch.stack(translations))


def simulated(model, poses, sigma_px, seed, max_angle_deg=None):
    """Corners of all boards that lie wholly inside the image, with noise."""
    rng = np.random.default_rng(seed)
    seen = poses.transform(torch.as_tensor(BOARD)).numpy()
    pixels, valid = model.project(seen)
    inside = valid & ((pixels > 0) & (pixels < np.array(model.image_size) - 1)).all(-1)
    if max_angle_deg is not None:
        theta = np.degrees(np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2]))
        inside &= theta <= max_angle_deg
    views = np.flatnonzero(inside.all(-1))
    count = len(BOARD)
    noisy = pixels[views].reshape(-1, 2) + sigma_px * rng.standard_normal((len(views) * count, 2))
    names = tuple(f"{v:03d}.png" for v in views)
    corners = Corners(np.repeat(np.arange(len(views)), count), names, names, np.tile(BOARD, (len(views), 1)), noisy)
    return corners, poses[views]


def bearing_error_deg(estimate, truth, max_angle_deg):
    """RMS angle between the bearings of a grid of pixels after the best common rotation."""
    w, h = truth.image_size
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 80), np.linspace(0, h - 1, 60)), -1).reshape(-1, 2)
    a, seen_a = truth.unproject(grid)
    b, seen_b = estimate.unproject(grid)
    axis = truth.unproject(truth.centre_px.numpy())[0]
    use = seen_a & seen_b & (np.degrees(np.arccos(np.clip(a @ axis, -1, 1))) <= max_angle_deg)
    assert use.sum() > 100
    u, _, vt = np.linalg.svd(b[use].T @ a[use])
    turned = b[use] @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
    angle = np.arctan2(np.linalg.norm(np.cross(turned, a[use]), axis=-1), (turned * a[use]).sum(-1))
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


FISHEYE = OpenCVFisheye([320.0, 321.0, 655.0, 466.0, -0.012, 0.004, -0.002, 0.0002], (1280, 960))
WIDE = Scaramuzza([645.2, 478.7, 1.0004, 2e-4, 2e-4, 235.0, -1.42e-3, 0.0, -1.7e-9], (1280, 960))
LENSES = {
    "opencv-fisheye": (FISHEYE, 85),
    "scaramuzza": (Scaramuzza([655.0, 466.0, 1.001, 3e-4, 3e-4, 338.0, -1.2e-3, 1.27e-6, -2.2e-9], (1280, 960)), 85),
    # xi, k1 and k2 can make up for one another; this lens and its reach tell them apart.
    "unified": (Unified([540.0, 541.0, 655.0, 466.0, 0, 1.2, -0.3, 0.12, 2e-4, -3e-4], (1280, 960)), 90),
    "extended-unified": (ExtendedUnified([338.0, 339.0, 655.0, 466.0, 0.6, 1.1], (1280, 960)), 85),
    "double-sphere": (DoubleSphere([290.0, 291.0, 655.0, 466.0, -0.18, 0.59], (1280, 960)), 85),
    "pinhole": (Pinhole([700.0, 702.0, 655.0, 466.0, 0, -0.28, 0.09, 2e-4, -3e-4, -0.012, 0, 0, 0], (1280, 960)), 40),
}


@pytest.mark.parametrize(("name", "published"), [("fisheye1", 0.2838), ("gopro", 0.5377), ("kaidan", 0.2212)])
def test_no_worse_than_the_best_published_fit(shared_data, name, published):
    folder = shared_data / "calibration" / name
    corners = read_corners(folder / "corners.csv")
    reference = json.loads((folder / "reference.json").read_text())
    assert abs(reference["published"]["urban_subpix"]["rms_px_per_axis"] - published) < 1e-4
    result = calibrate_camera(corners, tuple(reference["image_size"]), "scaramuzza", loss="none", options={"degree": 4})
    assert result.kept.all()
    assert all(view.used for view in result.views)
    assert result.rms_px_per_axis <= published + 1e-3
    assert math.isclose(result.rms_px_per_point, result.rms_px_per_axis * math.sqrt(2), rel_tol=1e-12)
    residual = result.residual_px[result.kept]
    assert math.isclose(np.sqrt((residual**2).sum() / (2 * len(residual))), result.rms_px_per_axis, rel_tol=1e-12)


def test_agrees_with_the_published_parameters(shared_data):
    """The published polynomial of the fit to the same corners lies within our uncertainty (its affine terms rotated away)."""
    corners = read_corners(shared_data / "calibration/fisheye1/corners.csv")
    result = calibrate_camera(corners, (1032, 778), "scaramuzza", loss="none", options={"degree": 4})
    published = json.loads((shared_data / "calibration/fisheye1/reference.json").read_text())["published"]["urban_subpix"]
    sigma = result.sigma
    named = result.model.named_parameters()
    # In this entry `centre_row` holds the column; both are 1-based.
    assert abs(named["cx"] - (published["centre_row_1based"] - 1)) < 2 * sigma["cx"]
    assert abs(named["cy"] - (published["centre_col_1based"] - 1)) < 2 * sigma["cy"]
    assert abs(named["a0"] + published["ss"][0]) < 2 * sigma["a0"]


def test_radial_epipole_finds_the_centre(shared_data):
    """The image centre is 28 px off on this lens; the median of the epipoles lies within 0.5 px of the adjusted one."""
    corners = read_corners(shared_data / "calibration/fisheye1/corners.csv")
    points = board_points(corners, np.ones(len(corners), bool), list(range(15)))
    centres, certainty = radial_centres(points)
    assert centres.shape == (15, 2) and bool((certainty > 1).all())
    best = centre_candidates(points, (1032, 778))[0]
    assert float((best - torch.tensor([543.76, 377.78])).norm()) < 0.5


@pytest.mark.slow
def test_the_mirror_flag_only_turns_the_sign(shared_data):
    """Planar boards fit a0 and -a0 equally well."""
    corners = read_corners(shared_data / "calibration/kaidan/corners.csv")
    lens = calibrate_camera(corners, (640, 480), "scaramuzza", loss="none")
    mirror = calibrate_camera(corners, (640, 480), "scaramuzza", loss="none", mirror=True)
    assert abs(lens.rms_px_per_axis - mirror.rms_px_per_axis) < 1e-9
    a, b = lens.model.parameters.numpy(), mirror.model.parameters.numpy()
    assert a[5] > 0 > b[5]
    np.testing.assert_allclose(a[5:], -b[5:], rtol=1e-4)
    assert lens.min_angle_deg > 40


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size", "mirror", "said"), [
    ("kaidan", (640, 480), False, True), ("kaidan", (640, 480), True, False), ("fisheye1", (1032, 778), False, False),
])  # fmt: skip
def test_a_lens_is_said_to_be_assumed_where_a_mirror_may_be(shared_data, name, size, mirror, said):
    corners = read_corners(shared_data / f"calibration/{name}/corners.csv")
    notes = calibrate_corners(corners, size, model="scaramuzza", mirror=mirror).notes
    assert any(note.startswith("A lens is assumed") and note.endswith("give `mirror`.") for note in notes) is said


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LENSES))
def test_exact_corners_give_the_exact_camera(name):
    model, reach = LENSES[name]
    corners, poses = simulated(model, facing_poses(20, reach, seed=3), 0.0, 0)
    assert len(poses) >= 10
    result = calibrate_camera(corners, model.image_size, name, loss="none")
    np.testing.assert_allclose(result.model.parameters, model.parameters, rtol=1e-5, atol=1e-9)
    assert result.rms_px_per_axis < 1e-6
    for view, pose in zip(result.views, (poses[i] for i in range(len(poses))), strict=True):
        np.testing.assert_allclose(view.cam_from_board.translation, pose.translation, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.full) if name == "unified" else name for name in LENSES])
def test_predicted_covariance_covers_the_truth(name):
    """Normalised errors of the calibrated directions over 10 noise seeds: chi-square and single parameters."""
    model, reach = LENSES[name]
    poses = facing_poses(20, reach, seed=5)
    basis = model.calibration_basis().numpy()
    if name == "pinhole":
        assert basis.shape[1] == 9
    squared, scores, freedom = 0.0, [], 0
    for seed in range(10):
        corners, _ = simulated(model, poses, 0.2, seed)
        # Of one degree: a choice made anew from every noise is not part of the covariance.
        options = {"degree": 4} if name == "scaramuzza" else None
        result = calibrate_camera(corners, model.image_size, name, loss="none", options=options)
        free = np.linalg.pinv(basis)
        error = free @ (result.model.parameters - model.parameters).numpy()
        covariance = free @ result.covariance @ free.T
        squared += error @ np.linalg.solve(covariance, error)
        scores.extend(error / np.sqrt(np.diag(covariance)))
        freedom += len(error)
        assert abs(result.rms_px_per_axis - 0.2) < 0.02
        assert bearing_error_deg(result.model, model, reach) < 0.1
    assert freedom == 10 * basis.shape[1]
    # 99.9 percent of a chi-square distribution, by its normal approximation.
    assert abs(squared - freedom) < 3.3 * math.sqrt(2 * freedom)
    assert 0.7 < np.std(scores) < 1.3


def test_boards_beyond_ninety_degrees():
    model = WIDE
    corners, poses = simulated(model, facing_poses(30, 120, seed=9, distance=(0.2, 0.4)), 0.2, 1)
    theta = np.degrees(np.arccos(model.unproject(corners.pixels)[0][:, 2]))
    assert theta.max() > 95 and len(poses) >= 8
    result = calibrate_camera(corners, model.image_size, "scaramuzza")
    assert all(view.used for view in result.views)
    assert result.max_angle_deg > 95
    assert result.rms_px_per_axis < 0.25
    assert bearing_error_deg(result.model, model, 95) < 0.03


def test_mirrored_and_transposed_numbering_change_nothing():
    model, reach = LENSES["opencv-fisheye"]
    corners, _ = simulated(model, facing_poses(15, reach, seed=11), 0.2, 2)
    plain = calibrate_camera(corners, model.image_size, "opencv-fisheye", loss="none")
    for matrix in ([[-1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 0], [1, 0, 0], [0, 0, 1]]):
        other = Corners(
            corners.view, corners.view_names, corners.images, corners.board_m @ np.array(matrix, float).T, corners.pixels
        )
        result = calibrate_camera(other, model.image_size, "opencv-fisheye", loss="none")
        assert abs(result.rms_px_per_axis - plain.rms_px_per_axis) < 1e-8
        np.testing.assert_allclose(result.model.parameters, plain.model.parameters, rtol=1e-5, atol=1e-6)


def test_jacobian_of_the_board_problem():
    """Analytic against automatic differentiation through the retraction."""
    model, reach = LENSES["scaramuzza"]
    corners, poses = simulated(model, facing_poses(4, reach, seed=3), 0.1, 0)
    views = len(poses)
    points = board_points(corners, np.ones(len(corners), bool), list(range(views)))
    problem = BoardProblem(points, model.calibration_basis())
    state = CameraAndBoards(model, poses)
    at = problem.linearise(state)

    def moved(step):
        kept, eliminated = step[: problem.structure.kept_size], step[problem.structure.kept_size :].view(views, 6)
        return problem.retract(state, kept, eliminated).residual_px(points).flatten()

    size = problem.structure.kept_size
    zero = torch.zeros(size + 6 * views, dtype=torch.float64)
    dense = torch.autograd.functional.jacobian(moved, zero).view(len(corners), 2, -1)
    torch.testing.assert_close(dense[..., :size], at.by_kept[0], rtol=1e-7, atol=1e-6)
    for row in range(0, len(corners), 17):
        at_view = size + 6 * int(points.view[row])
        torch.testing.assert_close(dense[row, :, at_view : at_view + 6], at.by_eliminated[row], rtol=1e-7, atol=1e-6)


def test_resection_is_exact_past_ninety_degrees():
    poses = facing_poses(12, 150, seed=2)
    seen = poses.transform(torch.as_tensor(BOARD))
    bearings = (seen / seen.norm(dim=-1, keepdim=True)).reshape(-1, 3)
    view = np.repeat(np.arange(12), len(BOARD))
    corners = Corners(view, ("v",) * 12, ("i",) * 12, np.tile(BOARD, (12, 1)), np.zeros((len(view), 2)))
    found = resect_boards(board_points(corners, np.ones(len(view), bool), list(range(12))), bearings)
    torch.testing.assert_close(found.rotation, poses.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.translation, poses.translation, rtol=0, atol=1e-9)


def test_no_curve_is_invented_for_a_hopeless_centre():
    model, reach = LENSES["opencv-fisheye"]
    corners, _ = simulated(model, facing_poses(10, reach, seed=1), 0.0, 0)
    points = board_points(corners, np.ones(len(corners), bool), list(range(len(corners.images))))
    start = radial_start(points, torch.tensor([655.0, 466.0], dtype=torch.float64))
    assert start is not None and bool((torch.diff(start.theta) > 0).all())


@pytest.mark.slow
def test_parallel_boards_are_refused():
    flat = Pose(torch.eye(3).double().repeat(8, 1, 1), torch.zeros(8, 3).double())
    for view in range(8):
        flat.translation[view] = torch.tensor([0.1 * (view % 3) - 0.2, 0.1 * (view // 3) - 0.15, 0.3 + 0.02 * view]).double()
    for name in LENSES:
        corners, _ = simulated(FISHEYE, flat, 0.1, 0)
        with pytest.raises(GeometryError, match=r"all boards parallel.*add photos"):
            calibrate_camera(corners, FISHEYE.image_size, name, loss="none")


def test_too_few_views_and_corners_are_refused():
    corners, _ = simulated(FISHEYE, facing_poses(2, 60, seed=1), 0.1, 0)
    with pytest.raises(InputError, match="at least 3, found 2"):
        calibrate_camera(corners, FISHEYE.image_size)
    corners, _ = simulated(FISHEYE, facing_poses(12, 80, seed=1), 0.1, 0)
    keep = np.flatnonzero((corners.view != 0) | (np.arange(len(corners)) < 5))
    fewer = Corners(corners.view[keep], corners.view_names, corners.images, corners.board_m[keep], corners.pixels[keep])
    result = calibrate_camera(fewer, FISHEYE.image_size)
    assert result.views[0].reason == "only 5 corners, at least 6 are needed"
    assert result.views[1].used


def test_a_narrow_model_says_that_it_cannot_hold_a_wide_lens():
    corners, _ = simulated(WIDE, facing_poses(30, 120, seed=9, distance=(0.2, 0.4)), 0.2, 1)
    with pytest.raises(GeometryError, match=r"pinhole.*scaramuzza or opencv-fisheye"):
        calibrate_camera(corners, (1280, 960), "pinhole")
    with pytest.raises(InputError, match="use `model` scaramuzza"):
        calibrate_camera(corners, (1280, 960), "opencv-fisheye", mirror=True)


@pytest.mark.slow
def test_photos_and_published_corners_give_the_same_bearings(shared_data, tmp_path):
    """At least 13 of 15 photos used, at most 0.35 px, and bearings that agree with the fit to `corners.csv`: the difference after
    the best common rotation lies within what the covariances of both fits predict (99 percent of 200 joint draws)."""
    folder = shared_data / "calibration/fisheye1"
    calibrate_photos([folder / "images"], "checkerboard:8x6:32.5mm", tmp_path)
    stored = camera_models.load(tmp_path / "calibration.yaml")
    photos, estimate = stored["cam0"], stored.estimates["cam0"]
    assert sum(view.used for view in stored.views) >= 13
    assert estimate.rms_px_per_axis <= 0.35
    corners = calibrate_camera(read_corners(folder / "corners.csv"), (1032, 778), "scaramuzza", loss="none")
    reach = min(estimate.max_angle_deg, corners.max_angle_deg)
    measured = bearing_error_deg(photos, corners.model, reach)
    rng = np.random.default_rng(0)
    middle = corners.model.parameters.numpy()
    drawn = []
    for _ in range(200):
        first = middle + rng.multivariate_normal(np.zeros(len(middle)), estimate.covariance, check_valid="ignore")
        second = middle + rng.multivariate_normal(np.zeros(len(middle)), corners.covariance, check_valid="ignore")
        drawn.append(bearing_error_deg(photos.with_parameters(first), corners.model.with_parameters(second), reach))
    print(f"bearing difference {measured:.4f} deg, predicted median {np.median(drawn):.4f}, 99 % {np.quantile(drawn, 0.99):.4f}")
    assert measured <= np.quantile(drawn, 0.99)
