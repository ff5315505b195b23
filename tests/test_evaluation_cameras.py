"""Metrics against closed forms, and simulated cameras and corners against what they promise."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import torch

from calib_patterns import pattern
from calib_patterns.board_poses import random_board_poses
from camera_models import MODELS, GeometryError, InputError, OpenCVFisheye, Pinhole, Scaramuzza, model_class
from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines
from omnilines.calibration.board_lines import board_lines
from omnilines.calibration.single import calibrate_camera
from omnilines.evaluation.cameras import bearing_error_deg, bearing_errors, line_errors, parameter_errors
from omnilines.geometry.line import PlueckerLines
from omnilines.pipelines.render import RenderOptions, render_targets
from omnilines.pipelines.rendered import RenderedTargets
from omnilines.records import ImagePoses
from omnilines.synthetic.targets import board_angle_rad, example_camera, simulate_corners

SIZE = (640, 480)
BOARD = pattern("checkerboard:8x6:30mm")
FISHEYE = OpenCVFisheye([160.0, 160.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0], SIZE)
SLANTED = Scaramuzza([322.0, 236.0, 0.995, 0.004, -0.003, 150.0, -3.3e-3, 5e-6, -4e-8], SIZE)
CALIBRATED = [name for name, _ in MODELS if model_class(name).CALIBRATED]


def test_a_longer_equidistant_lens_is_off_in_proportion_to_the_angle() -> None:
    """theta = r / f, so a focal length that is 1 percent longer shrinks every angle by 1 / 101 of itself."""
    longer = OpenCVFisheye([161.6, 161.6, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0], SIZE)
    errors = bearing_errors(longer, FISHEYE, math.radians(80.0))
    assert errors.theta_rad.max() > math.radians(79) and errors.theta_rad.max() <= math.radians(80)
    torch.testing.assert_close(errors.error_rad, errors.theta_rad / 101.0, atol=1e-9, rtol=1e-6)
    assert math.radians(errors.max_deg) == pytest.approx(float(errors.theta_rad.max()) / 101.0)
    assert bearing_error_deg(FISHEYE, FISHEYE, 1.5) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_bearing_errors_are_after_the_common_rotation() -> None:
    """A shift of the centre turns all bearings by about shift / f: what is left is of second order in the field of view."""
    narrow = Pinhole([2000.0, 2000.0, 319.5, 239.5, *([0.0] * 9)], SIZE)
    shifted = Pinhole([2000.0, 2000.0, 329.5, 239.5, *([0.0] * 9)], SIZE)
    errors = bearing_errors(shifted, narrow, 1.0)
    assert errors.max_deg < 0.02 < math.degrees(10 / 2000)
    turn = torch.acos(errors.rotation[2, 2])
    assert float(turn) == pytest.approx(10 / 2000, rel=0.02)


def test_pixels_that_the_estimate_does_not_see_count_as_wrong() -> None:
    folding = OpenCVFisheye([160.0, 160.0, 319.5, 239.5, -0.2, 0.0, 0.0, 0.0], SIZE)
    errors = bearing_errors(folding, FISHEYE, math.radians(85.0))
    assert errors.max_deg == pytest.approx(180.0)
    with pytest.raises(GeometryError, match="seen by both cameras"):
        bearing_errors(folding, FISHEYE, 1e-4)


@pytest.mark.parametrize("model", [SLANTED, *Scaramuzza.examples()])
def test_the_symmetric_form_is_the_same_camera_turned_about_its_axis(model: Scaramuzza) -> None:
    turned = model.calibrated_form()
    named = turned.named_parameters()
    assert named["e"] == pytest.approx(named["d"], abs=1e-15)
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, np.array(model.image_size) - 1, (200, 2))
    (old, seen), (new, also) = model.unproject(pixels), turned.unproject(pixels)
    assert (seen == also).mean() > 0.98
    both = seen & also
    np.testing.assert_allclose(new[both, 2], old[both, 2], atol=1e-12)
    angles = np.arctan2(new[both, 1], new[both, 0]) - np.arctan2(old[both, 1], old[both, 0])
    off = np.abs(np.exp(1j * angles) - np.exp(1j * angles[0]))
    assert off.max() < 1e-9
    assert turned.calibrated_form().parameters.tolist() == pytest.approx(turned.parameters.tolist(), rel=1e-12)


def test_errors_of_parameters_follow_chi_square() -> None:
    """Draws from a known covariance along the estimated directions: the mean is q, and the limit is passed once in 1000."""
    truth = SLANTED.calibrated_form()
    basis = truth.calibration_basis().numpy()
    q = basis.shape[1]
    rng = np.random.default_rng(3)
    size = np.abs(np.linalg.pinv(basis) @ truth.parameters.numpy()) * 1e-3 + 1e-12
    mix = rng.standard_normal((q, q)) + 2 * np.eye(q)
    factor = size[:, None] * mix
    covariance = basis @ factor @ factor.T @ basis.T
    found = []
    for _ in range(400):
        estimate = truth.with_parameters(truth.parameters.numpy() + basis @ factor @ rng.standard_normal(q))
        found.append(parameter_errors(estimate, covariance, SLANTED))
    statistics = np.array([errors.statistic for errors in found])
    assert scipy.stats.kstest(statistics, scipy.stats.chi2(q).cdf).pvalue > 0.001
    z = np.array([errors.z for errors in found])
    assert np.abs(z.std(0) - 1).max() < 0.2
    assert found[0].limit == pytest.approx(scipy.stats.chi2.ppf(0.999, q))
    assert parameter_errors(estimate, covariance, SLANTED, 30.0).limit > found[0].limit
    assert found[0].names[:3] == ("cx", "cy", "c") and "e" not in found[0].names


def test_what_cannot_be_compared_is_refused() -> None:
    covariance = np.eye(13)
    skewed = Pinhole([600.0, 600.0, 320.0, 240.0, 2.0, *([0.0] * 8)], SIZE)
    plain = Pinhole([600.0, 600.0, 320.0, 240.0, 0.0, *([0.0] * 8)], SIZE)
    with pytest.raises(GeometryError, match="another skew"):
        parameter_errors(plain, covariance, skewed)
    with pytest.raises(GeometryError, match="Parameters of one model"):
        parameter_errors(plain, covariance, FISHEYE)
    with pytest.raises(GeometryError, match="zero"):
        parameter_errors(plain, np.zeros((13, 13)), plain)


def test_a_calibration_of_a_higher_degree_than_the_truth() -> None:
    """Its further coefficient is compared with zero; a truth of a higher degree than the calibration is none of its kind."""
    truth = SLANTED.calibrated_form()
    higher = truth.of_variant({"degree": 5}, torch.zeros(0, dtype=torch.float64))
    found = Scaramuzza([*higher.parameters.tolist()[:-1], 2e-12], SIZE)
    covariance = np.diag(np.full(len(found.parameters), 1e-12) ** 2)
    errors = parameter_errors(found, covariance, SLANTED)
    assert errors.names[-1] == "a5" and errors.z[-1] == pytest.approx(2.0)
    np.testing.assert_allclose(errors.error[:-1], 0.0, atol=1e-12)
    with pytest.raises(GeometryError, match="Parameters of one model"):
        parameter_errors(truth, covariance[:-1, :-1], higher)


@functools.cache
def _eight_poses() -> Pose:
    return random_board_poses(BOARD, FISHEYE, 8, math.radians(80.0), seed=1)


def _adjusted_board(sigma_px: float, seed: int, stated_px: float = 0.05) -> tuple[Adjusted, np.ndarray, np.ndarray]:
    """Lines of the board from noisy corners in 8 photos with known camera and poses, and the noise that is said to be in them."""
    poses = _eight_poses()
    corners = simulate_corners(FISHEYE, BOARD, poses, sigma_px, seed)
    board = board_lines(corners, np.ones(len(corners), dtype=bool))
    named = ImagePoses(corners.images, poses)
    segments = replace(board.segments, sigma_px=np.full(len(board.segments), stated_px))
    arcs = arcs_from_segments(segments, named, {"cam0": FISHEYE}).arcs
    true = torch.as_tensor(board.ends_m)
    start = PlueckerLines.from_points(true[:, 0], true[:, 1] + 1e-4)
    adjusted = adjust_lines(arcs, start, poses, cost="whitened", refine_poses=False)
    lines = adjusted.state.chart.lines()
    ends = lines[:, None].closest_point(true).numpy()
    return adjusted, ends, board.ends_m


def test_errors_of_lines_follow_the_covariance_of_the_stated_noise() -> None:
    found = []
    for seed in range(25):
        adjusted, ends, true = _adjusted_board(0.05, seed)
        found.append(line_errors(adjusted, ends[:, ::-1].copy(), true))
    size = 4 * len(true) - 7
    statistics = np.array([errors.statistic for errors in found])
    assert scipy.stats.kstest(statistics, scipy.stats.chi2(size).cdf).pvalue > 0.001
    assert found[0].limit == pytest.approx(scipy.stats.chi2.ppf(0.999, size))
    ratio = np.sqrt(np.mean([errors.aligned.rms_m**2 / errors.predicted_rms_m**2 for errors in found]))
    assert 0.75 < ratio < 1.1


def test_noise_beyond_what_is_stated_does_not_widen_the_covariance() -> None:
    """Four times the stated noise: the prediction stays, the statistic grows by 16."""
    honest = line_errors(*_adjusted_board(0.05, 0))
    noisy = line_errors(*_adjusted_board(0.2, 0))
    assert noisy.predicted_rms_m == pytest.approx(honest.predicted_rms_m, rel=0.02)
    assert noisy.statistic == pytest.approx(16 * honest.statistic, rel=0.05) and noisy.statistic > noisy.limit


def test_lines_are_compared_after_a_similarity() -> None:
    """Exact lines in a turned, shifted and smaller frame have no error; one that is moved has just that."""
    adjusted, ends, true = _adjusted_board(0.0, 0)
    small = Pose(rotation_from_vector(torch.tensor([0.1, -0.2, 0.3]).double()), torch.tensor([1.0, 2.0, 3.0]).double())
    moved = small.transform(0.5 * torch.as_tensor(true).reshape(-1, 3)).reshape(-1, 2, 3)
    errors = line_errors(adjusted, ends, moved)
    assert errors.aligned.scale == pytest.approx(0.5, rel=1e-6)
    assert float(errors.distance_m.max()) < 1e-9 and float(errors.angle_rad.max()) < 1e-7
    assert errors.statistic < 1e-6
    bent = torch.as_tensor(true).clone()
    bent[3, :, 2] += 1e-3
    errors = line_errors(adjusted, ends, bent)
    assert int(errors.distance_m.mean(1).argmax()) == 3 and 7e-4 < float(errors.distance_m.max()) < 1e-3
    assert errors.statistic > errors.limit


@pytest.mark.parametrize("name", CALIBRATED)
def test_example_cameras_have_the_field_of_view_asked_for(name: str) -> None:
    centres, curves = set(), set()
    for seed in range(5):
        for fov in (60.0, 90.0, 120.0 if name == "pinhole" else 220.0):
            model = example_camera(name, fov, SIZE, seed)
            cx, cy = model.centre_px.tolist()
            radius = min(cx + 0.5, SIZE[0] - 0.5 - cx, cy + 0.5, SIZE[1] - 0.5 - cy)
            ring = np.linspace(0, 2 * np.pi, 24, endpoint=False)
            bearings, seen = model.unproject(np.array([cx, cy]) + radius * np.stack([np.cos(ring), np.sin(ring)], -1))
            assert seen.all()
            angles = np.degrees(np.arctan2(np.hypot(bearings[:, 0], bearings[:, 1]), bearings[:, 2]))
            assert np.abs(2 * angles.mean() - fov) < 1.5
            assert 3 < math.hypot(cx - 319.5, cy - 239.5) < 10
            centres.add((cx, cy))
            curves.add(tuple(model.parameters.tolist()))
        assert (
            example_camera(name, 90.0, SIZE, seed).parameters.tolist()
            == example_camera(name, 90.0, SIZE, seed).parameters.tolist()
        )
    assert len(centres) == 5 and len(curves) == 15


def test_what_a_model_cannot_hold_is_refused() -> None:
    with pytest.raises(InputError, match="20 to 130 degrees was expected for model pinhole, found 190"):
        example_camera("pinhole", 190.0, SIZE, 0)
    with pytest.raises(InputError, match="found 300"):
        example_camera("scaramuzza", 300.0, SIZE, 0)
    with pytest.raises(InputError, match="not calibrated"):
        example_camera("equirectangular", 190.0, SIZE, 0)
    with pytest.raises(InputError, match="seed"):
        example_camera("scaramuzza", 190.0, SIZE, -1)
    with pytest.raises(InputError, match="40x40"):
        example_camera("scaramuzza", 190.0, (20, 20), 0)


def test_simulated_corners_have_the_noise_asked_for() -> None:
    poses = random_board_poses(BOARD, FISHEYE, 12, math.radians(80.0), seed=0)
    exact, noisy = simulate_corners(FISHEYE, BOARD, poses, 0.0, 5), simulate_corners(FISHEYE, BOARD, poses, 0.3, 5)
    assert len(exact) == 12 * 48 and exact.sigma_px is None and noisy.sigma_px is not None
    true, _ = FISHEYE.project(poses.transform(torch.as_tensor(BOARD.points_m).expand(12, -1, -1)))
    np.testing.assert_allclose(exact.pixels, true.reshape(-1, 2).numpy(), atol=1e-12)
    np.testing.assert_array_equal(exact.board_m, np.tile(BOARD.points_m, (12, 1)))
    assert (noisy.pixels - exact.pixels).std() == pytest.approx(0.3, rel=0.1)


def test_photos_are_named_in_order_and_differ_by_seed() -> None:
    def draw(seed: int) -> RenderedTargets:
        return render_targets(BOARD, FISHEYE, RenderOptions(views=2, seed=seed), max_angle_deg=60.0)

    first, again, other = draw(0), draw(0), draw(1)
    assert list(first.photos) == ["view00.png", "view01.png"]
    assert all((first.photos[name] == again.photos[name]).all() for name in first.photos)
    assert any((first.photos[name] != other.photos[name]).any() for name in first.photos)
    assert first.photos["view00.png"].shape == (480, 640)
    assert not torch.equal(first.cam_from_board.translation, other.cam_from_board.translation)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fov"),
    [
        ("opencv-fisheye", 190.0),
        pytest.param("pinhole", 90.0, marks=pytest.mark.full),
        pytest.param("scaramuzza", 220.0, marks=pytest.mark.full),
    ],
)
def test_calibration_from_white_noise_agrees_with_its_covariance(name: str, fov: float) -> None:
    """The other half of `validate`, without a detector: over hidden lenses the statistic follows its distribution."""
    statistics = []
    for seed in range(8):
        truth = example_camera(name, fov, SIZE, seed)
        poses = random_board_poses(BOARD, truth, 10, board_angle_rad(fov), seed=seed)
        corners = simulate_corners(truth, BOARD, poses, 0.05, seed)
        sizes = {"degree": truth.degree} if isinstance(truth, Scaramuzza) else {}
        found = calibrate_camera(corners, SIZE, name, loss="none", options=sizes)
        freedom = 2 * len(corners) - truth.calibration_basis().shape[1] - 60
        errors = parameter_errors(found.model, found.covariance, truth, freedom)
        assert errors.statistic < errors.limit and errors.worst_z < 4.5
        statistics.append(errors.statistic / len(errors.z))
    assert 0.6 < np.mean(statistics) < 1.6
