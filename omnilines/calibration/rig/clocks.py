"""Cameras whose clocks differ: the offset of each is estimated from the board's motion, together with all else of the rig.

Of the views that are in runs of consecutive frames (`runs.py`), through which the board is followed (`path.py`). Where the board
stands still in all of them, its corners say nothing of the clocks.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.stats import chi2
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.rig.fewer import state_of, without_members
from omnilines.calibration.rig.followed import followed_fit
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.runs import Runs, find_runs, usual_gap_s
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.least_squares import Outcome, solve

ITERATIONS = 30
DRAWS = 4
"""Of the motion of boards at rest: of many frames each tells nearly the same."""


def with_clocks(outcome: RigOutcome, start: RigState, seen: SeenAlone, *, asked: bool) -> RigOutcome:
    """The outcome with an offset of each camera's clock, where that is asked for, or where cameras contradict each other and
    their clocks do by more than chance; else as it is, with a note where clocks were compared. `start` has the models of the
    cameras alone, and where they stand with the clocks that it has."""
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
    told = fewer if found is None else _compared(fewer, found, state_of(start, left), seen, asked=asked)
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
        f"{limits.longest_gap_s:g} s apart, were expected, found none: by their times frames come "
        f"{rounded(usual_gap_s(outcome.data.views))} s after one another in the median; give times in seconds, videos of a "
        "higher frame rate, or with the board in view longer."
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
