"""The compiled engine of the common adjustment: lines, and poses where asked, from costs of two residuals each.

Frames are renumbered so that the band of the reduced system is narrow, lines are sorted along them so that neighbours in time are
neighbours in memory, observations by line. `engine_passes.py` has the passes over the lines, `kernels/schur.py` the arithmetic.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models.repeatable import total
from omnilines.adjustment.engine_layout import Layout, layout
from omnilines.adjustment.engine_passes import MOST_STEPS_ALONE, LinePasses, search_from
from omnilines.adjustment.kernels.line import CONVERGED, LOSS_KINDS, MOVING, SINGULAR, STALLED, FrameSums, LineBlocks, LineStates
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses, moved_poses
from omnilines.costs import cost_named
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, Step, minimise
from omnilines.least_squares.reduced_system import ReducedSystem

LINE_OUTCOMES = {CONVERGED: Outcome.CONVERGED, STALLED: Outcome.STALLED, SINGULAR: Outcome.DEGENERATE}


def is_compiled(problem: LineProblem, state: LinesAndPoses) -> bool:
    """Whether the compiled engine takes a problem: without a rig and with fixed cameras."""
    return state.rig is None and not problem.freedom.cameras and _takes_arcs(problem)


def _takes_arcs(problem: LineProblem) -> bool:
    """Whether the cost has the form that the kernels need, and the arcs are on the processor."""
    return cost_named(problem.cost_name).scaled_rows is not None and problem.arcs.bearings.device.type == "cpu"


@dataclass(frozen=True)
class Reduction:
    """What one pass over the lines gives: their blocks, the reduced system of the frames and its right side."""

    solved: LineBlocks
    system: ReducedSystem | None
    right: Float[np.ndarray, " k"]
    gradient: Float[np.ndarray, " k"]
    """Of the frames themselves, before the reduction."""
    diagonal: Float[np.ndarray, " k"]
    """Of the frames' own blocks."""


