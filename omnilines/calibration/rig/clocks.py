"""Cameras whose clocks differ: the offset of each is estimated from the board's motion, together with all else of the rig.

Of the views that are in runs of consecutive frames (`runs.py`), through which the board is followed (`path.py`). Where the board
stands still in all of them, its corners say nothing of the clocks.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.rig.fewer import without_members
from omnilines.calibration.rig.joint import RigData, RigFit, least_squares_rig, robust_rig_fit
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.path import Path, followed
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.runs import Runs, find_runs
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.least_squares import Outcome, Solution, solve

NOT_FOLLOWED = "it is not in a run of consecutive frames in which the board is seen, by which its motion is followed"
MISFIT = "more than half of its corners are not where the board's motion takes them (wrong frame, detection or numbering)"
ITERATIONS = 30
DRAWS = 4
"""Of the motion of boards at rest: of many frames each tells nearly the same."""
LEAST_SHARE = 0.5
"""Of the corners of a view that fit, for it to stay."""


@dataclass(frozen=True, eq=False)
class Followed:
    """A rig whose board is followed through runs."""

    data: RigData
    fit: RigFit
    solution: Solution[RigState]
    notes: tuple[str, ...]
    lost: tuple[int, ...]
    """Views that do not fit."""

    def outcome(self, before: RigOutcome, seen: SeenAlone) -> RigOutcome:
        """The outcome `before` with this in its place."""
        out = np.setdiff1d(np.fromiter(seen.cam_from_board, dtype=int), self.fit.views).tolist()
        lost = dict.fromkeys(out, NOT_FOLLOWED) | dict.fromkeys(self.lost, MISFIT)
        return replace(before, data=self.data, fit=self.fit, solution=self.solution, notes=self.notes, reasons=lost)


def with_clocks(outcome: RigOutcome, start: RigState, seen: SeenAlone, *, asked: bool) -> RigOutcome:
    """The outcome with an offset of each camera's clock, where that is asked for, or where cameras contradict each other and
    their clocks do by more than chance; else as it is, with a note where clocks were compared. `start` has the models of the
    cameras alone."""
    if len(outcome.data.cameras) < 2 or not (asked or outcome.worse or outcome.reasons):
        return outcome
    data, limits = outcome.data, outcome.thresholds.clocks
    posed = np.isin(np.arange(len(data.views.camera)), [*seen.cam_from_board])
    runs = find_runs(data.views, data.cameras, posed, np.unique(data.board_m, axis=0).mean(0), limits)
    if runs is None:
        return _said(outcome, _no_runs(outcome)) if asked else outcome
    apart = _out_of_runs(outcome, runs, posed)
    if not apart:
        return _compared(outcome, runs, start, seen, asked=asked)
    left = [k for k in range(len(data.cameras)) if k not in apart]
    why = [OUT_OF_RUNS.format(count) for count in apart.values()]
    named = tuple(f"Camera {_name(outcome, k)}: {reason}." for k, reason in zip(apart, why, strict=True))
    if len(left) < 2:
        return replace(outcome, clock_notes=(*outcome.clock_notes, *named))
    fewer = without_members(outcome, apart)
    found = find_runs(fewer.data.views, fewer.data.cameras, posed, runs.middle_m, limits)
    models = replace(start, models=tuple(start.models[k] for k in left))
    told = fewer if found is None else _compared(fewer, found, models, seen, asked=asked)
    if told.data.runs is None:
        return replace(outcome, clock_notes=(*told.clock_notes, *named))
    failures = {data.cameras[k]: reason for k, reason in zip(apart, why, strict=True)}
    return replace(told, failures={**outcome.failures, **failures})


OUT_OF_RUNS = (
    "the board is seen in {} of its frames that are in runs of consecutive ones, which do not tell its clock, nor where it "
    "stands beside cameras whose clocks differ; show it the board while the others see it move"
)


def _out_of_runs(outcome: RigOutcome, runs: Runs, posed: Bool[np.ndarray, " a"]) -> dict[int, int]:
    """Members that are hardly in a run, with the number of their views that are."""
    members = outcome.data.cameras
    counts = [int((posed & (runs.run >= 0) & (runs.views.camera == c)).sum()) for c in members]
    return {k: count for k, count in enumerate(counts) if count < outcome.thresholds.views.least_views}


def _compared(outcome: RigOutcome, runs: Runs, start: RigState, seen: SeenAlone, *, asked: bool) -> RigOutcome:
    """The outcome with the offsets that the runs tell; `with_clocks` of members that all are in runs."""
    data, limits = outcome.data, outcome.thresholds.clocks
    while True:
        found = followed_fit(replace(data, runs=runs), outcome, start, seen)
        if found is None or found.solution.outcome is Outcome.DEGENERATE:
            return _said(outcome, STANDS_STILL)
        timed = replace(found.outcome(outcome, seen), clock_notes=())
        share = moving_share(timed)
        timed = replace(timed, moving_share=share.clamp_min(limits.least_moving_share))
        sigma_s, moving = timed.offset_sigma_s, runs.free.copy()
        moving[runs.free] = (share > limits.least_moving_share).numpy()
        open_ = runs.free & ~(moving & (sigma_s < 0.5 * runs.gap_s))
        if not open_.any():
            break
        outcome = _said(outcome, "; ".join(_untold(outcome, k) for k in _numbers(open_)))
        runs = replace(runs, free=runs.free & ~open_)
        if not runs.free.any():
            return outcome
    assert found.solution.state.path is not None
    offset_s = found.solution.state.path.offset_s.numpy()
    off = np.abs(offset_s - runs.beside_s)[runs.free] / sigma_s[runs.free]
    beyond = float(chi2.isf(outcome.thresholds.noise.significance, 1)) ** 0.5
    if not asked and not (off > beyond).any():
        agreed = "; ".join(
            f"{_name(outcome, k)} by {_ms(offset_s[k] - runs.beside_s[k], sigma_s[k])}" for k in _numbers(runs.free)
        )
        return _said(outcome, f"Frames of one name are of the same instant, as far as the board's motion tells: {agreed}.")
    return replace(timed, clock_notes=outcome.clock_notes, clock_rms_px=_with_and_without(timed, runs))


STANDS_STILL = (
    "The runs of consecutive frames do not tell whether the cameras' clocks differ: the board hardly moves in them, or some "
    "camera hardly sees it there."
)


def _said(outcome: RigOutcome, note: str) -> RigOutcome:
    return replace(outcome, clock_notes=(*outcome.clock_notes, note))


def _no_runs(outcome: RigOutcome) -> str:
    limits = outcome.thresholds.clocks
    return (
        f"No time offset is told: runs of {limits.frames_of_run} consecutive frames in which the board is seen, at most "
        f"{limits.longest_gap_s:g} s apart, were expected, found none; give videos of a higher frame rate, or with the board in "
        "view longer."
    )


def _numbers(chosen: Bool[np.ndarray, " m"]) -> list[int]:
    return [int(k) for k in np.flatnonzero(chosen)]


def _name(outcome: RigOutcome, member: int) -> str:
    return outcome.data.views.cameras[outcome.data.cameras[member]]


def _untold(outcome: RigOutcome, member: int) -> str:
    return f"Camera {_name(outcome, member)}: the board moves too little in its runs of frames to tell an offset of its clock."


def _ms(value_s: float, sigma_s: float) -> str:
    """Milliseconds with two digits of the standard deviation."""
    digits = max(0, 1 - math.floor(math.log10(max(1e3 * sigma_s, 1e-9))))
    return f"{1e3 * value_s:.{digits}f} ± {1e3 * sigma_s:.{digits}f} ms"


def offsets_note(outcome: RigOutcome) -> str | None:
    """By how much the clocks of a rig differ and what that explains, one sentence or three; None where they were not
    estimated."""
    runs, path = outcome.data.runs, outcome.solution.state.path
    if runs is None or path is None or not runs.free.any():
        return None
    first, sigma_s = _name(outcome, 0), outcome.offset_sigma_s
    clocks = ", ".join(f"{_name(outcome, k)} by {_ms(float(path.offset_s[k]), sigma_s[k])}" for k in _numbers(runs.free))
    before_px, after_px = outcome.clock_rms_px
    return (
        f"The cameras' clocks differ: ahead of {first} is {clocks} (one standard deviation; what {first} sees at t, a camera "
        f"ahead by d sees at t + d). The board's motion in {runs.count} runs of {runs.degree + 1} frames tells that. With it the "
        f"cameras fit to {after_px:.3g} px per point, without it to {before_px:.3g}."
    )


def _with_and_without(timed: RigOutcome, runs: Runs) -> tuple[float, float]:
    """RMS per point of the same corners with the clocks as frames are put together, and as estimated."""
    points, state = timed.fit.points.chosen(timed.fit.kept), timed.solution.state
    assert points.times is not None and state.path is not None
    held = replace(points, times=replace(points.times, free=torch.zeros_like(points.times.free)))
    begin = replace(state, path=replace(state.path, offset_s=torch.as_tensor(runs.beside_s)))
    without = solve(timed.data.problem(held), begin, max_iterations=ITERATIONS, damping=1e-8).state
    before, after = (float(own.residual_px(points).square().sum(-1).mean().sqrt()) for own in (without, state))
    return before, after


def moving_share(timed: RigOutcome) -> Float[Tensor, " k"]:
    """`RigOutcome.moving_share`, from how well the clocks would seem to be known of a board at rest whose motion in each run is
    drawn from what its noise makes of it."""
    points, state = timed.fit.points.chosen(timed.fit.kept), timed.solution.state
    assert state.path is not None and timed.data.runs is not None
    clocks = timed.data.ticking
    problem, generator = timed.data.problem(points), torch.Generator().manual_seed(0)
    covariance = timed.solution.eliminated_covariance()[:, 6:, 6:] * timed.factor.value
    used = torch.unique(points.frame[points.view])
    factor = torch.linalg.cholesky(0.5 * (covariance[used] + covariance[used].mT))
    resting = torch.zeros(clocks, dtype=torch.float64)
    for _ in range(DRAWS):
        rates = torch.zeros_like(state.path.rates)
        noise = torch.randn(len(used), factor.shape[-1], 1, generator=generator, dtype=torch.float64)
        rates[used] = (factor @ noise).reshape(len(used), *rates.shape[1:])
        still = solve(problem, replace(state, path=replace(state.path, rates=rates)), max_iterations=0)
        resting += 1 / still.kept_covariance().diagonal()[-clocks:] / DRAWS
    return 1 - resting * timed.solution.kept_covariance().diagonal()[-clocks:]


def followed_fit(data: RigData, outcome: RigOutcome, start: RigState, seen: SeenAlone) -> Followed | None:
    """The rig of the views in runs; None where too few are left."""
    lost: tuple[int, ...] = ()
    while True:
        chosen = _chosen(data, outcome, seen, lost)
        if not len(chosen):
            return None
        state = _begun(data, outcome, start, seen, chosen)
        loss = "cauchy" if outcome.rejects else "none"
        fit = robust_rig_fit(data, chosen, state, loss, outcome.thresholds)
        more = fit.views[(fit.share_kept < LEAST_SHARE).numpy()].tolist() if outcome.rejects else []
        if more:
            lost += tuple(more)
            continue
        data, fit, solution, notes = least_squares_rig(data, fit, loss)
        return Followed(data, fit, solution, notes, lost)


def _chosen(data: RigData, outcome: RigOutcome, seen: SeenAlone, lost: tuple[int, ...]) -> Int[np.ndarray, " v"]:
    """Views of the runs of which enough instants are seen to follow the board."""
    views, runs = data.views, data.runs
    assert runs is not None
    number = np.arange(len(views.camera))
    usable = (runs.run >= 0) & ~np.isin(number, lost)
    posed = usable & np.isin(number, [*seen.cam_from_board])
    seen_at = np.unique(np.stack([runs.run[posed], views.frame[posed]]), axis=1)
    enough = np.bincount(seen_at[0], minlength=runs.count) > runs.degree
    return number[usable & (posed | np.isin(number, outcome.fit.views)) & enough[runs.run]]


def _begun(data: RigData, outcome: RigOutcome, start: RigState, seen: SeenAlone, chosen: Int[np.ndarray, " v"]) -> RigState:
    """The rig with the cameras' own models, its board followed through where each camera alone sees it."""
    runs, state = data.runs, outcome.fit.state
    assert runs is not None
    posed = np.array([v for v in chosen if v in seen.cam_from_board])
    member = torch.tensor([data.cameras.index(int(c)) for c in data.views.camera[posed]])
    board = torch.tensor([data.boards.index(int(b)) for b in data.views.part[posed]])
    poses = Pose.stack([seen.cam_from_board[int(v)] for v in posed])
    target = state.cam_from_rig[member].inverse() @ poses @ state.target_from_board[board].inverse()
    times, run, known = runs.times(posed, None), torch.as_tensor(runs.run[posed]), outcome.solution.state.path
    offset_s = torch.as_tensor(runs.beside_s) if known is None else known.offset_s
    delay_s = torch.zeros_like(offset_s) if data.readout is None else torch.as_tensor(data.readout.start_s)
    clocks = Path(torch.zeros(runs.count, runs.degree, 6, dtype=torch.float64), offset_s, delay_s)
    base, rates = followed(target, run, times.tau(clocks, member), runs.count, runs.degree, times.middle_m)
    return replace(state, models=start.models, rig_from_target=base, path=replace(clocks, rates=rates))
