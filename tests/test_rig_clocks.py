"""Cameras that run freely: the offset of each clock is found by itself from the board's motion, with its standard deviation."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clock_views import CAM_FROM_RIG, MODELS, HandMotion, noisy, seen_freely
from rendered_video import write_video
from rig_views import FISHEYE_220, PINHOLE

import omnilines as ol
from calib_patterns import pattern
from camera_models import InputError, OpenCVFisheye
from camera_models.pose import Pose, rotation_from_vector
from omnilines.calibration.rig import calibrate
from omnilines.calibration.rig.against_alone import against_alone
from omnilines.calibration.rig.alone import CameraSetup, alone_camera
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.clock_search import STEPS_OF_GAP, ClockSearch
from omnilines.calibration.rig.finish import rig_result
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.path import Path as BoardPath
from omnilines.calibration.rig.path import ViewTimes, moved_run, path_derivatives, pose_along
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.runs import find_runs, usual_gap_s
from omnilines.calibration.rig.start import ViewNumberings, numberings_of, posed_views
from omnilines.calibration.rig.views import RigViews, views_of
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.files import read_rig_corners, write_corners

OFFSET_S = 0.0137
NOISE_PX = 0.1
SETUPS = {f"cam{c}": CameraSetup(model.image_size, model.NAME) for c, model in enumerate(MODELS)}


def told(result: RigCalibration) -> list[str]:
    return [note for note in result.notes if note.startswith("The cameras' clocks differ")]


class Resting(HandMotion):
    """Moved on every two seconds, and at rest else."""

    def at(self, time_s: np.ndarray) -> Pose:
        return super().at(2.0 * np.floor((time_s + 1.0) / 2.0))


def pose_error(result: RigCalibration) -> float:
    """Squared error of the second camera's pose in its covariance: chi-square of six."""
    second = result.members[1]
    off = (second.cam_from_rig @ CAM_FROM_RIG[1].inverse()).log().numpy()
    return float(off @ np.linalg.solve(second.pose_covariance, off))


def test_the_path_has_the_derivatives_that_differences_have() -> None:
    generator = torch.Generator().manual_seed(0)
    count, degree = 6, 4
    middle = torch.tensor([0.2, 0.1, 0.0], dtype=torch.float64)
    base = Pose.exp(torch.randn(count, 6, generator=generator, dtype=torch.float64))
    rates = 0.1 * torch.randn(count, degree, 6, generator=generator, dtype=torch.float64)
    time_s = 0.07 * torch.randn(count, generator=generator, dtype=torch.float64)
    times = ViewTimes(time_s, 0.066, degree, middle, torch.tensor([False, True]), torch.tensor([False, False]))
    path, camera = BoardPath(rates, torch.tensor([0.0, 0.01]).double(), torch.zeros(2).double()), torch.tensor([0, 1] * 3)
    found = path_derivatives(base, rates, times.tau(path, camera), times)
    pose = pose_along(base, rates, times.tau(path, camera), middle)
    step = 1e-6
    for k in range(6 * (1 + degree)):
        at = []
        for sign in (step, -step):
            moved, along = moved_run(
                base, path, sign * torch.eye(6 * (1 + degree), dtype=torch.float64)[k].repeat(count, 1), middle
            )
            at.append((pose_along(moved, along.rates, times.tau(path, camera), middle) @ pose.inverse()).log())
        assert torch.allclose(found.by_run[..., k], (at[0] - at[1]) / (2 * step), atol=1e-7)
    at = [
        (pose_along(base, rates, times.tau(replace(path, offset_s=path.offset_s + tick), camera), middle) @ pose.inverse()).log()
        for tick in (step, -step)
    ]
    assert torch.allclose(found.by_offset[..., 0], (at[0] - at[1]) / (2 * step), atol=1e-6)


@pytest.mark.slow
def test_an_offset_is_found_by_itself_named_and_modelled() -> None:
    corners = noisy(seen_freely(HandMotion(2), (0.0, OFFSET_S), runs=6), NOISE_PX, 1)
    result = calibrate_rig(corners, SETUPS)
    second = result.members[1]
    assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
    assert abs(second.time_offset_s - OFFSET_S) < 4 * second.time_offset_sigma_s < 1e-4
    assert len(told(result)) == 1 and "cam1 by 13." in told(result)[0]
    assert "cam1.time_offset_s" in result.names and len(result.names) == len(result.covariance)
    # Chi-square of 6: beyond 28 once in ten thousand times.
    assert pose_error(result) < 28 and result.rms_px_per_axis < 1.02 * NOISE_PX
    # Poses are of the instants, not of runs.
    assert len(result.frames) == len(result.rig_from_target) == len(result.frame_covariance) >= 25
    frame = result.frames.index(next(view.frame for view in result.views if view.used and view.camera == "cam0"))
    view = next(view for view in result.views if view.used and view.camera == "cam0")
    assert view.cam_from_board is not None
    assert torch.allclose(view.cam_from_board.translation, result.rig_from_target[frame].translation, atol=1e-9)
    assert np.linalg.eigvalsh(result.frame_covariance).min() > 0


