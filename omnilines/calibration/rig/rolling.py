"""Rolling shutters: rows of an image that are exposed one after the other are recognised, and their line delay is estimated.

Of frames that follow one another closely the board's motion is known (`path.py`), and with it where each row would see a corner
if it were read later. A line delay d moves the corners by d y times their speed, y rows beyond the middle. At d = 0 the first
step of Newton's method, with all else free, over its standard deviation is the score test (C. R. Rao 1948). Its variance is that
of the noise, or what runs contradict each other by (`by_frames.py`) where that is more: a lens that does not fit, or a board that
bends, moves corners too, but not in every run as the board moves.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.stats import chi2

from camera_models import GeometryError, InputError
from omnilines.calibration.intervals import stated_variance_px2
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.rig.by_frames import spread_of_runs
from omnilines.calibration.rig.clocks import moving_share
from omnilines.calibration.rig.followed import Followed, followed_fit
from omnilines.calibration.rig.joint import Readout, RigData, least_squares_rig
from omnilines.calibration.rig.near import CornerNoise
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.runs import Runs, find_runs
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import ClockThresholds
from omnilines.least_squares import Outcome, solve
from omnilines.records import Corners

ROWS, COLUMNS = 1, 0
"""Axes of the image along which it may be read."""


def with_line_delays(outcome: RigOutcome, start: RigState, seen: SeenAlone, *, asked: bool) -> RigOutcome:
    """The outcome with the line delay of each camera estimated, where that is `asked`; else as it is, and where rolling shutters
    are recognised beyond chance it says so. `start` has the models of the cameras alone.

    Raises InputError where it is asked and frames do not follow one another closely enough.
    """
    runs = _runs(outcome, seen)
    if runs is None:
        if asked:
            raise InputError(not_closely(outcome.thresholds.clocks))
        return outcome
    plain = followed_fit(replace(outcome.data, runs=runs), outcome, start, seen)
    if plain is None or plain.solution.outcome is Outcome.DEGENERATE:
        if asked:
            raise GeometryError(STANDS_STILL)
        return outcome
    readout, told = _recognised(plain, outcome)
    readout = replace(readout, free=np.ones_like(told) if asked else told)
    while readout.free.any():
        found = followed_fit(replace(outcome.data, runs=runs, readout=readout), outcome, start, seen)
        if found is None or found.solution.outcome is Outcome.DEGENERATE:
            if asked:
                raise GeometryError(STANDS_STILL)
            return outcome
        rolled = _reweighed(found, outcome).outcome(outcome, seen)
        least = outcome.thresholds.clocks.least_moving_share
        share = moving_share(rolled)
        rolled = replace(rolled, moving_share=share.clamp_min(least))
        still = readout.free.copy()
        still[readout.free] = (share[: int(readout.free.sum())] < least).numpy()
        if not still.any():
            return _said(rolled if asked else outcome, rolled, readout, modelled=asked)
        names = ", ".join(_name(outcome, k) for k in np.flatnonzero(still).tolist())
        outcome = replace(outcome, line_notes=(*outcome.line_notes, _untold(names))) if asked else outcome
        readout = replace(readout, free=readout.free & ~still)
    return outcome


def _reweighed(found: Followed, outcome: RigOutcome) -> Followed:
    """The same with the noise of each member's corners as it is once they are seen when they were: alone, with all rows of one
    instant, cameras do not fit as well."""
    data, fit, noise = found.data, found.fit, outcome.thresholds.noise
    corners, points = data.views.corners, fit.points.chosen(fit.kept)
    squares = found.solution.state.residual_px(points).mul(points.weight[:, None]).square().sum(-1)
    camera = points.camera[points.view]
    freedom = replace(outcome, data=data, fit=fit, solution=found.solution).freedom
    seen = []
    for k, (c, before) in enumerate(zip(data.cameras, data.noise, strict=True)):
        own = camera == k
        stated_px2 = stated_variance_px2(corners, data.views.camera[corners.view] == c, noise.corner_floor_px)
        share = freedom * float(own.to(torch.float64).mean())
        squares_px2 = before.sigma_px**2 * float(squares[own].sum())
        seen.append(CornerNoise.of(squares_px2, max(1, round(share)), stated_px2, noise.significance))
    weighed = replace(data, noise=tuple(seen))
    points, views, rows = weighed.points(fit.views)
    begun = replace(fit, points=points, problem=weighed.problem(points), views=views, rows=rows)
    weighed, fit, solution, notes = least_squares_rig(weighed, begun, "cauchy" if outcome.rejects else "none")
    return replace(found, data=weighed, fit=fit, solution=solution, notes=found.notes + notes)


def follow_closely(corners: Corners, limits: ClockThresholds) -> bool:
    """Whether a camera's frames follow one another closely enough to tell how it reads its rows."""
    if corners.times_s is None or corners.cameras is None:
        return False
    views = RigViews.of(corners, corners.cameras[:1], "fixed")
    every = np.ones(len(views.camera), dtype=bool)
    return find_runs(views, (0,), every, corners.board_m.mean(0), _close(limits)) is not None


