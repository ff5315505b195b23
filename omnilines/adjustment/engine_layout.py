"""How the compiled engine lays out a problem: the order of frames, lines and observations, and which frames go together."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.kernels.line import Pairs, Views
from omnilines.adjustment.problem import LineProblem
from omnilines.costs import cost_named
from omnilines.costs._cost import ScaledRows
from omnilines.least_squares.pattern import PairPattern, narrower_order, pair_pattern, summed_pieces

ROWS_AT_ONCE = 1 << 16
"""Observations whose rows are prepared at once."""


@dataclass(frozen=True)
class Layout:
    """The order of everything in the compiled engine."""

    frames: Int[Tensor, " frames"]
    """The frame at each place: free ones first."""
    rank: Int[np.ndarray, " free"]
    """Number, among the free frames of the problem, of the frame at each place."""
    pattern: PairPattern
    lines: Int[np.ndarray, " t"]
    """The line at each place."""
    start: Int[np.ndarray, " t1"]
    """First observation of the line at each place."""
    observations: Int[Tensor, " n"]
    """Row of the arcs at each place."""
    frame: Int[np.ndarray, " n"]
    """Place of each observation's frame."""
    shares: list[int]
    """Bounds of the places of lines that one thread works on at a time, whatever the number of threads."""

    @property
    def pairs(self) -> Pairs:
        """For the kernels."""
        return Pairs(self.pattern.kept, self.pattern.window, self.pattern.block_of, 0)

    @cached_property
    def blocks_of_shares(self) -> list[tuple[int, int]]:
        """The blocks of the pattern that each share adds to: the first, and one after the last."""
        ends = self.start[self.shares]
        return [self.pattern.blocks_of(self.frame[low:high]) for low, high in pairwise(ends.tolist())]

    def added(self, sums: list[np.ndarray]) -> np.ndarray:
        """The sums of all blocks, from those of each share."""
        total = np.zeros((len(self.pattern.row), *sums[0].shape[1:]))
        for (first, last), own in zip(self.blocks_of_shares, sums, strict=True):
            total[first:last] += own
        return total

    @property
    def place_of_line(self) -> Int[np.ndarray, " t"]:
        """Where each line is."""
        return np.argsort(self.lines, kind="stable")

    def back(self, values: Float[np.ndarray, "free *rest"]) -> Float[np.ndarray, "free *rest"]:
        """Values of the free frames in the order of the problem."""
        result = np.empty_like(values)
        result[self.rank] = values
        return result

    def views(self, problem: LineProblem, kind: int, scale: float) -> Views:
        """The observations for the cost of a problem, in order, and a loss."""
        arcs, mix, n = problem.arcs, problem.mix, len(self.observations)
        form = cost_named(problem.cost_name).scaled_rows if mix is None else ScaledRows()
        assert form is not None, "a cost without scaled rows is left to the general engine"
        rows = np.empty((n, 2, 3))
        spread = np.empty((0 if form.spread is None else n, 2, 6))
        upper = torch.triu_indices(3, 3)
        for low in range(0, n, ROWS_AT_ONCE):
            own = self.observations[low : low + ROWS_AT_ONCE]
            bearings, here = arcs.bearings[own], slice(low, low + len(own))
            rows[here] = (form.rows(bearings) if mix is None else mix[own] @ bearings).numpy()
            if form.spread is not None:
                spread[here] = form.spread(arcs.by_pixel[own], arcs.covariance_px2[own])[:, :, upper[0], upper[1]].numpy()
        return Views(order=self.lines, start=self.start, frame=self.frame, rows=rows, spread=spread, kind=kind, scale=scale)


def layout(problem: LineProblem, last: Int[np.ndarray, " s"] | None = None) -> Layout:
    """The order for a problem without a rig; the free frames `last` are the last ones, in that order."""
    arcs, free = problem.arcs, len(problem.free)
    order = torch.cat([problem.free, torch.nonzero(problem.freedom.held_frames).flatten()])
    found = _sorted(arcs, order, free)
    # Held frames take no part in the reduced system, whatever their order.
    better = narrower_order(found[3]) if free else None
    if better is not None:
        order = torch.cat([order[:free][torch.from_numpy(better)], order[free:]])
        found = _sorted(arcs, order, free)
    if last is not None:
        others = order[:free][~torch.isin(order[:free], torch.from_numpy(last))]
        order = torch.cat([others, torch.from_numpy(last), order[free:]])
        found = _sorted(arcs, order, free)
    lines, start, observations, pattern, frame = found
    rank = np.searchsorted(problem.free.numpy(), order[:free].numpy())
    return Layout(
        frames=order,
        rank=rank,
        pattern=pattern,
        lines=lines,
        start=start,
        observations=torch.from_numpy(observations),
        frame=frame,
        shares=summed_pieces(start, pattern),
    )


def _sorted(
    arcs: MatchedArcs, order: Int[Tensor, " frames"], free: int
) -> tuple[Int[np.ndarray, " t"], Int[np.ndarray, " t1"], Int[np.ndarray, " n"], PairPattern, Int[np.ndarray, " n"]]:
    """Lines by their first frame, the start of each, its observations by frame, the pairs and the frames' places."""
    place = np.empty(len(order), dtype=np.int64)
    place[order.numpy()] = np.arange(len(order))
    track, frame = arcs.track.numpy(), place[arcs.image.numpy()]
    first = np.full(arcs.tracks, len(order))
    np.minimum.at(first, track, frame)
    lines = np.argsort(first, kind="stable")
    place_of_line = np.empty(arcs.tracks, dtype=np.int64)
    place_of_line[lines] = np.arange(arcs.tracks)
    observations = np.argsort(place_of_line[track] * len(order) + frame, kind="stable")
    start = np.zeros(arcs.tracks + 1, dtype=np.int64)
    np.cumsum(np.bincount(track, minlength=arcs.tracks)[lines], out=start[1:])
    frame = frame[observations].astype(np.int32)
    return lines, start, observations, pair_pattern(start, frame, free), frame
