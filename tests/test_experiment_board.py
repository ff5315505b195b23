"""The board experiment on real corners, on photos, and on synthetic corners of a known board."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
import torch

import camera_models
from camera_models import GeometryError, InputError, OpenCVFisheye
from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.accuracy import align_lines
from omnilines.calibration.board_lines import board_lines
from omnilines.calibration.single import calibrate_camera
from omnilines.commands.experiment_board import experiment_board
from omnilines.files import read_corners, read_lines, read_poses, read_segments, write_corners
from omnilines.geometry.line import PlueckerLines
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.records import Corners
from omnilines.structure import regularity
from omnilines.studies.board import BoardOptions, board_experiment
from omnilines.studies.board_figures import FIGURES, UNCHECKED, BoardExperiment
from omnilines.synthetic.poses import perturbed_poses

FISHEYE1 = "calibration/fisheye1"
CHECKED = [key for key, _, _ in FIGURES if key not in UNCHECKED]
CAMERA = OpenCVFisheye([320.0, 322.0, 510.0, 390.0, 0.02, -0.01, 0.002, 0.0], (1032, 778))
SQUARE_M = 0.03


def synthetic_corners(noise_px: float, seed: int, views: int = 12, nx: int = 8, ny: int = 6) -> Corners:
    """Corners of a tilted board in front of a fisheye camera, all within its image."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    board = SQUARE_M * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(np.float64)
    tilt = torch.as_tensor(rng.uniform(-0.8, 0.8, (views, 3)))
    rotation = rotation_from_vector(tilt)
    middle = np.concatenate([rng.uniform(-0.04, 0.04, (views, 2)), rng.uniform(0.15, 0.2, (views, 1))], 1)
    offset = rotation @ torch.as_tensor(board.mean(0))
    poses = Pose(rotation, torch.as_tensor(middle) - offset)
    pixels, valid = CAMERA.project(poses.transform(torch.as_tensor(board).expand(views, -1, -1)))
    assert valid.all() and float(pixels.min()) > 0 and bool((pixels.amax((0, 1)) < torch.tensor([1031, 777])).all())
    noisy = pixels.numpy().reshape(-1, 2) + noise_px * rng.standard_normal((views * len(board), 2))
    names = tuple(f"{k}.png" for k in range(views))
    return Corners(np.repeat(np.arange(views), len(board)), names, names, np.tile(board, (views, 1)), noisy)


def run(corners: Corners, size: tuple[int, int], model: str, loss: str = "none", seed: int = 0, **options) -> BoardExperiment:
    found = PhotoCorners(corners, size, (), Path("nowhere"))
    calibration = calibrate_camera(corners, size, model, loss=loss, options={"degree": 4} if model == "scaramuzza" else None)
    return board_experiment(found, calibration, BoardOptions(**options, seed=seed))


# Structure.


def test_structure_of_a_perfect_grid_and_of_known_departures() -> None:
    rows = np.array([[[0, 0.2 * k, 0], [1, 0.2 * k, 0]] for k in range(4)], dtype=np.float64)
    columns = np.array([[[0.25 * k, 0, 0], [0.25 * k, 0.6, 0]] for k in range(5)], dtype=np.float64)
    turn = rotation_from_vector(torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64)).numpy()
    ends = np.concatenate([rows, columns]) @ turn.T + np.array([3.0, 1.0, -2.0])
    off, angle = regularity.coplanarity(ends)
    assert isinstance(off, np.ndarray) and float(off) < 1e-14 and float(angle) < 1e-14
    np.testing.assert_allclose(regularity.spacing(ends[:4]), 0.2, rtol=1e-12)
    np.testing.assert_allclose(regularity.spacing(torch.as_tensor(ends[4:])).numpy(), 0.25, rtol=1e-12)
    a, b = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (ends[:4, 1] - ends[:4, 0], ends[4:, 1] - ends[4:, 0]))
    # Of either sign.
    a = a * np.array([[1], [-1], [1], [-1]])
    np.testing.assert_allclose(regularity.parallelism(a), 0, atol=1e-7)
    means, pairs = regularity.orthogonality(a, b)
    assert pairs.shape == (4, 5) and float(means) < 1e-12 and pairs.max() < 1e-12
    skew = rotation_from_vector(torch.tensor([0, 0, 0.01], dtype=torch.float64)).numpy()
    flat_b = np.tile([[0.0, 1.0, 0.0]], (5, 1)) @ skew.T
    means, pairs = regularity.orthogonality(np.tile([[1.0, 0.0, 0.0]], (4, 1)), flat_b)
    assert float(means) == pytest.approx(0.01, rel=1e-9) and pairs.min() == pytest.approx(0.01, rel=1e-9)
    fan = np.array([[math.cos(t), math.sin(t), 0] for t in (-0.02, 0.0, 0.02)])
    np.testing.assert_allclose(regularity.parallelism(fan), [0.02, 0, 0.02], atol=1e-9)
    lifted = rows.copy()
    lifted[:, 1, 2] = 0.01 * np.array([1, -1, -1, 1])
    off, angle = regularity.coplanarity(lifted)
    assert float(off) == pytest.approx(0.01 / math.sqrt(2), rel=0.01) and float(angle) == pytest.approx(0.01, rel=0.01)
    with pytest.raises(GeometryError, match="at least 2 lines"):
        regularity.coplanarity(rows[:1])


