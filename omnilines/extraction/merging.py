"""Arcs of one edge joined: pieces that follow each other on one great circle, and duplicates dropped.

Two arcs are on one circle where their normals agree within their covariances (chi-square of two degrees of freedom). A gap
between them is crossed where it is short, or where edge points lie in it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from omnilines.extraction.arcs import LONGEST_RAD, Arcs, across_px, inverse_2x2, spans
from omnilines.extraction.kernels.pair import near_pairs
from omnilines.extraction.kernels.tables import PairLimits, Ranked, Samples
from omnilines.extraction.options import MergingOptions, SupportOptions
from omnilines.extraction.refit import Photo, joined, moved, support_of

MOST_GAP_RAD = 0.35
"""A gap that is longer is not looked across, whatever its pixels."""
_SAFETY = 1.5
"""Over the pixels for a radian where an arc has fewest of them, measured at a few places of it."""


@dataclass(frozen=True)
class _Pairs:
    """Pairs of arcs with nearly one circle; the second as seen in the frame of the first."""

    a: Int[np.ndarray, " k"]
    b: Int[np.ndarray, " k"]
    angles: Float[np.ndarray, "k 2"]
    """Of the ends of b on a's circle, in order."""
    gap: Float[np.ndarray, " k"]
    """Radians between them, negative where they overlap."""
    after: Bool[np.ndarray, " k"]
    """Whether b follows a's high end."""

    def keep(self, rows: Bool[np.ndarray, " k"] | Int[np.ndarray, " m"]) -> "_Pairs":
        return _Pairs(self.a[rows], self.b[rows], self.angles[rows], self.gap[rows], self.after[rows])


def merged(photo: Photo, arcs: Arcs, options: MergingOptions, support: SupportOptions) -> Arcs:
    """The arcs with pieces of one edge joined and duplicates dropped; joined ones want a refit."""
    if len(arcs) < 2:
        return arcs
    length_px, rate = spans(photo.model, arcs)
    pairs = _pairs(arcs, length_px, rate, options.max_off_px, options.max_gap_px, max_normal_rad=options.max_normal_rad)
    if not len(pairs.a):
        return arcs
    pixels_per_rad = length_px / np.maximum(arcs.high - arcs.low, 1e-9)
    gap_px = pairs.gap * np.minimum(pixels_per_rad[pairs.a], pixels_per_rad[pairs.b])
    follows = gap_px < np.minimum(options.max_gap_px, 0.5 * (length_px[pairs.a] + length_px[pairs.b]))
    offset = _offsets(photo, arcs, pairs)
    allowed = follows & (offset.min(-1) < 0.5 * options.max_off_px) & (offset.max(-1) < options.max_off_px)
    allowed[allowed] = _chi2(arcs, pairs.keep(allowed), pixels_per_rad, options.edge_sigma_px) < options.max_chi2
    joins = pairs.keep(allowed)
    gap_px = gap_px[allowed]
    filled = _filled(photo, arcs, joins, gap_px, options, support=support)
    joins = joins.keep((gap_px <= support.max_blind_px) | filled)
    twice = pairs.keep(_overlaps(arcs, pairs) & (offset.max(-1) < options.same_px) & ~allowed)
    dropped = np.zeros(len(arcs), dtype=bool)
    dropped[np.where(length_px[twice.a] < length_px[twice.b], twice.a, twice.b)] = True
    return _joined(arcs, length_px, joins.keep(~dropped[joins.a] & ~dropped[joins.b]), dropped)


