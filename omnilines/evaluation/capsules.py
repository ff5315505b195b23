"""The parts of lines near other lines, and the lengths of their unions, in closed form.

The points within a distance of a straight edge fill a capsule, which is convex. So the part of a line near an edge, and of an
edge near a line, is one interval, and every measure is the length of a union of intervals: nothing is sampled.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_PAIRS = 1 << 20
"""Pairs of a line and an edge that are looked at together: bounds the memory."""


def lengths(ends: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """From the first to the second end."""
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)


def directions(ends: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit vectors from the first to the second end."""
    return (ends[:, 1] - ends[:, 0]) / lengths(ends)[:, None]


@dataclass(frozen=True)
class Spans:
    """Intervals along lines or edges, metres from their first ends."""

    owner: Int[np.ndarray, " n"]
    span: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class _Pieces:
    """Lines or edges cut where any interval of some sets begins or ends, and how many of each set cover each piece."""

    owners: int
    owner: Int[np.ndarray, " p"]
    length: Float[np.ndarray, " p"]
    depth: Int[np.ndarray, "p sets"]

    def total(self, counts: Bool[np.ndarray, " p"]) -> Float[np.ndarray, " owners"]:
        """Length of the pieces of each owner that count."""
        # np.bincount gives integers where there is nothing to add.
        return np.bincount(self.owner[counts], self.length[counts], self.owners).astype(np.float64)


def cut_where_covered(owners: int, sets: Sequence[Spans]) -> _Pieces:
    """Sweep: the depth changes by one at the ends of the intervals, and is 0 between owners."""
    owner = np.concatenate([np.repeat(spans.owner, 2) for spans in sets])
    place = np.concatenate([spans.span.ravel() for spans in sets])
    change = np.zeros((len(owner), len(sets)), dtype=np.int64)
    first = 0
    for k, spans in enumerate(sets):
        rows = 2 * len(spans.owner)
        change[first : first + rows, k] = np.tile([1, -1], len(spans.owner))
        first += rows
    order = np.lexsort((place, owner))
    owner, place = owner[order], place[order]
    depth = np.cumsum(change[order], axis=0)
    same = owner[1:] == owner[:-1]
    return _Pieces(owners, owner[:-1][same], np.diff(place)[same], depth[:-1][same])


def covered_lengths(owners: int, spans: Spans) -> Float[np.ndarray, " owners"]:
    """Length of the union of the intervals of each owner."""
    pieces = cut_where_covered(owners, [spans])
    return pieces.total(pieces.depth[:, 0] > 0)


def portions(rows: int, columns: int) -> Iterator[slice]:
    """Rows a few at a time, so that with all columns they are at most _PAIRS."""
    step = max(1, _PAIRS // max(columns, 1))
    return (slice(first, first + step) for first in range(0, rows, step))


def near_pairs(
    lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"], reach_m: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Pairs of a line and an edge whose boxes are within `reach_m` of each other: all that can be near."""
    low, high = edges.min(1) - reach_m, edges.max(1) + reach_m
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for rows in portions(len(lines), len(edges)):
        part = lines[rows]
        apart = (part.min(1)[:, None] > high).any(-1) | (part.max(1)[:, None] < low).any(-1)
        i, j = np.nonzero(~apart)
        pairs.append(np.stack([i + rows.start, j]))
    line, edge = np.concatenate(pairs, axis=1)
    return line, edge


def near_parts(
    lines: Float[np.ndarray, "n 2 3"],
    line: Int[np.ndarray, " k"],
    axes: Float[np.ndarray, "m 2 3"],
    axis: Int[np.ndarray, " k"],
    reach_m: float,
) -> Spans:
    """The parts of lines within `reach_m` of the axes they are paired with; owners are the lines."""
    span, there = _in_capsule(lines[line], axes[axis], reach_m)
    return Spans(line[there], span[there])


def _in_capsule(
    lines: Float[np.ndarray, "n 2 3"], axes: Float[np.ndarray, "n 2 3"], reach_m: float
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Where a line, metres from its first end, is within `reach_m` of a segment, pair by pair, and whether it is at all.

    A capsule is the union of a finite cylinder and a ball about each end. It is convex: the hull of the three intervals is the
    interval of the union.
    """
    length, reach = lengths(lines), lengths(axes)
    along, axis = directions(lines), directions(axes)
    first = lines[:, 0] - axes[:, 0]
    turn, arm = np.cross(along, axis), np.cross(first, axis)
    parts = [_not_positive((turn * turn).sum(-1), (turn * arm).sum(-1), (arm * arm).sum(-1) - reach_m**2)]
    slab = _between((first * axis).sum(-1), (along * axis).sum(-1), reach)
    parts[0] = np.stack([np.maximum(parts[0][:, 0], slab[:, 0]), np.minimum(parts[0][:, 1], slab[:, 1])], -1)
    for end in range(2):
        from_end = lines[:, 0] - axes[:, end]
        parts.append(_not_positive(np.ones(len(lines)), (along * from_end).sum(-1), (from_end * from_end).sum(-1) - reach_m**2))
    every = np.stack(parts)
    empty = ~(every[..., 0] <= every[..., 1])
    low = np.where(empty, np.inf, every[..., 0]).min(0).clip(min=0.0)
    high = np.minimum(np.where(empty, -np.inf, every[..., 1]).max(0), length)
    return np.stack([low, high], -1), high > low


def _not_positive(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], c: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Where a s^2 + 2 b s + c <= 0, a >= 0: from inf to -inf where nowhere, all s where a = 0 and c <= 0."""
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    # The larger root first, the other from their product: no difference of near numbers.
    large = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        pair = np.sort(np.stack([large / a, c / large], -1), axis=-1)
    # With a below the square of what rounding leaves of two parallel unit vectors, the slope is none.
    parallel = a < 1e-30
    pair[parallel] = np.where(c[parallel, None] <= 0, [-np.inf, np.inf], [np.inf, -np.inf])
    pair[~parallel & (b * b < a * c)] = [np.inf, -np.inf]
    touching = ~parallel & (large == 0)
    pair[touching] = 0.0
    return pair


def _between(
    start: Float[np.ndarray, " n"], slope: Float[np.ndarray, " n"], top: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """Where 0 <= start + s slope <= top: from inf to -inf where nowhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pair = np.sort(np.stack([-start / slope, (top - start) / slope], -1), axis=-1)
    level = slope == 0
    inside = (start >= 0) & (start <= top)
    pair[level] = np.where(inside[level, None], [-np.inf, np.inf], [np.inf, -np.inf])
    return pair