def test_alignment_finds_the_similarity_from_lines_alone() -> None:
    rng = np.random.default_rng(3)
    true_ends = torch.as_tensor(rng.standard_normal((9, 2, 3)))
    rotation = rotation_from_vector(torch.tensor([0.4, 0.1, -0.8], dtype=torch.float64))
    scale, shift = 2.7, torch.tensor([0.3, -4.0, 1.0], dtype=torch.float64)
    moved = (true_ends - shift) @ rotation / scale
    lines = PlueckerLines.from_points(moved[:, 0], moved[:, 1])
    # Start points that have slid along the lines by a fifth of their length.
    slid = moved + 0.2 * (moved[:, 1:] - moved[:, :1]) * torch.as_tensor(rng.uniform(-1, 1, (9, 2, 1)))
    aligned = align_lines(lines, slid, true_ends)
    assert aligned.rms_m < 1e-7
    assert aligned.scale == pytest.approx(scale, rel=1e-6)
    torch.testing.assert_close(aligned.pose.rotation, rotation, rtol=0, atol=1e-6)
    camera = Pose.exp(torch.as_tensor(rng.standard_normal((4, 6))))
    seen = camera.transform(moved.reshape(-1, 3).expand(4, -1, -1))
    again = aligned.transform_poses(camera).transform(true_ends.reshape(-1, 3).expand(4, -1, -1))
    torch.testing.assert_close(again, scale * seen, rtol=0, atol=1e-5)


def test_board_lines_run_from_the_first_to_the_last_chosen_corner() -> None:
    corners = synthetic_corners(0.0, 0, views=3)
    chosen = np.ones(len(corners), dtype=bool)
    board = board_lines(corners, chosen)
    assert board.segments.tracks == tuple(f"row{k}" for k in range(6)) + tuple(f"col{k}" for k in range(8))
    assert len(board.segments) == 3 * 14 and board.column.tolist() == [False] * 6 + [True] * 8
    np.testing.assert_allclose(board.ends_m[0], [[0, 0, 0], [7 * SQUARE_M, 0, 0]])
    np.testing.assert_allclose(board.ends_m[6 + 2], [[2 * SQUARE_M, 0, 0], [2 * SQUARE_M, 5 * SQUARE_M, 0]])
    # Rows of a view are 8 corners after each other; without its first corner, row 1 of view 2 starts at the second.
    first = 2 * 48 + 8
    chosen[first] = False
    less = board_lines(corners, chosen)
    row = np.flatnonzero((less.segments.image == 2) & (less.segments.track == 1))
    assert len(row) == 1
    np.testing.assert_array_equal(less.segments.endpoints_px[row[0]], corners.pixels[[first + 1, first + 7]])
    np.testing.assert_array_equal(less.ends_m, board.ends_m)
    with pytest.raises(InputError, match=r"two in 0\.png"):
        board_lines(replace(corners, images=("0.png", "0.png", "2.png")), chosen)
    with pytest.raises(InputError, match="at least 2 rows"):
        board_lines(corners, corners.board_m[:, 1] == 0)


def test_perturbation_has_the_stated_size_and_is_that_of_its_seed() -> None:
    poses = Pose.exp(torch.as_tensor(np.random.default_rng(0).standard_normal((6, 6))))
    moved = perturbed_poses(poses, 1.0, 0.01, 3)
    turn = Pose(moved.rotation @ poses.rotation.mT, torch.zeros(6, 3, dtype=torch.float64)).log()[:, :3]
    torch.testing.assert_close(turn.norm(dim=-1), torch.full((6,), math.radians(1), dtype=torch.float64))
    torch.testing.assert_close((moved.centre - poses.centre).norm(dim=-1), torch.full((6,), 0.01, dtype=torch.float64))
    assert torch.equal(moved.rotation, perturbed_poses(poses, 1.0, 0.01, 3).rotation)
    assert not torch.equal(moved.rotation, perturbed_poses(poses, 1.0, 0.01, 4).rotation)


