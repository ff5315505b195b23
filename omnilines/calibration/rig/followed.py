"""The fit of a rig whose board is followed through runs of frames: from where it begins, and which views fit it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.rig.joint import RigData, RigFit, least_squares_rig, robust_rig_fit
from omnilines.calibration.rig.near import Scales
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.path import Path, followed
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.seen_alone import SeenAlone
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.least_squares import Solution

NOT_FOLLOWED = "it is not in a run of consecutive frames in which the board is seen, by which its motion is followed"
MISFIT = "more than half of its corners are not where the board's motion takes them (wrong frame, detection or numbering)"
LEAST_SHARE = 0.5
"""Of the corners of a view that fit, for it to stay."""


@dataclass(frozen=True, eq=False)
class Followed:
    """A rig whose board is followed through runs."""

    data: RigData
    fit: RigFit
    solution: Solution[RigState]
    notes: tuple[str, ...]

    def outcome(self, before: RigOutcome, seen: SeenAlone) -> RigOutcome:
        """The outcome `before` with this in its place."""
        posed = np.concatenate([before.alone[c].views for c in self.data.cameras])
        out = np.setdiff1d(posed, self.fit.views)
        lost = np.isin(out, _followable(self.data, seen, posed))
        reasons = {int(v): MISFIT if one else NOT_FOLLOWED for v, one in zip(out, lost, strict=True)}
        return replace(before, data=self.data, fit=self.fit, solution=self.solution, notes=self.notes, reasons=reasons)


def followed_fit(data: RigData, outcome: RigOutcome, start: RigState, seen: SeenAlone) -> Followed | None:
    """The rig of the views in runs; None where too few are left.

    It begins where the outcome is, with its clocks. Where that has none, it begins there with those by which frames are put
    together, and at `start` with the clocks that this has; the more likely fit is taken.
    """
    assert data.runs is not None
    chosen = _followable(data, seen, np.union1d(np.fromiter(seen.cam_from_board, dtype=int), outcome.fit.views))
    if not len(chosen):
        return None
    rigs = [outcome.fit.state]
    if outcome.fit.state.path is None and start.path is not None:
        rigs.append(start)
    states = [_begun(data, rig, start, seen, chosen) for rig in rigs]
    loss = "cauchy" if outcome.rejects else "none"
    fits = [robust_rig_fit(data, chosen, state, loss, outcome.thresholds) for state in states]
    fit = min(fits, key=lambda one: _unlikelihood(one.problem.linearise(one.state).residual))
    fitting = _of_fitting_views(data, seen, fit, outcome.thresholds) if outcome.rejects else fit
    return None if fitting is None else Followed(*least_squares_rig(data, fitting, loss))


def _of_fitting_views(data: RigData, seen: SeenAlone, fit: RigFit, thresholds: CalibrationThresholds) -> RigFit | None:
    """The robust fit of the views of the runs that it predicts, until these are the ones that it is of; None where too few are.

    What is near is told by the views that are chosen at first, whichever stay: were it told by those that stay, less and less
    would be near where shutters jitter. A view that was lost comes back where the fit of the others predicts it; after the
    second time it stays out.
    """
    runs, limits = data.runs, thresholds.robust
    assert runs is not None
    points, every, rows = data.points(np.flatnonzero((runs.run >= 0) & np.isin(data.views.part, data.boards)))
    of_scale = torch.as_tensor(np.isin(rows, fit.rows))
    count, losses = torch.bincount(points.view, minlength=len(every)), np.zeros(len(every), dtype=int)
    while True:
        residual = (fit.state.residual_px(points) * points.weight[:, None]).nan_to_num(torch.inf)
        some = points.chosen(of_scale)
        scales = Scales.of(residual[of_scale], some, data.noise, limits)
        near = residual.norm(dim=-1) <= scales.limits(points, limits.reject_sigma)
        share = torch.bincount(points.view, near.to(torch.float64), minlength=len(every)) / count
        good = (share >= LEAST_SHARE).numpy()
        losses += ~good & np.isin(every, fit.views)
        chosen = _followable(data, seen, every[good & (losses < 2)])
        if np.array_equal(chosen, np.sort(fit.views)):
            kept = np.isin(fit.rows, rows[near.numpy()])
            return replace(fit, kept=torch.as_tensor(kept), scales=scales)
        if not len(chosen):
            return None
        fit = robust_rig_fit(data, chosen, fit.state, "cauchy", thresholds)


def _followable(data: RigData, seen: SeenAlone, views: Int[np.ndarray, " w"]) -> Int[np.ndarray, " v"]:
    """Of some views those in runs of which enough instants are seen to follow the board."""
    runs, views = data.runs, np.sort(views)
    assert runs is not None
    usable = views[runs.run[views] >= 0]
    posed = usable[np.isin(usable, [*seen.cam_from_board])]
    seen_at = np.unique(np.stack([runs.run[posed], data.views.frame[posed]]), axis=1)
    enough = np.bincount(seen_at[0], minlength=runs.count) > runs.degree
    return usable[enough[runs.run[usable]]]


def _begun(data: RigData, rig: RigState, start: RigState, seen: SeenAlone, chosen: Int[np.ndarray, " v"]) -> RigState:
    """A rig with the cameras' own models, those of `start`, its board followed through where each camera alone sees it."""
    runs = data.runs
    assert runs is not None
    posed = np.array([v for v in chosen if v in seen.cam_from_board])
    member = torch.tensor([data.cameras.index(int(c)) for c in data.views.camera[posed]])
    board = torch.tensor([data.boards.index(int(b)) for b in data.views.part[posed]])
    poses = Pose.stack([seen.cam_from_board[int(v)] for v in posed])
    target = rig.cam_from_rig[member].inverse() @ poses @ rig.target_from_board[board].inverse()
    times, run = runs.times(posed, None), torch.as_tensor(runs.run[posed])
    offset_s = torch.as_tensor(runs.beside_s)
    if rig.path is not None:
        offset_s = torch.where(torch.as_tensor(runs.free), rig.path.offset_s, offset_s)
    delay_s = torch.zeros_like(offset_s) if data.readout is None else torch.as_tensor(data.readout.start_s)
    clocks = Path(torch.zeros(runs.count, runs.degree, 6, dtype=torch.float64), offset_s, delay_s)
    base, rates = followed(target, run, times.tau(clocks, member), runs.count, runs.degree, times.middle_m)
    return replace(rig, models=start.models, rig_from_target=base, path=replace(clocks, rates=rates))


def _unlikelihood(residual: Float[Tensor, "n 2"]) -> float:
    """The negative logarithm of the likelihood of residuals, for each, with the Cauchy distribution of two dimensions whose scale
    fits them best: that of mean r^2 / (r^2 + s^2) = 2 / 3."""
    squares = residual.square().sum(-1).nan_to_num(torch.inf).clamp(1e-12, 1e12)
    low, high = squares.min(), squares.max()
    for _ in range(60):
        scale = (low * high).sqrt()
        above = bool((squares / (squares + scale)).mean() > 2 / 3)
        low, high = (scale, high) if above else (low, scale)
    return float(low.log() + 1.5 * (squares / low).log1p().mean())