@pytest.mark.slow
def test_cameras_of_one_clock_and_boards_at_rest_claim_no_offset(tmp_path: Path) -> None:
    together = noisy(seen_freely(HandMotion(2), (0.0, 0.0), runs=6), NOISE_PX, 1)
    write_corners(tmp_path / "corners.csv", together)
    table = read_rig_corners(tmp_path / "corners.csv")
    assert table.times_s is not None and together.times_s is not None
    assert np.array_equal(np.sort(table.times_s), np.sort(together.times_s))
    alone = calibrate_rig(table, SETUPS)
    assert not told(alone) and alone.members[1].time_offset_s is None
    asked = calibrate_rig(table, SETUPS, time_offsets=True).members[1]
    assert asked.time_offset_s is not None and asked.time_offset_sigma_s is not None
    assert abs(asked.time_offset_s) < 4 * asked.time_offset_sigma_s
    rested = calibrate_rig(noisy(seen_freely(Resting(2), (0.0, OFFSET_S), runs=6), NOISE_PX, 3), SETUPS, time_offsets=True)
    assert rested.members[1].time_offset_s is None and not told(rested)
    assert any("the board moves too little" in note for note in rested.notes)


@pytest.mark.full
def test_a_camera_out_of_runs_is_named_and_the_others_are_compared() -> None:
    """The first camera of the table sees the board in single instants alone."""
    models = (PINHOLE, PINHOLE, FISHEYE_220)
    beside = Pose.exp(torch.tensor([0.02, -0.1, 0.0, -0.15, 0.0, 0.02], dtype=torch.float64))
    poses = Pose.stack([beside, CAM_FROM_RIG[0], CAM_FROM_RIG[1]])
    seen = noisy(seen_freely(HandMotion(2), (0.0, 0.0, OFFSET_S), runs=10, models=models, cam_from_rig=poses), NOISE_PX, 1)
    assert seen.cameras is not None and seen.frames is not None and seen.times_s is not None
    numbers = [divmod(int(frame), 60) for frame in seen.frames]
    kept = [k == 0 if run >= 5 else name != "cam0" for name, (run, k) in zip(seen.cameras, numbers, strict=True)]
    views = np.flatnonzero(kept)
    corners = replace(
        views_of(seen, views, np.isin(seen.view, views)),
        cameras=tuple(seen.cameras[v] for v in views),
        frames=tuple(seen.frames[v] for v in views),
        times_s=seen.times_s[views],
    )
    setups = {f"cam{c}": CameraSetup(model.image_size, model.NAME) for c, model in enumerate(models)}
    result = calibrate_rig(corners, setups)
    assert [member.name for member in result.members] == ["cam1", "cam2"] and list(result.left_out_alone) == ["cam0"]
    assert "in 0 of its frames that are in runs of consecutive ones" in result.left_out["cam0"]
    second = result.members[1]
    assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
    assert abs(second.time_offset_s - OFFSET_S) < 4 * second.time_offset_sigma_s < 2e-4
    assert pose_error(result) < 28


@pytest.mark.parametrize("offset_s", [0.05, pytest.param(-0.05, marks=pytest.mark.full)])
@pytest.mark.slow
def test_offsets_beyond_a_frame_are_found_and_keep_the_views(offset_s: float) -> None:
    """One and a half gaps between frames: no two frames of one name agree on where the cameras stand."""
    corners = noisy(seen_freely(HandMotion(2), (0.0, offset_s), runs=8), NOISE_PX, 1)
    result = calibrate_rig(corners, SETUPS)
    second = result.members[1]
    assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
    assert abs(second.time_offset_s - offset_s) < 4 * second.time_offset_sigma_s < 1e-3
    assert pose_error(result) < 28
    assert sum(view.used for view in result.views) > 0.9 * len(result.views)
    assert not result.against_alone.notes


