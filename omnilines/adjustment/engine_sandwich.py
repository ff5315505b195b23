"""The covariance H^-1 K H^-1 of lines and frames in the compiled engine, for costs that do not weigh arcs by their noise."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from omnilines.adjustment.engine_layout import Layout
from omnilines.adjustment.kernels import covariance as covariance_kernel
from omnilines.adjustment.kernels import sandwich as sandwich_kernel
from omnilines.adjustment.kernels.line import LineBlocks, LineStates, Views
from omnilines.least_squares.reduced_system import ReducedSystem, sparse_matrix
from omnilines.progress import in_shares


@dataclass(frozen=True)
class LineSandwich:
    """K by the residuals of the arcs and of the prior, and what the engine knows of H; see `sandwich_kernel.py`."""

    layout: Layout
    views: Views
    scatter: Float[np.ndarray, "n 2 2"]
    """Covariance of the two residuals of every arc, in the order of the views."""
    of_prior: Float[np.ndarray, "free 6 6"] | None
    """Covariance that the prior gives to the right side of every frame."""
    pose: Float[np.ndarray, "frames 12"]
    lines: LineStates
    solved: LineBlocks
    system: ReducedSystem | None
    inverse: Float[np.ndarray, "blocks 6 6"]
    """S^-1, no blocks where no frame moves."""

    @cached_property
    def _scores(self) -> tuple[Float[np.ndarray, "blocks 6 6"], Float[np.ndarray, "t 4 4"]]:
        """What the arcs give to K of the frames, and Q of every line."""
        its = self.layout.blocks_of_shares
        sums = [np.zeros((last - first, 6, 6)) for first, last in its]
        inner = np.zeros((len(self.layout.lines), 4, 4))
        given = (self.views, self.scatter, self.pose, self.lines)

        def share(k: int, low: int, high: int) -> None:
            pairs = self.layout.pairs._replace(first=its[k][0])
            sandwich_kernel.scatter_lines(low, high, *given, pairs, self.solved, sums[k], inner)

        in_shares(share, self.layout.shares)
        return self.layout.added(sums), inner

    @cached_property
    def _frame_scores(self) -> Float[np.ndarray, "blocks 6 6"]:
        """K of the frames."""
        scores = self._scores[0].copy()
        if self.of_prior is not None:
            scores[self.layout.pattern.diagonal] += self.of_prior
        return scores

    def trace(self) -> float:
        """tr(H^-1 K) of the arcs: their noise that the parameters take up."""
        scores, inner = self._scores
        # L^-1 has been applied to both sides of Q.
        own = float(inner.trace(axis1=1, axis2=2).sum())
        twice = np.where(self.layout.pattern.row == self.layout.pattern.column, 1.0, 2.0)
        return own + float(np.einsum("b,bij,bij->", twice, self.inverse, scores)) if self.system is not None else own

    def covariances(self) -> tuple[Float[np.ndarray, "free 6 6"], Float[np.ndarray, "t 4 4"]]:
        """Of every free frame, in the order of the layout, and of every line."""
        spread = self.inverse
        if self.system is not None:
            spread = self.system.conjugated_blocks(self._frame_scores)
        lines = np.empty((len(self.layout.lines), 4, 4))
        given = (self.views, self.scatter, self.pose, self.lines, self.layout.pairs, spread, self.inverse, self.solved)
        inner = self._scores[1]
        in_shares(lambda _, low, high: sandwich_kernel.line_sandwiches(low, high, *given, inner, lines), self.layout.shares)
        return spread[self.layout.pattern.diagonal if self.system is not None else slice(0)], lines

    def joint(
        self, blocks: Int[np.ndarray, " b"], roots: Float[np.ndarray, "b 4 4"], gains: Float[np.ndarray, "b 4 k"]
    ) -> Float[np.ndarray, "b4 b4"]:
        """Of some lines together; `roots` are L'^-1 of each, `gains` how they follow the frames."""
        size, inner = 4 * len(blocks), self._scores[1]
        joint = np.zeros((len(blocks), 4, len(blocks), 4))
        each = np.arange(len(blocks))
        joint[each, :, each] = roots @ inner[blocks] @ roots.transpose(0, 2, 1)
        result = joint.reshape(size, size)
        if self.system is None:
            return result
        rest = np.zeros_like(gains)
        places, free = self.layout.place_of_line[blocks], self.layout.pattern.kept
        given = (places, self.views, self.scatter, self.pose, self.lines, free, self.solved, inner)
        sandwich_kernel.shared_gains(*given, rest)
        follow = self.system.solve(np.ascontiguousarray(gains.reshape(size, -1).T))
        shared = rest.reshape(size, -1) @ follow
        between = sparse_matrix(self.layout.pattern, self._frame_scores) @ follow
        return result + follow.T @ between - shared - shared.T


def frame_gains(
    layout: Layout,
    views: Views,
    pose: Float[np.ndarray, "frames 12"],
    lines: LineStates,
    solved: LineBlocks,
    *,
    blocks: Int[np.ndarray, " b"],
) -> Float[np.ndarray, "b 4 k"]:
    """L'^-1 sum Z_i P_i of some lines: minus this is how they follow the frames."""
    gains = np.zeros((len(blocks), 4, 6 * layout.pattern.kept))
    covariance_kernel.line_gains(layout.place_of_line[blocks], views, pose, lines, layout.pattern.kept, solved, gains)
    return gains