def duplicates(
    photo: Photo,
    arcs: Arcs,
    rank: Float[np.ndarray, " n"],
    rate: Float[np.ndarray, " n"],
    kin: Int[np.ndarray, " n"],
    *,
    same_px: float,
    max_normal_rad: float,
) -> Bool[np.ndarray, " n"]:
    """Arcs that lie beside one of higher rank over most of their length; those of the same number in `kin` are not compared.

    `rate` are the fewest pixels across an arc for a radian (`spans`).
    """
    dropped = np.zeros(len(arcs), dtype=bool)
    if len(arcs) < 2:
        return dropped
    pairs = _pairs(arcs, rank, rate, same_px, 0.0, max_normal_rad=max_normal_rad)
    pairs = pairs.keep(kin[pairs.a] != kin[pairs.b])
    if len(pairs.a):
        dropped[pairs.b[_offsets(photo, arcs, pairs).max(-1) < same_px]] = True
    return dropped


def _pairs(
    arcs: Arcs,
    rank: Float[np.ndarray, " n"],
    rate: Float[np.ndarray, " n"],
    max_off_px: float,
    max_gap_px: float,
    *,
    max_normal_rad: float,
) -> _Pairs:
    """Each pair once, the arc of higher rank (its length in pixels, where gaps are allowed) first."""
    beside = np.minimum(_SAFETY * max_off_px / np.maximum(rate, 1e-9), 1.0)
    table = Ranked(arcs.frame, arcs.low, arcs.high, rank, np.sin(beside))
    found, values, _ = near_pairs(table, PairLimits(max_normal_rad, max_gap_px, MOST_GAP_RAD, LONGEST_RAD))
    rows = np.lexsort((found.max(-1), found.min(-1)))
    found, values = found[rows], values[rows]
    return _Pairs(found[:, 0], found[:, 1], values[:, :2], values[:, 2], values[:, 3] > 0)


