"""Rolling shutters: recognised by the board's motion, and their line delay estimated with its standard deviation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clock_views import CAM_FROM_RIG, MODELS, HandMotion, noisy
from rolling_views import COLUMNS, ROWS, seen_in_rows
from test_cli import refused

import omnilines as ol
from camera_models import InputError
from camera_models.pose import Pose, rotation_from_vector
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.path import Path as BoardPath
from omnilines.calibration.rig.path import ViewTimes
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigProblem, RigState
from omnilines.calibration.rig.result import RigCalibration
from omnilines.files import write_corners
from omnilines.least_squares.schur import normal_equations
from omnilines.records import Corners

DELAY_S = 2.0e-5
NOISE_PX = 0.1
ONE = {"models": MODELS[:1], "cam_from_rig": CAM_FROM_RIG[[0]]}
"""The first camera alone."""


def of_one(corners: Corners) -> Corners:
    return replace(corners, cameras=None, frames=None)


def setups(count: int = 2) -> dict[str, CameraSetup]:
    return {f"cam{c}": CameraSetup(model.image_size, model.NAME) for c, model in enumerate(MODELS[:count])}


def rolling_notes(notes: tuple[str, ...]) -> list[str]:
    return [note for note in notes if "olling shutter" in note]


def problem_with_rows() -> tuple[RigProblem, RigState]:
    """Two cameras, two runs, two boards; rows of the first are read downwards, of the second upwards."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    degree, each = 2, 6
    keys = [(c, b, r, k) for c in range(2) for b in range(2) for r in range(2) for k in range(3)]
    camera, board, run, number = (torch.tensor(column) for column in zip(*keys, strict=True))
    view = torch.arange(len(keys)).repeat_interleave(each)
    place = torch.cat([0.1 * random(len(view), 2), torch.zeros(len(view), 1).double()], -1)
    times = ViewTimes(
        time_s=(number - 1) / 30 + 0.002 * random(len(keys)),
        unit_s=1 / 30,
        degree=degree,
        middle_m=torch.tensor([0.02, 0.01, 0.0]).double(),
        free=torch.tensor([False, True]),
        delayed=torch.tensor([True, True]),
    )
    points = RigPoints(
        view, place, torch.zeros(len(view), 2).double(), 0.5 + torch.rand(len(view), generator=generator).double(), camera,
        run, run, board, times=times, row_px=100 * random(len(view)),
    )  # fmt: skip
    ahead = Pose(torch.eye(3).double().expand(2, 3, 3), torch.tensor([0.0, 0.0, 0.6]).double().expand(2, 3))
    state = RigState(
        MODELS,
        Pose.stack([Pose.identity(), Pose.exp(0.1 * random(6))]),
        Pose.stack([Pose.identity(), Pose.exp(0.1 * random(6))]),
        ahead @ Pose.exp(0.1 * random(2, 6)),
        path=BoardPath(0.03 * random(2, degree, 6), torch.tensor([0.0, 0.004]).double(), torch.tensor([4e-5, -3e-5]).double()),
    )
    seen = replace(points, pixels=state.residual_px(points) + 0.3 * random(len(view), 2))
    bases = [model.calibration_basis() for model in MODELS]
    return RigProblem(seen, bases, 2, True, 2), state


def by_definition(problem: RigProblem, state: RigState, step: torch.Tensor) -> torch.Tensor:
    """Residuals after a step, corner by corner and by the formulas alone."""
    k, size = problem.structure.kept_size, problem.structure.dim
    moved, points = problem.retract(state, step[:k], step[k:].view(-1, size)), problem.points
    path, times = moved.path, points.times
    assert path is not None and times is not None and points.row_px is not None
    v = points.view
    camera, run, board = points.camera[v], points.frame[v], points.board[v]
    tau = (times.time_s[v] - path.offset_s[camera] + path.line_delay_s[camera] * points.row_px) / times.unit_s
    along = sum(path.rates[run, n] * tau[:, None] ** (n + 1) for n in range(times.degree))
    base = moved.rig_from_target[run]
    place = moved.target_from_board[board].transform(points.board_m[:, None])[:, 0] - times.middle_m
    turned = rotation_from_vector(along[:, :3]) @ base.rotation @ place[..., None]
    in_rig = turned[..., 0] + base.transform(times.middle_m.expand(len(v), 1, 3))[:, 0] + along[:, 3:]
    found = torch.zeros(len(v), 2, dtype=torch.float64)
    for c, model in enumerate(moved.models):
        own = camera == c
        found[own] = model.project(moved.cam_from_rig[c].transform(in_rig[own]))[0]
    return ((found - points.pixels) * points.weight[:, None]).flatten()


