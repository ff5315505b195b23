"""The synthetic studies against the Cramer-Rao bound and closed forms, and the Oxford model house."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from camera_models import InputError
from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.accuracy import align_lines, predict_error
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines
from omnilines.cli.experiments import parse_noise
from omnilines.commands.experiment_lines import experiment_lines
from omnilines.costs import COSTS
from omnilines.geometry.line import PlueckerLines
from omnilines.pages.line_study import COLUMNS, study_rows
from omnilines.studies.line_errors import aligned_rms_m, cramer_rao_bound
from omnilines.studies.line_experiments import LineStudyOptions, study_world
from omnilines.studies.line_study import (
    ADJUSTMENT,
    ESTIMATED,
    KNOWN,
    POSES,
    TRIANGULATION,
    refined_start,
    run_study,
    study_checks,
)
from omnilines.synthetic.lines import LineWorld, circle_world, room_world
from omnilines.synthetic.poses import perturbed_poses
from omnilines.triangulation import TRIANGULATIONS, triangulate
from omnilines.triangulation.observations import PlaneObservations

STUDIES = ("wide", "short", "room")


def lines_of(ends_m: torch.Tensor) -> PlueckerLines:
    return PlueckerLines.from_points(ends_m[..., 0, :], ends_m[..., 1, :])


# Scenes.


def test_circle_is_that_of_the_dissertation() -> None:
    for baseline, step in (("wide", 45.0), ("short", 9.0)):
        world = circle_world(baseline, 3)
        centre = world.cam_from_world.centre.numpy()
        assert (world.lines, world.images, len(world.image)) == (40, 8, 320)
        np.testing.assert_allclose(np.hypot(centre[:, 0], centre[:, 1]), 4.0, rtol=1e-12)
        np.testing.assert_allclose(centre[:, 2], 3.0, rtol=1e-12)
        turn = np.degrees(np.diff(np.unwrap(np.arctan2(centre[:, 1], centre[:, 0]))))
        np.testing.assert_allclose(turn, step, rtol=1e-10)
        assert world.ends_m.abs().max() <= 1 and world.ends_m.abs().max() > 0.95
        # The middle of the cube is seen at the principal point, up is up, and K is the published matrix.
        k = np.array([[1520.4, 0, 302.32], [0, 1525.9, 246.87], [0, 0, 1]])
        seen = world.cam_from_world.transform(
            torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]], dtype=torch.float64).expand(8, 2, 3)
        )
        np.testing.assert_allclose(seen[:, 0].numpy(), np.tile([0, 0, 5.0], (8, 1)), atol=1e-12)
        assert bool((seen[:, 1, 1] < 0).all()) and bool((seen[:, 1, 0].abs() < 1e-12).all())
        points = world.cam_from_world[world.image].transform(world.ends_m[world.track]).numpy() @ k.T
        np.testing.assert_allclose(world.ends_px.numpy(), points[..., :2] / points[..., 2:], atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_room_is_seen_all_around_and_cut_to_the_lens(seed: int) -> None:
    world = room_world(seed)
    bearings, seen = world.camera.unproject(world.ends_px)
    theta = torch.atan2(bearings[..., :2].norm(dim=-1), bearings[..., 2])
    assert bool(seen.all()) and float(theta.max()) <= math.radians(95) + 1e-6
    assert float((theta > math.pi / 2).double().mean()) > 0.05
    limit = torch.tensor(world.camera.image_size, dtype=torch.float64) - 0.5
    assert bool(((world.ends_px >= -0.5) & (world.ends_px <= limit)).all())
    assert world.images == 8 and world.lines >= 60
    assert int(torch.bincount(world.track).min()) >= 3
    # Cameras inside, lines on all six sides, and the exact segments lie on the lines.
    centre = world.cam_from_world.centre
    assert bool(((centre > 0.5) & (centre < torch.tensor([5.5, 4.5, 2.5]))).all())
    for axis, side in ((a, s) for a in range(3) for s in (0.0, (6.0, 5.0, 3.0)[a])):
        assert int(((world.ends_m[..., axis] - side).abs() < 1e-9).all(-1).sum()) >= 4
    normal = lines_of(world.ends_m)[world.track].projection_normal(world.cam_from_world[world.image])
    sine = (bearings * (normal / normal.norm(dim=-1, keepdim=True))[:, None]).sum(-1)
    assert float(sine.abs().max()) < 1e-9


def test_noise_is_that_of_its_seed_and_its_size() -> None:
    world = circle_world("wide", 0)
    first, again = world.segments(0.5, 7, 3), world.segments(0.5, 7, 3)
    np.testing.assert_array_equal(first.endpoints_px, again.endpoints_px)
    # More trials leave the first ones as they are; another seed does not.
    np.testing.assert_array_equal(world.segments(0.5, 7, 1).endpoints_px, first.endpoints_px[:320])
    assert not np.array_equal(world.segments(0.5, 8, 3).endpoints_px, first.endpoints_px)
    noise = first.endpoints_px - np.tile(world.ends_px.numpy(), (3, 1, 1))
    assert noise.std() == pytest.approx(0.5, rel=0.06) and not np.array_equal(noise[:320], noise[320:640])
    assert first.track.max() == 119 and first.image.max() == 23
    assert world.segments(0.0, 7).sigma_px is None
    with pytest.raises(InputError, match="at least 0 px"):
        world.segments(math.nan, 0)


# Alignment and bound.


def test_batched_alignment_is_that_of_one_trial_at_a_time() -> None:
    rng = np.random.default_rng(0)
    world = circle_world("wide", 1)
    ends = world.ends_m + 0.02 * torch.as_tensor(rng.standard_normal((5, *world.ends_m.shape)))
    turn = rotation_from_vector(torch.as_tensor(0.05 * rng.standard_normal((5, 3))))
    moved = 1.03 * ends.flatten(1, 2) @ turn.mT + 0.1
    lines = lines_of(moved.unflatten(1, (40, 2)))
    known = torch.ones(5, 40, dtype=torch.bool)
    known[3, :4] = False
    lines.direction[3, 0] = math.nan
    found = aligned_rms_m(lines, known, world.ends_m, with_scale=True)
    rigid = aligned_rms_m(lines, known, world.ends_m, with_scale=False)
    for k in range(5):
        own, ends_k = lines[k][known[k]], world.ends_m[known[k]]
        assert float(found[k]) == pytest.approx(align_lines(own, ends_k, ends_k).rms_m, rel=1e-6)
        # No turn or shift of the result brings it closer: compared with SciPy's minimum.
        assert float(rigid[k]) == pytest.approx(rigid_minimum(own, ends_k), rel=1e-6)
    assert bool((rigid > 1.2 * found).all())
    known[:, 2:] = False
    assert bool(torch.isnan(aligned_rms_m(lines, known, world.ends_m, with_scale=True)).all())


def rigid_minimum(lines: PlueckerLines, ends_m: torch.Tensor) -> float:
    from scipy.optimize import least_squares

    def distances(x: np.ndarray) -> np.ndarray:
        pose = Pose.exp(torch.as_tensor(x))
        moved = lines.transform(Pose(pose.rotation.expand(len(lines), 3, 3), pose.translation.expand(len(lines), 3)))
        return (ends_m - moved[:, None].closest_point(ends_m)).flatten().numpy()

    found = least_squares(distances, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return math.sqrt(float(found.fun @ found.fun) / (2 * len(lines)))


@pytest.mark.parametrize("study", STUDIES)
def test_bound_is_what_an_exact_adjustment_predicts(study: str) -> None:
    world = study_world(study, 0)
    bound = cramer_rao_bound(world, refine_poses=True)
    arcs = arcs_from_segments(world.segments(1.0, 0), world.poses(), {"cam0": world.camera}).arcs
    done = adjust_lines(arcs, lines_of(world.ends_m), world.cam_from_world, cost="whitened")
    predicted = predict_error(done, align_lines(done.state.chart.lines(), world.ends_m, world.ends_m)).rms_m
    assert predicted / done.noise_factor == pytest.approx(bound.rms_m, rel=0.05)
    # Knowing the poses can only help, and the residuals that are left follow from counting.
    known = cramer_rao_bound(world, refine_poses=False)
    assert known.rms_m < bound.rms_m
    rms_px = float(arcs.orthogonal_px(done.state.normals(arcs)).square().mean().sqrt())
    assert rms_px == pytest.approx(bound.rms_px, rel=0.08)


def test_bound_of_known_poses_by_hand() -> None:
    """Without the similarity: (J'J)^-1 of the pixel distances by central differences, line by line."""
    world = circle_world("wide", 2)
    few = LineWorld(world.camera, world.cam_from_world, world.ends_m, world.image, world.track, world.ends_px)
    k = np.array([[1520.4, 0, 302.32], [0, 1525.9, 246.87], [0, 0, 1]])
    total = 0.0
    for line in range(few.lines):
        rows = few.track == line
        poses, pixels = few.cam_from_world[few.image[rows]], few.ends_px[rows].numpy()
        ends = few.ends_m[line].numpy()
        direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        across = np.linalg.svd(direction[None])[2][1:]

        def distances(x: np.ndarray, ends=ends, across=across, poses=poses, pixels=pixels) -> np.ndarray:
            moved = torch.as_tensor(ends + x.reshape(2, 2) @ across)
            a, b = (poses.transform(moved.expand(len(poses), 2, 3)).numpy() @ k.T).swapaxes(0, 1)
            image_line = np.cross(a, b)
            homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1)
            return ((homogeneous * image_line[:, None]).sum(-1) / np.linalg.norm(image_line[:, None, :2], axis=-1)).ravel()

        step = 1e-5 * np.eye(4)
        jacobian = np.stack([(distances(h) - distances(-h)) / 2e-5 for h in step], 1)
        total += float(np.trace(np.linalg.inv(jacobian.T @ jacobian)))
    unaligned = math.sqrt(total / (2 * few.lines))
    # The similarity takes out a small part: about 7 of 160 degrees of freedom.
    bound = cramer_rao_bound(few, refine_poses=False).rms_m
    assert 0.9 * unaligned < bound < unaligned