class LineEngine:
    """An `Engine` for one problem from one start; the start decides the layout only."""

    def __init__(self, problem: LineProblem, loss: Loss, laid_out: Layout | None = None) -> None:
        self.problem = problem
        self.passes = passes_of(problem, loss, laid_out)
        self.layout, self.views = self.passes.layout, self.passes.views
        self.residuals = 2 * len(problem.arcs)

    def cost(self, state: LinesAndPoses) -> float:
        """Sum of the loss, and of the prior."""
        return float(self.passes.costs(self.poses(state), self.lines(state.chart)).sum()) + self._prior_cost(state)

    def minimise(
        self, state: LinesAndPoses, max_iterations: int, callback: Callable[[Progress], None] | None = None
    ) -> Minimum[LinesAndPoses]:
        """Levenberg-Marquardt: of everything together, or of each line alone where all poses are held."""
        if len(self.problem.free):
            return minimise(self, state, max_iterations, callback=callback)
        return self._minimise_lines(state, max_iterations, callback)

    def step(self, state: LinesAndPoses, damping: float) -> Step[LinesAndPoses] | None:
        """The step of frames and lines, and the lines' own ones after it; None where the equations are singular."""
        reduction = self.reduce(state, damping)
        if reduction is None or reduction.system is None:
            return None
        kept = reduction.system.solve(reduction.right[:, None])[:, 0]
        if not np.isfinite(kept).all():
            return None
        promised = float((kept * (reduction.gradient + damping * kept * reduction.diagonal)).sum())
        delta = np.zeros((len(self.layout.frames), 6))
        delta[: len(self.problem.free)] = kept.reshape(-1, 6)
        free = self.layout.frames[: len(self.problem.free)]
        moved = moved_poses(state.rig_from_world, free, torch.from_numpy(delta[: len(free)]))
        trial = replace(state, rig_from_world=moved, chart=empty_chart(state.chart))
        pose, moved_pose, lines, into = self.poses(state), self.poses(trial), self.lines(state.chart), self.lines(trial.chart)
        of_lines, cost = self.passes.follow(pose, moved_pose, delta, lines, damping, solved=reduction.solved, into=into)
        return Step(trial, cost + self._prior_cost(trial), promised + of_lines)

    def _minimise_lines(
        self, state: LinesAndPoses, max_iterations: int, callback: Callable[[Progress], None] | None
    ) -> Minimum[LinesAndPoses]:
        """All poses held: no line is slowed down, or let rise, by another. What is promised of them all when they have converged
        is less than the tolerance of the whole cost."""
        pose, lines = self.poses(state), self.lines(state.chart)
        lines = lines._replace(centre=lines.centre.copy(), turn=lines.turn.copy(), phi=lines.phi.copy())
        cost = self.passes.costs(pose, lines)
        search = search_from(cost)
        initial, iteration = float(cost.sum()), 0
        while iteration < max_iterations and (search.end == MOVING).any():
            iteration += 1
            moved = self.passes.step_lines(pose, lines, search)
            if callback is not None:
                callback(Progress(iteration, float(cost.sum()), float(search.damping.max()), moved > 0))
        outcome = Outcome.OUT_OF_ITERATIONS
        if not (search.end == MOVING).any():
            outcome = LINE_OUTCOMES[int(search.end.max(initial=CONVERGED))]
        centre, turn, phi = (torch.from_numpy(array) for array in (lines.centre, lines.turn, lines.phi))
        end = replace(state, chart=replace(state.chart, centre=centre, S=turn, phi=phi))
        return Minimum(end, outcome, float(cost.sum()), initial, iteration)

    def reduce(self, state: LinesAndPoses, damping: float) -> Reduction | None:
        """One pass over the lines; None where a line's block is singular."""
        found = self.passes.reduce(self.poses(state), self.lines(state.chart), damping)
        if found is None:
            return None
        solved, total = found
        self._add_prior(state, total)
        system = None
        if len(self.problem.free):
            blocks, sizes = self.passes.damped(total, damping), self.problem.step_sizes(state).numpy()
            # The same six for every frame, in any order.
            system = ReducedSystem.of(self.layout.pattern, blocks, self.motions(state), damping, sizes)
        right, own = total.gradient[:, :6].ravel(), total.gradient[:, 6:].ravel()
        return Reduction(solved, system, right, own, total.diagonal.ravel())

    def motions(self, state: LinesAndPoses) -> Float[np.ndarray, "k g"]:
        """B in the order of the engine's frames."""
        found = self.problem.motions(state).numpy()
        return found.reshape(len(self.problem.free), 6, found.shape[1])[self.layout.rank].reshape(found.shape)

    def poses(self, state: LinesAndPoses) -> Float[np.ndarray, "frames 12"]:
        """R by rows and the centre of every frame, in the engine's order."""
        return self.passes.poses(state.rig_from_world)

    def lines(self, chart: LineChart) -> LineStates:
        """The charts of all lines."""
        return self.passes.lines(chart)

    def _prior_cost(self, state: LinesAndPoses) -> float:
        if self.problem.prior is None or not len(self.problem.free):
            return 0.0
        return total(self.problem.prior.residual(state.rig_from_world)[0][self.problem.free].square())

    def prior_blocks(self, state: LinesAndPoses) -> Float[np.ndarray, "free 6 6"] | None:
        """P'P of every free frame in the order of the layout; None without a prior."""
        if self.problem.prior is None or not len(self.problem.free):
            return None
        j = self.problem.prior.residual(state.rig_from_world)[1][self.layout.frames[: len(self.problem.free)]].numpy()
        return j.transpose(0, 2, 1) @ j

    def _add_prior(self, state: LinesAndPoses, total: FrameSums) -> None:
        if self.problem.prior is None:
            return
        residual, by_pose = self.problem.prior.residual(state.rig_from_world)
        free = self.layout.frames[: len(self.problem.free)]
        r, j = residual[free].numpy(), by_pose[free].numpy()
        own = j.transpose(0, 2, 1) @ j
        total.blocks[self.layout.pattern.diagonal] += own
        gradient = (j.transpose(0, 2, 1) @ r[:, :, None])[:, :, 0]
        total.gradient[:, :6] -= gradient
        total.gradient[:, 6:] -= gradient
        total.diagonal[:] += own.diagonal(axis1=1, axis2=2)


def passes_of(problem: LineProblem, loss: Loss, laid_out: Layout | None = None) -> LinePasses:
    """The passes over the lines of a problem, with a loss."""
    found = laid_out or layout(problem)
    held = problem.freedom.held_lines
    held_lines = np.zeros(problem.arcs.tracks, dtype=np.bool_) if held is None else held.numpy()
    return LinePasses(found, found.views(problem, LOSS_KINDS[loss.name], loss.scale), held_lines)


def empty_chart(like: LineChart) -> LineChart:
    """Where a step leaves the lines: as many, filled by the pass that follows the frames."""
    return LineChart(torch.empty(len(like), 3).double(), like.scale, torch.empty(len(like), 3, 3).double(), like.phi.clone())


def line_convergence(problem: LineProblem, loss: Loss) -> Callable[[LinesAndPoses], LinesAndPoses] | None:
    """What takes every line of a state to its own minimum, for problems of which the engine takes no more (cameras, rigs).

    None where it does not even take that.
    """
    arcs, held = problem.arcs, torch.ones(problem.arcs.images, dtype=torch.bool)
    if not _takes_arcs(problem):
        return None
    freedom = Freedom(held, problem.freedom.held_lines)
    laid_out: Layout | None = None

    def converge(state: LinesAndPoses) -> LinesAndPoses:
        nonlocal laid_out
        alone = LinesAndPoses(state.cam_from_world, state.chart)
        own = LineProblem(arcs.seen_by(state.models) if state.models else arcs, problem.cost_name, freedom, alone)
        laid_out = laid_out or layout(own)
        engine = LineEngine(own, loss, laid_out)
        return replace(state, chart=engine.minimise(alone, MOST_STEPS_ALONE).state.chart)

    return converge
