"""The joint fit of a rig: a loss scaled by the residuals until it is clear which corners to trust, then plain least squares."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.redundancy import basis_without, redundant_parameter
from omnilines.calibration.rig.near import CornerNoise, Scales
from omnilines.calibration.rig.own_motion import OwnMotion
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigProblem, RigState
from omnilines.calibration.rig.runs import Runs
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.robust import CONVERGED, PASSES
from omnilines.calibration.thresholds import CalibrationThresholds, RobustThresholds
from omnilines.least_squares import Outcome, Progress, Solution, solve

TOLERANCE = 1e-10
"""Relative decrease of the cost at which least squares ends: with 20,000 corners that is a thousandth of a standard deviation."""


@dataclass(frozen=True, eq=False)
class Readout:
    """In which order the images of the members are read."""

    axis: Int[np.ndarray, " m"]
    """1: row by row, from top to bottom with a positive line delay; 0: column by column, from left to right."""
    middle_px: Float[np.ndarray, " m"]
    """Of the image along that axis."""
    start_s: Float[np.ndarray, " m"]
    """Line delays from which fits begin."""
    free: Bool[np.ndarray, " m"]
    """Members whose line delay is estimated."""


@dataclass(frozen=True, eq=False)
class RigData:
    """The members of a rig, their corners as the rig numbers them, and how good these are."""

    views: RigViews
    cameras: tuple[int, ...]
    """Members among the cameras of the table, the rig frame first."""
    boards: tuple[int, ...]
    """Members among the boards of a target, that of its frame first."""
    bases: tuple[Float[Tensor, "_ _"], ...]
    """Directions along which each member's parameters are refined."""
    noise: tuple[CornerNoise, ...]
    """Of each member's corners, alone."""
    relative: Float[np.ndarray, " n"]
    """Standard deviation of every corner over the root mean square of those of its camera."""
    board_m: Float[np.ndarray, "n 3"]
    shape: BoardShape = AS_DRAWN
    """Which terms of the board's shape are free."""
    motion: OwnMotion | None = None
    """What is known of the own motion of every view of the table; None where cameras see the board at one pose."""
    runs: Runs | None = None
    """Runs of frames through which the board is followed; None where cameras have one clock."""
    readout: Readout | None = None
    """How images are read where line delays are estimated; None where all rows are taken to be of one instant."""

    @property
    def ticking(self) -> int:
        """Kept columns of time, which are the last ones: line delays, then offsets of clocks."""
        delays = 0 if self.readout is None else int(self.readout.free.sum())
        return delays + (0 if self.runs is None else int(self.runs.free.sum()))

    @property
    def block(self) -> Int[np.ndarray, " a"]:
        """Eliminated block of every view of the table: its pose of the target, or its run (-1: none)."""
        return self.views.block if self.runs is None else self.runs.run

    @property
    def blocks(self) -> int:
        """Number of those."""
        return self.views.blocks if self.runs is None else self.runs.count

    def points(self, chosen: Int[np.ndarray, " v"]) -> tuple[RigPoints, Int[np.ndarray, " v"], Int[np.ndarray, " n"]]:
        """The corners of some views in the order of their cameras and views, these views, and their rows in the table."""
        views, corners = self.views, self.views.corners
        member = np.full(len(views.cameras), -1)
        member[list(self.cameras)] = np.arange(len(self.cameras))
        part = np.full(views.parts, -1)
        part[list(self.boards)] = np.arange(len(self.boards))
        ordered = chosen[np.lexsort((part[views.part[chosen]] > 0, member[views.camera[chosen]]))]
        place = np.full(len(corners.view_names), -1)
        place[ordered] = np.arange(len(ordered))
        rows = np.flatnonzero(place[corners.view] >= 0)
        rows = rows[np.argsort(place[corners.view[rows]], kind="stable")]
        camera = member[views.camera[ordered]]
        of_row = camera[place[corners.view[rows]]]
        sigma = np.array([own.sigma_px for own in self.noise])[of_row] * self.relative[rows]
        row_px, order = None, self.readout
        if order is not None:
            row_px = torch.as_tensor(corners.pixels[rows, order.axis[of_row]] - order.middle_px[of_row])
        points = RigPoints(
            view=torch.as_tensor(place[corners.view[rows]]),
            board_m=torch.as_tensor(self.board_m[rows]),
            pixels=torch.as_tensor(corners.pixels[rows]),
            weight=torch.as_tensor(1 / sigma),
            camera=torch.as_tensor(camera),
            instant=torch.as_tensor(views.block[ordered]),
            frame=torch.as_tensor(self.block[ordered]),
            board=torch.as_tensor(part[views.part[ordered]]),
            motion=None if self.motion is None else replace(self.motion, sigma=self.motion.sigma[torch.as_tensor(ordered)]),
            times=None if self.runs is None else self.runs.times(ordered, None if order is None else order.free),
            row_px=row_px,
        )
        return points, ordered, rows

    def problem(self, points: RigPoints) -> RigProblem:
        """The least-squares problem of some corners."""
        return RigProblem(points, self.bases, len(self.boards), self.views.tied is None, self.blocks, self.shape)