# Trials.


def pooled(study: str, seeds: int, trials: int, noise: float = 0.5) -> dict[str, tuple[float, float]]:
    """(ratio, standard error) of the whitened cost in both settings over seeds, each with a scene of its own."""
    squares: dict[str, list[torch.Tensor]] = {}
    for seed in range(seeds):
        world = study_world(study, seed)
        found = run_study(
            world, (noise,), trials, perturb_deg=1.0, perturb_m=0.05, seed=seed, triangulations=(), costs=("whitened",)
        )
        for f in found.figures:
            assert bool(f.complete.all()), (seed, f.poses)
            squares.setdefault(f.poses, []).append((f.rms_3d_m / (noise * found.bounds[f.poses].rms_m)).square())
    every = {key: torch.cat(values) for key, values in squares.items()}
    assert all(len(q) == seeds * trials for q in every.values()) and len(every) == 2
    return {k: (float(q.mean().sqrt()), float(q.std() / (2 * math.sqrt(len(q)) * q.mean().sqrt()))) for k, q in every.items()}


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_whitened_adjustment_is_at_the_bound(study: str) -> None:
    found = pooled(study, seeds=2 if study == "wide" else 1, trials=5)
    for poses in POSES:
        ratio, error = found[poses]
        assert abs(ratio - 1) < 0.02 + 3 * error, (poses, ratio, error)