# A known board: the adjusted lines are as far from it as the residuals predict.


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [10, pytest.param(60, marks=pytest.mark.full)])
def test_synthetic_lines_agree_with_the_board_as_predicted(seeds: int) -> None:
    by_noise, freedom, by_photos, noise_px, stages = [], [], [], [], []
    for seed in range(seeds):
        experiment = run(synthetic_corners(0.25, seed), CAMERA.image_size, "opencv-fisheye", seed=seed)
        assert experiment.notes == ()
        assert experiment.by_noise.ratio < experiment.by_noise.limit
        assert experiment.by_photos.ratio < experiment.by_photos.limit
        by_noise.append(experiment.by_noise.ratio)
        freedom.append(experiment.predicted.effective_freedom)
        by_photos.append(experiment.by_photos.ratio)
        noise_px.append(experiment.adjusted.noise_factor)
        stages.append([[state.figures[key] for key in CHECKED] for state in (experiment.before, experiment.after)])
    assert len(by_noise) == seeds
    # Over the seeds; in a single one, random poses may by luck leave some angles smaller than noise does.
    before, after = np.sqrt(np.mean(np.square(stages), axis=0))
    assert [key for key, b, a in zip(CHECKED, before, after, strict=True) if not a < b] == []
    assert np.sqrt(np.mean(np.square(noise_px))) == pytest.approx(0.25, rel=0.06)
    # One mode, a bend of the board, makes up most of the error: chi^2 of few degrees of freedom, added up over the seeds.
    total = float(np.sum(freedom))
    low, high = np.sqrt(scipy.stats.chi2.ppf([0.001, 0.999], total) / total)
    assert low < np.sqrt(np.average(np.square(by_noise), weights=freedom)) < high
    assert 0.5 < np.sqrt(np.mean(np.square(by_photos))) < 1.5


@pytest.mark.slow
def test_a_deformed_board_is_told_from_noise() -> None:
    """A board twisted by a millimetre at its corners breaks the limit that noise alone would keep; its lines stay straight."""
    corners = synthetic_corners(0.05, 1)
    x, y, z = (corners.board_m / (SQUARE_M * np.array([7, 5, 1]))).T
    twisted = corners.board_m + np.stack([z, z, 0.001 * (2 * x - 1) * (2 * y - 1)], 1)
    calibration = calibrate_camera(corners, CAMERA.image_size, "opencv-fisheye", loss="none")
    poses = Pose.stack([view.cam_from_board for view in calibration.views if view.cam_from_board is not None])
    seen = poses[torch.as_tensor(corners.view)].transform(torch.as_tensor(twisted)[:, None])[:, 0]
    pixels, _ = calibration.model.project(seen)
    noise = 0.05 * np.random.default_rng(0).standard_normal((len(corners), 2))
    experiment = run(replace(corners, pixels=pixels.numpy() + noise), CAMERA.image_size, "opencv-fisheye")
    assert experiment.by_noise.ratio > experiment.by_noise.limit
    assert experiment.after.figures["coplanarity_rms_mm"] > 0.3


def test_numbering_turned_by_half_a_turn_is_harmless() -> None:
    """In every second photo the board is numbered from the other corner, as a plain board allows: its pose absorbs that."""
    corners = synthetic_corners(0.2, 5)
    odd = corners.view % 2 == 1
    turned = np.where(odd[:, None], corners.board_m.max(0) - corners.board_m, corners.board_m)
    straight = run(corners, CAMERA.image_size, "opencv-fisheye", perturb_deg=0.0, perturb_m=0.0)
    both = run(replace(corners, board_m=turned), CAMERA.image_size, "opencv-fisheye", perturb_deg=0.0, perturb_m=0.0)
    assert both.calibration.rms_px_per_axis == pytest.approx(straight.calibration.rms_px_per_axis, rel=1e-9)
    assert both.adjusted.noise_factor == pytest.approx(straight.adjusted.noise_factor, rel=0.1)
    assert both.by_noise.ratio < both.by_noise.limit
    worst = {key: max(straight.after.figures[key], both.after.figures[key]) for key in CHECKED}
    assert all(worst[key] < 4 * min(straight.after.figures[key], both.after.figures[key]) for key in CHECKED)


# Real data.


@pytest.fixture(scope="module")
def fisheye1(shared_data: Path) -> tuple[Corners, BoardExperiment]:
    corners = read_corners(shared_data / FISHEYE1 / "corners.csv")
    return corners, run(corners, (1032, 778), "scaramuzza", loss="cauchy")