@pytest.mark.slow
def test_the_search_begins_within_a_step_of_the_offset() -> None:
    offsets_s = {"cam0": 0.0, "cam1": 0.041, "cam2": -0.027}
    models = (*MODELS, FISHEYE_220)
    poses = Pose.stack([*CAM_FROM_RIG, Pose.exp(torch.tensor([0.02, -0.1, 0.0, -0.15, 0.0, 0.02], dtype=torch.float64))])
    table = seen_freely(HandMotion(3), tuple(offsets_s.values()), runs=8, models=models, cam_from_rig=poses)
    setups = {name: CameraSetup(model.image_size, model.NAME) for name, model in zip(offsets_s, models, strict=True)}
    views, limits = RigViews.of(noisy(table, NOISE_PX, 1), tuple(offsets_s), "fixed"), CalibrationThresholds()
    alone = {
        c: alone_camera(*views.of_camera(c)[:2], setup, "cauchy", limits, callback=None)
        for c, setup in enumerate(setups.values())
    }
    posed, numbers = posed_views(ViewNumberings(views, numberings_of(views), frozenset()), alone)
    search = ClockSearch.of(views, posed, numbers, limits)
    assert search is not None
    found_s = search.clocks_s((0, 1, 2))
    assert found_s is not None
    step_s = search.runs.gap_s / STEPS_OF_GAP
    assert np.abs(found_s.numpy() - list(offsets_s.values())).max() < 1.5 * step_s
    # Seen from another camera first, and of cameras that were not compared.
    from_second_s = search.clocks_s((1, 2))
    assert from_second_s is not None and torch.allclose(from_second_s, found_s[1:] - found_s[1])
    assert search.clocks_s((0, 3)) is None


@pytest.mark.slow
def test_a_rig_that_most_views_contradict_is_not_said_to_be_known() -> None:
    """Frames of the second camera are named wrongly in most runs, and nothing tells when they were taken."""
    corners = noisy(seen_freely(HandMotion(2), (0.0, 0.0), runs=12), NOISE_PX, 1)
    assert corners.cameras is not None and corners.frames is not None
    frames = list(corners.frames)
    own = [v for v, name in enumerate(corners.cameras) if name == "cam1" and int(frames[v]) >= 240]
    for v, frame in zip(own, [frames[v] for v in own[7:] + own[:7]], strict=True):
        frames[v] = frame
    result = calibrate_rig(replace(corners, frames=tuple(frames), times_s=None), SETUPS)
    against = result.against_alone
    assert against.unknown and against.rejected > 0.6 * against.fitted
    assert against.notes[0].startswith(f"{against.rejected} of {against.fitted} views that fit their camera alone do not tie it")
    assert against.notes[0] in result.notes


@pytest.mark.full
def test_parameters_that_a_camera_alone_contradicts_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes: list[RigOutcome] = []
    monkeypatch.setattr(calibrate, "rig_result", lambda outcome: outcomes.append(outcome) or rig_result(outcome))
    result = calibrate_rig(noisy(seen_freely(HandMotion(2), (0.0, 0.0), runs=6), NOISE_PX, 1), SETUPS)
    assert not result.against_alone.sigmas
    (outcome,) = outcomes
    state, covariance = outcome.solution.state, torch.as_tensor(result.members[0].covariance)
    along = covariance[:, 0] / covariance[0, 0].sqrt()
    for times, named in ((1.0, False), (15.0, True)):
        models = (state.models[0].with_parameters(state.models[0].parameters + times * along), state.models[1])
        moved = replace(outcome, solution=replace(outcome.solution, state=replace(state, models=models)))
        found = against_alone(moved, torch.as_tensor(result.covariance))
        assert list(found.sigmas) == (["cam0"] if named else [])
        assert any("Camera cam0: its parameters in the rig differ by" in note for note in found.notes) == named


@pytest.mark.parametrize("coarse_s", [1.0, 1000.0])
def test_frames_of_one_time_are_in_no_run(coarse_s: float) -> None:
    """Times that are unknown, or coarser than frames are apart, ended in a traceback."""
    corners = seen_freely(HandMotion(3), (0.0, OFFSET_S), runs=4)
    assert corners.times_s is not None
    for times_s, gap_s in ((corners.times_s, 1 / 30), (np.floor(corners.times_s / coarse_s) * coarse_s, None)):
        views = RigViews.of(replace(corners, times_s=times_s), ("cam0", "cam1"), "fixed")
        every = np.ones(len(views.camera), dtype=bool)
        runs = find_runs(views, (0, 1), every, np.zeros(3), CalibrationThresholds().clocks)
        assert (runs is None) == (gap_s is None)
        assert runs is None or runs.gap_s == pytest.approx(gap_s)
    assert usual_gap_s(views) == (2.0 if coarse_s == 1.0 else 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.0, 1e9])