@pytest.mark.full
@pytest.mark.parametrize("study", STUDIES)
def test_whitened_adjustment_is_at_the_bound_over_200_seeds(study: str) -> None:
    found = pooled(study, seeds=20, trials=10)
    allowance = 0.03 if study == "room" else 0.02
    for poses in POSES:
        ratio, error = found[poses]
        assert ratio <= 1 + max(allowance, 2 * error), (poses, ratio, error)
        assert ratio >= 1 - 4 * error, (poses, ratio, error)


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.slow
def test_without_noise_there_is_no_error(study: str) -> None:
    costs = [name for name, _ in COSTS if study == "wide" or name == "whitened"]
    found = run_study(study_world(study, 1), (0.0,), 1, perturb_deg=1.0, perturb_m=0.05, seed=1, costs=costs)
    exact = [f for f in found.figures if f.poses == KNOWN or f.stage == ADJUSTMENT]
    assert len(exact) == len(TRIANGULATIONS) + 2 * len(costs)
    for f in exact:
        assert bool((f.found == 1).all()), f.method
        # Estimated poses converge to 1e-12 of a cost that is itself zero.
        limit = 1e-9 if f.poses == KNOWN else 1e-6
        assert float(f.rms_3d_m) < limit and float(f.rms_2d_px) < 1e3 * limit, (f.poses, f.method, f.rms_3d_m, f.rms_2d_px)


@pytest.mark.slow
def test_triangulation_follows_the_noise_and_poses_the_disturbance() -> None:
    found = run_study(circle_world("wide", 0), (0.5, 1.0), 2, perturb_deg=1.0, perturb_m=0.05, seed=0, costs=())
    for method, _ in TRIANGULATIONS:
        half, one = found.of(KNOWN, TRIANGULATION, method)
        assert float(one.rms_3d_m.mean() / half.rms_3d_m.mean()) == pytest.approx(2, rel=0.25)
        disturbed = found.of(ESTIMATED, TRIANGULATION, method)[0]
        assert float(disturbed.rms_3d_m.mean()) > 5 * float(half.rms_3d_m.mean())