@pytest.mark.slow
def test_every_figure_improves_on_real_corners(fisheye1: tuple[Corners, BoardExperiment]) -> None:
    corners, first = fisheye1
    assert len(first.tracks) == 14 and len(first.perturbed) == 15
    optimum = first.after.figures
    compared = 0
    for seed in range(5):
        found = PhotoCorners(corners, (1032, 778), (), Path("nowhere"))
        experiment = board_experiment(found, first.calibration, BoardOptions(seed=seed))
        before, after = experiment.before.figures, experiment.after.figures
        assert [key for key in CHECKED if not after[key] < before[key]] == [], seed
        # The same optimum from every start.
        assert after == pytest.approx(optimum, rel=1e-3)
        compared += 1
    assert compared == 5
    assert optimum["orthogonal_rms_px"] < 0.25
    assert optimum["board_error_rms_mm"] < 0.5
    assert first.by_photos.ratio < first.by_photos.limit


@pytest.mark.slow
def test_half_turns_of_real_photos_are_harmless(fisheye1: tuple[Corners, BoardExperiment]) -> None:
    corners, straight = fisheye1
    odd = corners.view % 2 == 1
    turned = np.where(odd[:, None], corners.board_m.max(0) - corners.board_m, corners.board_m)
    both = run(replace(corners, board_m=turned), (1032, 778), "scaramuzza", loss="cauchy")
    assert both.calibration.rms_px_per_axis == pytest.approx(straight.calibration.rms_px_per_axis, rel=1e-3)
    # Only where the print is off its grid do the two numberings differ.
    assert both.adjusted.noise_factor == pytest.approx(straight.adjusted.noise_factor, rel=0.2)
    assert both.by_photos.ratio < both.by_photos.limit


def test_command_writes_everything(shared_data: Path, tmp_path: Path) -> None:
    result = experiment_board(shared_data / FISHEYE1, tmp_path / "out")
    assert result.holds, [check for check in result.checks if not check.holds]
    assert len(result.checks) == len(CHECKED) + 2
    names = "calibration.yaml corners.csv segments.csv poses_perturbed.csv poses.csv lines.csv lines.ply report.html".split()
    assert sorted(path.name for path in result.files) == sorted(names)
    assert all(path.stat().st_size > 0 for path in result.files)
    data = json.loads(json.dumps(result.data, allow_nan=False))
    assert data["after"]["orthogonal_rms_px"] < data["before"]["orthogonal_rms_px"] / 10
    out = tmp_path / "out"
    lines, poses, segments = read_lines(out / "lines.csv"), read_poses(out / "poses.csv"), read_segments(out / "segments.csv")
    model = camera_models.load(out / "calibration.yaml")["cam0"]
    # The files by themselves give the residual that the command reports.
    image = torch.tensor([poses.images.index(name) for name in segments.images])[torch.as_tensor(segments.image)]
    track = torch.tensor([lines.tracks.index(name) for name in segments.tracks])[torch.as_tensor(segments.track)]
    ends = torch.as_tensor(lines.ends_m)[track]
    steps = torch.linspace(-0.2, 1.2, 4001, dtype=torch.float64)[:, None]
    curve, _ = model.project(poses.cam_from_world[image].transform(ends[:, :1] * (1 - steps) + ends[:, 1:] * steps))
    distance = torch.cdist(torch.as_tensor(segments.endpoints_px), curve).amin(-1)
    rms = float(distance.square().mean().sqrt())
    assert rms == pytest.approx(data["after"]["orthogonal_rms_px"], rel=0.03)
    # In the frame and scale of the board.
    assert np.abs(lines.ends_m[..., 2]).max() < 2e-3
    with open(out / "lines.csv", newline="") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["ok"] * 14
    assert (out / "report.html").read_text(encoding="utf-8").count("data:image/jpeg") >= 15


@pytest.mark.slow
def test_from_the_photos(shared_data: Path, tmp_path: Path) -> None:
    result = experiment_board(shared_data / FISHEYE1 / "images", tmp_path)
    assert result.holds, [check for check in result.checks if not check.holds]
    assert result.data["photos_used"] >= 13
    assert result.data["rms_px_per_axis"] <= 0.35


def test_bad_input_is_named(shared_data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 0 degrees"):
        BoardOptions(perturb_deg=math.nan)
    with pytest.raises(InputError, match="does not exist"):
        experiment_board(tmp_path / "nothing", tmp_path)
    write_corners(tmp_path / "corners.csv", synthetic_corners(0.1, 0, views=4))
    with pytest.raises(InputError, match="image size"):
        experiment_board(tmp_path, tmp_path / "out")
    (tmp_path / "reference.json").write_text('{"image_size": 3}')
    with pytest.raises(InputError, match=r"reference\.json"):
        experiment_board(tmp_path, tmp_path / "out")