def _seen_from(arcs: Arcs, a: Int[np.ndarray, " k"], b: Int[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Normal of b minus that of a, and the covariance of the former, both along (first, second) of a."""
    basis = arcs.frame[a][:, :, 1:]
    other = arcs.normal[b] * np.where((arcs.normal[a] * arcs.normal[b]).sum(-1) < 0, -1.0, 1.0)[:, None]
    turn = basis.mT @ arcs.frame[b][:, :, 1:]
    return (basis.mT @ other[..., None])[..., 0], turn @ arcs.covariance[b] @ turn.mT


def _chi2(arcs: Arcs, pairs: _Pairs, pixels_per_rad: Float[np.ndarray, " n"], edge_sigma_px: float) -> Float[np.ndarray, " k"]:
    half = np.sin(np.clip(0.5 * (arcs.high - arcs.low), 1e-6, 0.5 * np.pi))
    extra = (edge_sigma_px / np.maximum(pixels_per_rad, 1e-9)) ** 2
    loose = arcs.covariance.copy()
    loose[:, 0, 0] += extra
    loose[:, 1, 1] += extra / half**2
    arcs = replace(arcs, covariance=loose)
    difference, covariance = _seen_from(arcs, pairs.a, pairs.b)
    information = inverse_2x2(covariance + loose[pairs.a])
    return np.einsum("ki,kij,kj->k", difference, information, difference)


def _overlaps(arcs: Arcs, pairs: _Pairs) -> Bool[np.ndarray, " k"]:
    """Pairs of which the shorter arc lies beside the longer one over most of its length."""
    low, high = np.maximum(pairs.angles[:, 0], arcs.low[pairs.a]), np.minimum(pairs.angles[:, 1], arcs.high[pairs.a])
    return high - low > 0.5 * np.maximum(pairs.angles[:, 1] - pairs.angles[:, 0], 1e-9)


def _offsets(photo: Photo, arcs: Arcs, pairs: _Pairs) -> Float[np.ndarray, "k 2"]:
    """Pixels from the ends of the shorter arc to the circle of the longer one, infinite where they are not seen."""
    row, other = np.repeat(pairs.a, 2), np.repeat(pairs.b, 2)
    ray = arcs.bearings(other, np.stack([arcs.low[pairs.b], arcs.high[pairs.b]], -1).ravel())
    along, beside, off = np.einsum("nk,nkj->jn", ray, arcs.frame[row][:, :, [1, 2, 0]])
    _, _, rate, valid = across_px(photo.model, arcs, row, np.arctan2(beside, along))
    offset = np.abs(np.arcsin(np.clip(off, -1.0, 1.0)) * rate)
    return np.where(valid, offset, np.inf).reshape(-1, 2)


def _filled(
    photo: Photo,
    arcs: Arcs,
    pairs: _Pairs,
    gap_px: Float[np.ndarray, " k"],
    options: MergingOptions,
    *,
    support: SupportOptions,
) -> Bool[np.ndarray, " k"]:
    """Whether edge points lie in the gap of each pair, on the circle of the first."""
    count = np.clip(np.ceil(gap_px), 1, options.max_gap_px).astype(np.int64)
    starts = np.concatenate([[0], np.cumsum(count)])
    owner = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(owner)) - starts[owner] + 0.5) / count[owner]
    begin = np.where(pairs.after, arcs.high[pairs.a], pairs.angles[:, 1])
    end = np.where(pairs.after, pairs.angles[:, 0], arcs.low[pairs.a])
    angle = begin[owner] + share * (end - begin)[owner]
    pixel, across, rate, valid = across_px(photo.model, arcs, pairs.a[owner], angle)
    there = support_of(photo, Samples(owner, starts, angle, pixel, across, rate, valid), support)
    return np.bincount(owner, there, len(count)) >= options.min_gap_support * count


def _joined(arcs: Arcs, length_px: Float[np.ndarray, " n"], joins: _Pairs, dropped: Bool[np.ndarray, " n"]) -> Arcs:
    """Join pairs that are each other's nearest at the ends that face, and what hangs together by them."""
    count = len(arcs)
    flipped = (arcs.normal[joins.a] * arcs.normal[joins.b]).sum(-1) < 0
    side_a = 2 * joins.a + joins.after
    side_b = 2 * joins.b + (joins.after == flipped)
    order = np.argsort(joins.gap, kind="stable")[::-1]
    nearest = np.full(2 * count, -1)
    for side in (side_a, side_b):
        rows = order[np.argsort(nearest[side[order]] >= 0, kind="stable")] if len(order) else order
        known = nearest[side[rows]]
        better = (known < 0) | (joins.gap[rows] <= joins.gap[np.maximum(known, 0)])
        nearest[side[rows[better]]] = rows[better]
    index = np.arange(len(joins.a))
    chosen = joins.keep((nearest[side_a] == index) & (nearest[side_b] == index))
    if not len(chosen.a):
        return arcs.keep(~dropped).centred()
    members, number = np.unique(np.stack([chosen.a, chosen.b]), return_inverse=True)
    a, b = number.reshape(2, -1)
    links = csr_matrix((np.ones(len(a)), (a, b)), shape=(len(members), len(members)))
    _, label = connected_components(links, directed=False)
    order = np.lexsort((-length_px[members], label))
    begins = np.flatnonzero(np.diff(label[order], prepend=-1))
    row = members[order]
    roots = row[begins]
    root = roots[label[order]]
    difference, covariance = _seen_from(arcs, root, row)
    information = inverse_2x2(covariance)
    shared = inverse_2x2(np.add.reduceat(information, begins))
    pull = np.add.reduceat((information @ difference[..., None])[..., 0], begins)
    longest = moved(arcs.keep(roots), (shared @ pull[..., None])[..., 0], shared)
    ends = np.stack([arcs.bearings(row, angle[row]) for angle in (arcs.low, arcs.high)], 1)
    angles = np.arctan2((ends * arcs.second[root][:, None]).sum(-1), (ends * arcs.first[root][:, None]).sum(-1))
    low, high = np.minimum.reduceat(angles.min(-1), begins), np.maximum.reduceat(angles.max(-1), begins)
    single = ~dropped
    single[row] = False
    result = joined([arcs.keep(single), replace(longest, low=low, high=high)])
    return result.keep(np.argsort(np.append(np.flatnonzero(single), roots))).centred()