def test_a_refined_start_brings_lost_lines_back() -> None:
    """1 degree and 5 cm put lines of the short baseline behind its cameras; poses refined with the others find them again."""
    world = circle_world("short", 0)
    lost = regained = 0
    for seed in range(3):
        arcs = arcs_from_segments(world.segments(0.5, seed), world.poses(), {"cam0": world.camera}).arcs
        disturbed = perturbed_poses(world.cam_from_world, 1.0, 0.05, seed)
        refined = refined_start(arcs, disturbed)
        known = [
            triangulate("dual", PlaneObservations.from_arcs(arcs.bearings, poses[arcs.image], arcs.track, 40)).known
            for poses in (disturbed, refined)
        ]
        lost += int((~known[0]).sum())
        regained += int((known[1] & ~known[0]).sum())
    assert lost > 0 and regained == lost


# The commands.


@pytest.mark.slow
@pytest.mark.parametrize("study", ["wide", "room"])
def test_command_writes_every_figure_and_the_same_seed_gives_the_same(study: str, tmp_path: Path) -> None:
    options = LineStudyOptions(noise_px=(0.5,), trials=2, seed=4)
    result = experiment_lines(study, tmp_path / "first", options)
    assert [path.name for path in result.files] == ["figures.csv", "report.html"]
    with open(tmp_path / "first" / "figures.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == len(options.noise_px) * 2 * (len(TRIANGULATIONS) + len(COSTS))
    assert {row["method"] for row in rows} == {name for name, _ in (*TRIANGULATIONS, *COSTS)}
    for row in rows:
        assert float(row["bound_3d_m"]) > 0 and float(row["rms_2d_px"]) > 0
        # A scale that is not taken out adds to the error.
        assert float(row["rms_3d_euclidean_m"]) > float(row["rms_3d_m"]) > 0
    data = json.loads(json.dumps(result.data, allow_nan=False))
    assert data["study"] == study and len(data["rows"]) == len(rows)
    assert data["rows"][0]["rms_3d_m"] == float(rows[0]["rms_3d_m"])
    again = run_study(
        study_world(study, 4), (0.5,), 2, perturb_deg=1.0, perturb_m=0.05, seed=4, triangulations=("svd",), costs=("sector",)
    )
    expected = {(row["poses"], row["method"]): row for row in data["rows"]}
    compared = 0
    for row in study_rows(again):
        assert row == expected[row["poses"], row["method"]]
        compared += 1
    assert compared == 4
    assert (data["beyond_90_deg"] > 0) == (study == "room")
    assert len(result.checks) == 4
    page = (tmp_path / "first" / "report.html").read_text(encoding="utf-8")
    assert "Cramer-Rao bound" in page and "Euclidean" in page


def test_a_biased_estimate_does_not_hold() -> None:
    world = circle_world("wide", 0)
    bias = 3.0 * torch.as_tensor(np.random.default_rng(0).standard_normal((320, 2, 2)))
    wrong = LineWorld(world.camera, world.cam_from_world, world.ends_m, world.image, world.track, world.ends_px + bias)
    found = run_study(wrong, (0.5,), 3, perturb_deg=1.0, perturb_m=0.05, seed=0, triangulations=(), costs=("whitened",))
    assert [check.holds for check in study_checks(found, 0.02)] == [False, True, False, True]


def test_bad_options_are_named(tmp_path: Path) -> None:
    assert parse_noise("0.5, 1,2") == (0.5, 1.0, 2.0)
    with pytest.raises(InputError, match="commas"):
        parse_noise("0.5;1")
    with pytest.raises(InputError, match="wide, short, room"):
        experiment_lines("narrow", tmp_path)
    with pytest.raises(InputError, match="At least one noise"):
        LineStudyOptions(noise_px=())
    with pytest.raises(InputError, match="At least one noise"):
        LineStudyOptions(noise_px=(-1.0,))
    with pytest.raises(InputError, match="trials"):
        LineStudyOptions(trials=0)
    with pytest.raises(InputError, match="disturbance"):
        LineStudyOptions(perturb_m=math.nan)
    with pytest.raises(InputError, match="seed of at least 0"):
        experiment_lines("wide", tmp_path, LineStudyOptions(seed=-1))


# The model house.
