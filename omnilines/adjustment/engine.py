"""The compiled engine of the common adjustment: lines, and poses where asked, from costs of two residuals each.

Frames are renumbered so that the band of the reduced system is narrow, lines are sorted along them so that neighbours in time are
neighbours in memory, observations by line. `kernels/schur.py` has the arithmetic.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from omnilines.adjustment.engine_layout import Layout, layout
from omnilines.adjustment.kernels import line_step, schur
from omnilines.adjustment.kernels.line import (
    CONVERGED,
    LOSS_KINDS,
    MOVING,
    SINGULAR,
    STALLED,
    FrameSums,
    LineBlocks,
    LineSearch,
    LineStates,
    Views,
)
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses, moved_poses
from omnilines.costs import cost_named
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, Step, minimise
from omnilines.least_squares.reduced_system import ReducedSystem
from omnilines.progress import in_shares

TOLERANCE, EXACT_FIT, FIRST_DAMPING = 1e-12, 1e-30, 1e-4
"""Of a line alone, as `minimise` has them."""
MOST_STEPS_ALONE = 20
"""Of each line after every step of the frames; nearly all need two or three."""
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
        self.layout = laid_out or layout(problem)
        self.views: Views = self.layout.views(problem, LOSS_KINDS[loss.name], loss.scale)
        self.residuals = 2 * len(problem.arcs)
        held = problem.freedom.held_lines
        self._held = np.zeros(problem.arcs.tracks, dtype=np.bool_) if held is None else held.numpy()
        self._sums: list[FrameSums] = []

    def cost(self, state: LinesAndPoses) -> float:
        """Sum of the loss, and of the prior."""
        return float(self._costs(self.poses(state), self.lines(state.chart)).sum()) + self._prior_cost(state)

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
        promised = float(kept @ reduction.gradient + damping * (kept**2 @ reduction.diagonal))
        delta = np.zeros((len(self.layout.frames), 6))
        delta[: len(self.problem.free)] = kept.reshape(-1, 6)
        free = self.layout.frames[: len(self.problem.free)]
        moved = moved_poses(state.rig_from_world, free, torch.from_numpy(delta[: len(free)]))
        trial = replace(state, rig_from_world=moved, chart=self._empty_chart(state.chart))
        pose, moved_pose, lines, into = self.poses(state), self.poses(trial), self.lines(state.chart), self.lines(trial.chart)
        cost = np.empty(self.problem.arcs.tracks)
        of_lines = in_shares(
            lambda _, low, high: line_step.follow_frames(
                low, high, self.views, pose, moved_pose, delta, lines, damping, reduction.solved, into, cost
            ),
            self.layout.shares,
        )
        self._converge_lines(moved_pose, into, cost)
        return Step(trial, float(cost.sum()) + self._prior_cost(trial), promised + float(sum(of_lines)))

    def _converge_lines(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates, cost: Float[np.ndarray, " t"]) -> None:
        """Take every line to its own minimum, in place, while the frames stay.

        Without it few lines in curved valleys, or with as many doubtful observations as good ones, hold up all: they ask for a
        damping that the others do not need, and creep on at the rate of the reweighted equations. With it the frames see a
        function of themselves alone (variable projection, G. Golub and V. Pereyra, 1973).
        """
        search = _search(cost)
        for _ in range(MOST_STEPS_ALONE):
            if not self._step_lines(pose, lines, search):
                break

    def _minimise_lines(
        self, state: LinesAndPoses, max_iterations: int, callback: Callable[[Progress], None] | None
    ) -> Minimum[LinesAndPoses]:
        """All poses held: no line is slowed down, or let rise, by another. What is promised of them all when they have converged
        is less than the tolerance of the whole cost."""
        pose, lines = self.poses(state), self.lines(state.chart)
        lines = lines._replace(centre=lines.centre.copy(), turn=lines.turn.copy(), phi=lines.phi.copy())
        cost = self._costs(pose, lines)
        search = _search(cost)
        initial, iteration = float(cost.sum()), 0
        while iteration < max_iterations and (search.end == MOVING).any():
            iteration += 1
            moved = self._step_lines(pose, lines, search)
            if callback is not None:
                callback(Progress(iteration, float(cost.sum()), float(search.damping.max()), moved > 0))
        outcome = Outcome.OUT_OF_ITERATIONS
        if not (search.end == MOVING).any():
            outcome = LINE_OUTCOMES[int(search.end.max(initial=CONVERGED))]
        centre, turn, phi = (torch.from_numpy(array) for array in (lines.centre, lines.turn, lines.phi))
        end = replace(state, chart=replace(state.chart, centre=centre, S=turn, phi=phi))
        return Minimum(end, outcome, float(cost.sum()), initial, iteration)

    def _step_lines(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates, search: LineSearch) -> int:
        """One step of every line that still moves, in place; how many did."""
        least = (TOLERANCE * float(search.cost.sum()) + EXACT_FIT * self.residuals) / len(search.cost)
        work = (self.views, pose, lines, search, least)
        return sum(in_shares(lambda _, low, high: line_step.step_lines(low, high, *work), self.layout.shares))

    def reduce(self, state: LinesAndPoses, damping: float) -> Reduction | None:
        """One pass over the lines; None where a line's block is singular."""
        pose, lines, tracks = self.poses(state), self.lines(state.chart), self.problem.arcs.tracks
        solved = LineBlocks(np.empty((tracks, 10)), np.empty((tracks, 4)), np.empty((tracks, 4)))
        if not self._sums:
            blocks, free = len(self.layout.pattern.row), self.layout.pattern.kept
            self._sums = [
                FrameSums(np.empty((blocks, 6, 6)), np.empty((free, 12)), np.empty((free, 6))) for _ in self.layout.shares[1:]
            ]

        def share(k: int, low: int, high: int) -> int:
            for array in self._sums[k]:
                array.fill(0.0)
            return schur.reduce_lines(low, high, self.views, pose, lines, damping, self.layout.pairs, self._sums[k], solved)

        if sum(in_shares(share, self.layout.shares)):
            return None
        total = self._sums[0]
        for other in self._sums[1:]:
            for array, more in zip(total, other, strict=True):
                array += more
        self._add_prior(state, total)
        within = np.arange(6)
        total.blocks[self.layout.pattern.diagonal[:, None], within, within] += damping * total.diagonal
        system = None
        if len(self.problem.free):
            system = ReducedSystem.of(self.layout.pattern, total.blocks, self.gauge(state), damping)
        right, own = total.gradient[:, :6].ravel(), total.gradient[:, 6:].ravel()
        return Reduction(solved, system, right, own, total.diagonal.ravel())

    def gauge(self, state: LinesAndPoses) -> Float[np.ndarray, "k g"]:
        """B in the order of the engine's frames."""
        gauge = self.problem.gauge(state).numpy()
        return gauge.reshape(len(self.problem.free), 6, gauge.shape[1])[self.layout.rank].reshape(gauge.shape)

    def _costs(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates) -> Float[np.ndarray, " t"]:
        """Loss of the observations of each line."""
        cost = np.empty(self.problem.arcs.tracks)
        in_shares(lambda _, low, high: line_step.cost_of_lines(low, high, self.views, pose, lines, cost), self.layout.shares)
        return cost

    def poses(self, state: LinesAndPoses) -> Float[np.ndarray, "frames 12"]:
        """R by rows and the centre of every frame, in the engine's order."""
        poses = state.rig_from_world[self.layout.frames]
        return torch.cat([poses.rotation.flatten(1), poses.centre], 1).numpy()

    def lines(self, chart: LineChart) -> LineStates:
        """The charts of all lines."""
        centre, rho, turn, phi = (
            np.ascontiguousarray(array.numpy()) for array in (chart.centre, chart.scale, chart.S, chart.phi)
        )
        return LineStates(centre, rho, turn, phi, self._held)

    def _empty_chart(self, like: LineChart) -> LineChart:
        return LineChart(torch.empty(len(like), 3).double(), like.scale, torch.empty(len(like), 3, 3).double(), like.phi.clone())

    def _prior_cost(self, state: LinesAndPoses) -> float:
        if self.problem.prior is None or not len(self.problem.free):
            return 0.0
        return float(self.problem.prior.residual(state.rig_from_world)[0][self.problem.free].square().sum())

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


def _search(cost: Float[np.ndarray, " t"]) -> LineSearch:
    """Every line at its start; `cost` is kept and changed."""
    lines = len(cost)
    return LineSearch(cost, np.full(lines, FIRST_DAMPING), np.full(lines, 2.0), np.full(lines, MOVING, dtype=np.int8))