STANDS_STILL = (
    "Runs of frames that tell how the board moves were expected for `rolling_shutter`, found that they leave it open; show more "
    "of the board in consecutive frames."
)


def _runs(outcome: RigOutcome, seen: SeenAlone) -> Runs | None:
    """In which the board is followed closely enough, with the clocks that are free already."""
    data = outcome.data
    posed = np.isin(np.arange(len(data.views.camera)), [*seen.cam_from_board])
    middle_m = np.unique(data.board_m, axis=0).mean(0)
    runs = find_runs(data.views, data.cameras, posed, middle_m, _close(outcome.thresholds.clocks))
    if runs is None:
        return None
    return replace(runs, free=np.zeros_like(runs.free) if data.runs is None else data.runs.free)


def _close(limits: ClockThresholds) -> ClockThresholds:
    return limits._replace(longest_gap_s=min(limits.longest_gap_s, limits.longest_gap_of_rows_s))


def not_closely(limits: ClockThresholds) -> str:
    """What is said where frames do not follow one another closely enough."""
    return (
        f"`rolling_shutter` follows the board through {limits.frames_of_run} consecutive frames in which it is seen, at most "
        f"{limits.longest_gap_of_rows_s:g} s apart; found none: give a video of a higher frame rate, or with the board in view "
        "longer."
    )


def _untold(names: str) -> str:
    return f"Camera {names}: the board moves too little in its runs of frames to tell a line delay."


def _name(outcome: RigOutcome, member: int) -> str:
    return outcome.data.views.cameras[outcome.data.cameras[member]]


def _readout(outcome: RigOutcome, axis: Int[np.ndarray, " m"], start_s: Float[np.ndarray, " m"]) -> Readout:
    sizes = np.array([model.image_size for model in outcome.solution.state.models])
    middle_px = 0.5 * (sizes[np.arange(len(axis)), axis] - 1)
    return Readout(axis, middle_px, start_s, np.ones(len(axis), dtype=bool))


def _recognised(plain: Followed, outcome: RigOutcome) -> tuple[Readout, np.ndarray]:
    """The axis along which each member is read and its line delay by one step from 0; and which of these are beyond chance."""
    members = len(plain.data.cameras)
    steps = {axis: _one_step(plain, outcome, np.full(members, axis)) for axis in (ROWS, COLUMNS)}
    size = {axis: np.abs(delay_s) / sigma_s for axis, (delay_s, sigma_s) in steps.items()}
    beyond = float(chi2.isf(outcome.thresholds.clocks.significance_of_rows / (2 * members), 1)) ** 0.5
    told = np.maximum(size[ROWS], size[COLUMNS]) > beyond
    axis = np.where(told & (size[COLUMNS] > size[ROWS]), COLUMNS, ROWS)
    start_s = np.where(axis == ROWS, steps[ROWS][0], steps[COLUMNS][0])
    return _readout(outcome, axis, np.where(told, start_s, 0.0)), told


def _one_step(
    plain: Followed, outcome: RigOutcome, axis: Int[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The line delays by one step from 0 with all else free, and their standard deviations."""
    none_s = np.zeros(len(axis))
    data: RigData = replace(plain.data, readout=_readout(outcome, axis, none_s))
    points = data.points(plain.fit.views)[0].chosen(plain.fit.kept)
    problem, state = data.problem(points), plain.solution.state
    moved = solve(problem, state, max_iterations=1, damping=1e-8)
    at = solve(problem, state, max_iterations=0)
    rows = slice(-data.ticking, -data.ticking + len(axis) or None)
    variance = at.kept_covariance().diagonal()[rows] * replace(outcome, fit=plain.fit, solution=plain.solution).factor.value
    spread = spread_of_runs(data, points, state)
    if spread is not None:
        variance = variance.maximum(spread[rows])
    assert moved.state.path is not None
    return moved.state.path.line_delay_s.numpy(), variance.sqrt().numpy()


def _said(outcome: RigOutcome, rolled: RigOutcome, readout: Readout, *, modelled: bool) -> RigOutcome:
    """The outcome with the line delays that the fit `rolled` holds."""
    path, ticking = rolled.solution.state.path, rolled.data.ticking
    assert path is not None
    variance = rolled.kept_covariance.diagonal()
    if rolled.frame_spread is not None:
        variance = variance + rolled.frame_spread.diagonal()
    members = np.flatnonzero(readout.free).tolist()
    first = len(variance) - ticking
    delays = tuple(
        LineDelay(
            _name(outcome, k),
            bool(readout.axis[k] == COLUMNS),
            float(path.line_delay_s[k]),
            float(variance[first + place].sqrt()),
            modelled,
        )
        for place, k in enumerate(members)
    )
    return replace(outcome, line_delays=delays)