@dataclass(frozen=True, eq=False)
class RigFit:
    """A robust fit of some views, and the corners that are near enough to it."""

    points: RigPoints
    problem: RigProblem
    """Of these points."""
    views: Int[np.ndarray, " v"]
    """Views of the table that `points` hold, in their order there."""
    rows: Int[np.ndarray, " n"]
    """Rows of the table that `points` hold."""
    state: RigState
    kept: Bool[Tensor, " n"]
    scales: Scales

    @property
    def share_kept(self) -> Float[Tensor, " v"]:
        """Of every view, the share of its corners that are kept."""
        views = len(self.points.camera)
        count = torch.bincount(self.points.view, minlength=views).clamp_min(1)
        return torch.bincount(self.points.view, self.kept.to(torch.float64), minlength=views) / count


def judged(
    data: RigData,
    problem: RigProblem,
    views: Int[np.ndarray, " v"],
    rows: Int[np.ndarray, " n"],
    state: RigState,
    thresholds: RobustThresholds,
) -> RigFit:
    """The corners near enough to a state."""
    residual, points = problem.linearise(state).residual, problem.points
    scales = Scales.of(residual, points, data.noise, thresholds)
    return RigFit(
        points=points,
        problem=problem,
        views=views,
        rows=rows,
        state=state,
        kept=residual.norm(dim=-1) <= scales.limits(points, thresholds.reject_sigma),
        scales=scales,
    )


def not_fitted(data: RigData, chosen: Int[np.ndarray, " v"], state: RigState) -> tuple[RigFit, Solution[RigState]]:
    """All corners of some views as they are seen from where a fit begins."""
    points, views, rows = data.points(chosen)
    problem = data.problem(points)
    kept = torch.ones(len(points.view), dtype=torch.bool)
    return RigFit(points, problem, views, rows, state, kept, Scales.alone(data.noise)), solve(problem, state, max_iterations=0)


def robust_rig_fit(
    data: RigData,
    chosen: Int[np.ndarray, " v"],
    state: RigState,
    loss: str,
    thresholds: CalibrationThresholds,
    *,
    callback: Callable[[Progress], None] | None = None,
) -> RigFit:
    """Refine with a loss scaled by the residuals until their scale and the set of kept corners converge."""
    points, views, rows = data.points(chosen)
    problem = data.problem(points)
    limits = thresholds.robust
    fit = judged(data, problem, views, rows, state, limits)
    for done in range(PASSES):
        # The first passes only have to bring the scale down.
        scaled = fit.scales.loss("cauchy" if loss == "none" else loss, points, limits.loss_scale)
        solution = solve(problem, fit.state, scaled, tolerance=1e-3 if done == 0 else 1e-4, callback=callback)
        before, fit = fit, judged(data, problem, views, rows, solution.state, limits)
        # Where corners fit the rig as well as their own cameras, nothing more is to be gained.
        beside_alone = fit.scales.beside_alone
        same = bool((fit.kept == before.kept).all()) and beside_alone > (1 - CONVERGED) * before.scales.beside_alone
        if beside_alone < thresholds.rig.as_good_as_alone_factor or same:
            break
    return fit


def least_squares_rig(
    data: RigData, fit: RigFit, loss: str, callback: Callable[[Progress], None] | None = None
) -> tuple[RigData, RigFit, Solution[RigState], tuple[str, ...]]:
    """Plain least squares of the kept corners; of all with the loss "none".

    A parameter that others of its camera make up for is held, which a note says and the bases of the data then show.
    """
    kept = torch.ones_like(fit.kept) if loss == "none" else fit.kept
    points, state = fit.points.chosen(kept), fit.state
    problem = fit.problem if bool(kept.all()) else data.problem(points)
    notes: list[str] = []
    while True:
        solution = solve(problem, state, max_iterations=300, tolerance=TOLERANCE, callback=callback, damping=1e-8)
        held = _redundant(data, solution, points) if solution.outcome is Outcome.DEGENERATE else None
        if held is None:
            return data, replace(fit, state=solution.state, kept=kept), solution, tuple(notes)
        member, parameter = held
        state = solution.state
        name, value = list(state.models[member].named_parameters().items())[parameter]
        camera = data.views.cameras[data.cameras[member]]
        notes.append(
            f"Camera {camera}: the other parameters can make up for any small change of {name}: it is held at {value:.4g}, "
            "without a sigma."
        )
        bases = [basis_without(basis, parameter) if k == member else basis for k, basis in enumerate(data.bases)]
        data = replace(data, bases=tuple(bases))
        problem = data.problem(points)


def _redundant(data: RigData, solution: Solution[RigState], points: RigPoints) -> tuple[int, int] | None:
    """A member and its parameter along which the solution is open although no bearing moves."""
    low = 0
    for member, basis in enumerate(data.bases):
        own = basis @ solution.weakest_direction[low : low + basis.shape[1]]
        low += basis.shape[1]
        pixels = points.pixels[points.camera[points.view] == member]
        found = redundant_parameter(solution.state.models[member], own, pixels) if bool(own.any()) else None
        if found is not None:
            return member, found
    return None