@pytest.mark.slow
def test_derivatives_are_those_of_automatic_differentiation() -> None:
    problem, state = problem_with_rows()
    k, count, size = problem.structure.kept_size, 2, problem.structure.dim
    zero = torch.zeros(k + count * size, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda step: by_definition(problem, state, step), zero)
    at = problem.linearise(state)
    torch.testing.assert_close(at.residual.flatten(), by_definition(problem, state, zero), rtol=1e-10, atol=1e-8)
    found = normal_equations(problem.structure, at, torch.ones(len(at.residual), dtype=torch.float64))
    scale = jacobian.norm(dim=0)
    dense = (jacobian / scale).mT @ (jacobian / scale)
    assert bool((scale > 0).all()) and problem.structure.groups[-2].count == 2 and problem.structure.groups[-1].count == 1
    torch.testing.assert_close(found.kept / scale[:k, None] / scale[:k], dense[:k, :k], rtol=0, atol=1e-9)
    right = -(jacobian / scale).mT @ at.residual.flatten()
    torch.testing.assert_close(found.kept_gradient / scale[:k], right[:k], rtol=1e-8, atol=1e-8)
    for r in range(count):
        own = slice(k + size * r, k + size * (r + 1))
        torch.testing.assert_close(found.eliminated[r] / scale[own, None] / scale[own], dense[own, own], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_camera_alone_is_recognised_and_estimated() -> None:
    corners = of_one(noisy(seen_in_rows(HandMotion(1), (DELAY_S,), runs=6, **ONE), NOISE_PX, 1))
    size = MODELS[0].image_size
    plain = ol.calibrate(corners, size, model="pinhole")
    assert plain.line_delay is not None and not plain.line_delay.modelled and plain.rms_px_per_axis > 2 * NOISE_PX
    (note,) = rolling_notes(plain.notes)
    assert note.startswith("Rolling shutter: ") and "rows read top to bottom" in note and "give `rolling_shutter`" in note
    found = ol.calibrate(corners, size, model="pinhole", rolling_shutter=True)
    delay = found.line_delay
    assert delay is not None and delay.modelled and not delay.columns
    assert abs(delay.delay_s - DELAY_S) < 4 * delay.sigma_s < 0.03 * DELAY_S
    assert found.rms_px_per_axis < 1.02 * NOISE_PX and len(rolling_notes(found.notes)) == 1
    off = (found.camera.parameters - MODELS[0].parameters).numpy()
    free = np.diag(found.covariance) > 0
    # Chi-square of nine: beyond 34 once in ten thousand times.
    assert off[free] @ np.linalg.solve(found.covariance[np.ix_(free, free)], off[free]) < 34
    # The pose of a view is that of the middle row.
    first = next(view for view in found.views if view.used)
    assert first.cam_from_board is not None and corners.times_s is not None
    true = HandMotion(1).at(np.array([corners.times_s[corners.view_names.index(first.name)]]))[0]
    assert float((first.cam_from_board.translation - true.translation).norm()) < 1e-3
    assert "line_delay_s" in found.calibration.provenance["inputs"]


def test_frames_of_one_instant_are_not_called_rolling() -> None:
    corners = of_one(noisy(seen_in_rows(HandMotion(1), (0.0,), runs=6, **ONE), NOISE_PX, 1))
    plain = ol.calibrate(corners, MODELS[0].image_size, model="pinhole")
    assert plain.line_delay is None and not rolling_notes(plain.notes)


@pytest.mark.full
def test_none_is_estimated_where_there_is_none() -> None:
    corners = of_one(noisy(seen_in_rows(HandMotion(1), (0.0,), runs=8, **ONE), NOISE_PX, 1))
    asked = ol.calibrate(corners, MODELS[0].image_size, model="pinhole", rolling_shutter=True).line_delay
    assert asked is not None and abs(asked.delay_s) < 4 * asked.sigma_s < 0.03 * DELAY_S


def test_stills_and_slow_frames_are_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = of_one(noisy(seen_in_rows(HandMotion(1), (DELAY_S,), runs=3, **ONE), NOISE_PX, 1))
    assert corners.times_s is not None
    with pytest.raises(InputError, match="of stills there is nothing to estimate"):
        ol.calibrate(replace(corners, times_s=None), MODELS[0].image_size, model="pinhole", rolling_shutter=True)
    slow = replace(corners, times_s=4 * corners.times_s)
    with pytest.raises(InputError, match=r"consecutive frames .* at most 0.07 s apart; found none"):
        ol.calibrate(slow, MODELS[0].image_size, model="pinhole", rolling_shutter=True)
    write_corners(tmp_path / "corners.csv", replace(corners, times_s=None))
    asked = ("calibrate", tmp_path / "corners.csv", "--image-size", "1280x960", "--rolling-shutter", "--out", tmp_path / "out")
    assert "--rolling-shutter tells how rows are read" in refused(capsys, *asked)
    assert not (tmp_path / "out").exists()


def pose_error(result: RigCalibration) -> float:
    """Squared error of the second camera's pose in its covariance: chi-square of six."""
    second = result.members[1]
    off = (second.cam_from_rig @ CAM_FROM_RIG[1].inverse()).log().numpy()
    return float(off @ np.linalg.solve(second.pose_covariance, off))


@pytest.mark.full
def test_a_rig_of_two_rolling_shutters_that_run_freely() -> None:
    truth = (DELAY_S, -1.2e-5)
    corners = noisy(seen_in_rows(HandMotion(2), truth, offsets_s=(0.0, 0.0137), runs=8), NOISE_PX, 1)
    result = calibrate_rig(corners, setups(), rolling_shutter=True)
    assert len(result.line_delays) == 2 and result.rms_px_per_axis < 1.02 * NOISE_PX
    for member, true_s in zip(result.members, truth, strict=True):
        assert member.line_delay is not None and f"{member.name}.line_delay_s" in result.names
        assert abs(member.line_delay.delay_s - true_s) < 4 * member.line_delay.sigma_s < 4e-6
    second = result.members[1]
    assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
    assert abs(second.time_offset_s - 0.0137) < 4 * second.time_offset_sigma_s < 2e-4
    assert pose_error(result) < 28


@pytest.mark.full
@pytest.mark.parametrize(("member", "axis", "delay_s"), [(0, ROWS, DELAY_S), (1, COLUMNS, -1.5e-5)])
def test_line_delays_are_as_certain_as_stated(member: int, axis: int, delay_s: float) -> None:
    """Over motions and noise: bias, spread, and the camera's parameters."""
    errors, parameters = [], []
    one = {"models": MODELS[member : member + 1], "cam_from_rig": CAM_FROM_RIG[[0]]}
    for seed in range(24):
        corners = of_one(noisy(seen_in_rows(HandMotion(seed), (delay_s,), axis=axis, **one), NOISE_PX, seed))
        model = MODELS[member]
        found = ol.calibrate(corners, model.image_size, model=model.NAME, rolling_shutter=True)
        assert found.line_delay is not None and found.line_delay.columns == (axis == COLUMNS)
        errors.append((found.line_delay.delay_s - delay_s) / found.line_delay.sigma_s)
        free = np.diag(found.covariance) > 0
        off = (found.camera.parameters - model.parameters).numpy()[free]
        parameters.append(off @ np.linalg.solve(found.covariance[np.ix_(free, free)], off) / free.sum())
    assert abs(np.mean(errors)) < 3 / np.sqrt(24) and 0.6 < np.std(errors) < 1.45
    assert np.mean(parameters) < 1.5