def test_times_that_tell_nothing_are_answered_with_what_they_say(unit: float) -> None:
    """All of one time, or in nanoseconds."""
    corners = noisy(seen_freely(HandMotion(3), (0.0, OFFSET_S), runs=3), NOISE_PX, 1)
    assert corners.times_s is not None
    given = replace(corners, times_s=unit * corners.times_s)
    result = calibrate_rig(given, SETUPS, time_offsets=True)
    assert len(result.members) == 2 and result.members[1].time_offset_s is None
    said = "come 0 s after" if unit == 0 else "come 3.3e+07 s after"
    assert any(said in note and "give times in seconds" in note for note in result.notes)


def test_what_has_no_times_is_refused() -> None:
    corners = replace(seen_freely(HandMotion(2), (0.0, 0.0), runs=2), times_s=None)
    with pytest.raises(InputError, match="`time_offsets` compares cameras by when their frames were taken, found no times"):
        ol.calibrate_rig(corners, {f"cam{c}": model.image_size for c, model in enumerate(MODELS)}, time_offsets=True)


@pytest.mark.full
def test_offsets_and_poses_are_at_the_bound() -> None:
    """Over motions and noise: the board's motion is none of the model's polynomials."""
    errors, poses = [], []
    for seed in range(40):
        corners = noisy(seen_freely(HandMotion(seed), (0.0, OFFSET_S)), NOISE_PX, seed)
        result = calibrate_rig(corners, SETUPS)
        second = result.members[1]
        assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
        errors.append((second.time_offset_s - OFFSET_S) / second.time_offset_sigma_s)
        poses.append(pose_error(result))
    assert abs(np.mean(errors)) < 3 / np.sqrt(40) and 0.68 < np.std(errors) < 1.34 and np.abs(errors).max() < 4
    # Errors over the bound: the mean of chi-squares of six is 6 within 3 * sqrt(12 / 40).
    assert np.sqrt(np.mean(poses) / 6) < 1.1


LENSES = (
    OpenCVFisheye([150.0, 150.0, 239.5, 179.5, 0.02, -0.004, 0.0, 0.0], (480, 360)),
    OpenCVFisheye([155.0, 155.0, 238.0, 181.0, 0.01, -0.002, 0.0, 0.0], (480, 360)),
)


@dataclass(frozen=True)
class SeenMotion:
    """A board in hand as one camera sees it; never at rest."""

    motion: HandMotion
    cam_from_rig: Pose
    duration_s: float

    def at(self, time_s: float) -> Pose:
        return self.cam_from_rig @ self.motion.at(np.array([time_s]))[0]

    def rests(self, begin_s: float, end_s: float) -> bool:
        return False


@pytest.mark.full
@pytest.mark.parametrize("later_s", [0.0137, 1.5137])
def test_videos_of_free_running_cameras_give_their_offset(later_s: float, tmp_path: Path) -> None:
    """Rendered; one began later by a part of a frame, or by 45 frames and that."""
    board = pattern("checkerboard:9x6:50mm")
    beside = Pose(rotation_from_vector(torch.tensor([0.01, -0.15, 0.02])).double(), torch.tensor([-0.1, 0.003, 0.01]).double())
    motion = HandMotion(3, highest_hz=1.2)
    for name, lens, pose, start_s in zip(("left", "right"), LENSES, (Pose.identity(), beside), (0.0, later_s), strict=True):
        write_video(tmp_path / f"{name}.avi", board, lens, SeenMotion(motion, pose, 9.0), frames_per_s=30.0, start_s=start_s)
    chosen = ol.frames(tmp_path, board.specification)
    chosen.save(tmp_path / "frames")
    result = ol.calibrate_rig(ol.detect_rig(tmp_path / "frames", board.specification), model="opencv-fisheye")
    second = result.fit.members[1]
    assert second.time_offset_s is not None and second.time_offset_sigma_s is not None
    # What left sees at t, right, which began later, sees at t - later_s of its own clock.
    assert abs(second.time_offset_s + later_s) < 4 * second.time_offset_sigma_s < 1e-4
    off = (second.cam_from_rig @ beside.inverse()).log().numpy()
    assert off @ np.linalg.solve(second.pose_covariance, off) < 28
    assert any("began" in note for note in chosen.notes) == (later_s > 1)
