"""The passes over the lines of the compiled engine, of a whole scene or of a part of it: they know no prior and no gauge."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models.pose import Pose
from omnilines.adjustment.engine_layout import Layout
from omnilines.adjustment.kernels import line_step, schur
from omnilines.adjustment.kernels.line import MOVING, FrameSums, LineBlocks, LineSearch, LineStates, Views
from omnilines.geometry.line_chart import LineChart
from omnilines.progress import in_shares

TOLERANCE, EXACT_FIT, FIRST_DAMPING = 1e-12, 1e-30, 1e-4
"""Of a line alone, as `minimise` has them."""
MOST_STEPS_ALONE = 20
"""Of each line after every step of the frames; nearly all need two or three."""


@dataclass(frozen=True)
class LinePasses:
    """Lines and their observations, laid out."""

    layout: Layout
    views: Views
    held: Bool[np.ndarray, " t"]
    _sums: list[FrameSums] = field(default_factory=list, repr=False, compare=False)
    """Of the shares, kept from pass to pass."""

    def poses(self, rig_from_world: Pose) -> Float[np.ndarray, "frames 12"]:
        """R by rows and the centre of every frame, in the order of the layout."""
        return pose_rows(rig_from_world[self.layout.frames])

    def lines(self, chart: LineChart) -> LineStates:
        """The charts of all lines."""
        centre, rho, turn, phi = (
            np.ascontiguousarray(array.numpy()) for array in (chart.centre, chart.scale, chart.S, chart.phi)
        )
        return LineStates(centre, rho, turn, phi, self.held)

    def costs(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates) -> Float[np.ndarray, " t"]:
        """Loss of the observations of each line."""
        cost = np.empty(len(self.held))
        in_shares(lambda _, low, high: line_step.cost_of_lines(low, high, self.views, pose, lines, cost), self.layout.shares)
        return cost

    def reduce(
        self, pose: Float[np.ndarray, "frames 12"], lines: LineStates, damping: float
    ) -> tuple[LineBlocks, FrameSums] | None:
        """Blocks of the lines, and what they give to the reduced system; None where a line's block is singular.

        The sums may be overwritten by the next pass.
        """
        tracks = len(self.held)
        solved = LineBlocks(np.empty((tracks, 10)), np.empty((tracks, 4)), np.empty((tracks, 4)))
        its, free = self.layout.blocks_of_shares, self.layout.pattern.kept
        if not self._sums:
            self._sums.extend(
                FrameSums(np.empty((last - first, 6, 6)), np.empty((free, 12)), np.empty((free, 6))) for first, last in its
            )

        def share(k: int, low: int, high: int) -> int:
            for array in self._sums[k]:
                array.fill(0.0)
            pairs = self.layout.pairs._replace(first=its[k][0])
            return schur.reduce_lines(low, high, self.views, pose, lines, damping, pairs, self._sums[k], solved)

        if sum(in_shares(share, self.layout.shares)):
            return None
        blocks, gradients, diagonals = ([getattr(own, name) for own in self._sums] for name in FrameSums._fields)
        return solved, FrameSums(self.layout.added(blocks), sum(gradients[1:], gradients[0]), sum(diagonals[1:], diagonals[0]))

    def damped(self, total: FrameSums, damping: float) -> Float[np.ndarray, "blocks 6 6"]:
        """The blocks of the frames with Marquardt's damping, in place."""
        within = np.arange(6)
        total.blocks[self.layout.pattern.diagonal[:, None], within, within] += damping * total.diagonal
        return total.blocks

    def follow(
        self,
        pose: Float[np.ndarray, "frames 12"],
        moved_pose: Float[np.ndarray, "frames 12"],
        delta: Float[np.ndarray, "frames 6"],
        lines: LineStates,
        damping: float,
        *,
        solved: LineBlocks,
        into: LineStates,
    ) -> tuple[float, float]:
        """Lines after the step of the frames, each at its own minimum, into `into`; the decrease that the linear model promises
        of the lines' own steps, and the cost there."""
        cost = np.empty(len(self.held))
        of_lines = in_shares(
            lambda _, low, high: line_step.follow_frames(
                low, high, self.views, pose, moved_pose, delta, lines, damping, solved, into, cost
            ),
            self.layout.shares,
        )
        self._converge_lines(moved_pose, into, cost)
        return float(sum(of_lines)), float(cost.sum())

    def _converge_lines(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates, cost: Float[np.ndarray, " t"]) -> None:
        """Take every line to its own minimum, in place, while the frames stay.

        Without it few lines in curved valleys, or with as many doubtful observations as good ones, hold up all: they ask for a
        damping that the others do not need, and creep on at the rate of the reweighted equations. With it the frames see a
        function of themselves alone (variable projection, G. Golub and V. Pereyra, 1973).
        """
        search = search_from(cost)
        for _ in range(MOST_STEPS_ALONE):
            if not self.step_lines(pose, lines, search):
                break

    def step_lines(self, pose: Float[np.ndarray, "frames 12"], lines: LineStates, search: LineSearch) -> int:
        """One step of every line that still moves, in place; how many did."""
        least = (TOLERANCE * float(search.cost.sum()) + EXACT_FIT * 2 * len(self.layout.observations)) / len(search.cost)
        work = (self.views, pose, lines, search, least)
        return sum(in_shares(lambda _, low, high: line_step.step_lines(low, high, *work), self.layout.shares))


def pose_rows(poses: Pose) -> Float[np.ndarray, "frames 12"]:
    """R by rows and the centre of each."""
    return torch.cat([poses.rotation.flatten(1), poses.centre], 1).numpy()


def search_from(cost: Float[np.ndarray, " t"]) -> LineSearch:
    """Every line at its start; `cost` is kept and changed."""
    lines = len(cost)
    return LineSearch(cost, np.full(lines, FIRST_DAMPING), np.full(lines, 2.0), np.full(lines, MOVING, dtype=np.int8))
