"""For every arc the 3D line that other photos agree on, compiled.

Each arc that could show the line of an arc gives a pair of depths at its ends (`hypothesis.py`). True partners give one pair
again and again; the others scatter. So each pair votes for all pairs near it, and the one with the most votes is the line.
`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.matching.kernels.epipolar import arcs_across, arcs_by_angle
from omnilines.matching.kernels.hypothesis import partners
from omnilines.matching.options import HypothesisOptions, LikenessOptions

STRIDE = 16
"""Pairs at a time by which the pairs near one are looked for."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def best_lines(
    rows: np.ndarray,
    image: np.ndarray,
    starts: np.ndarray,
    neighbours: np.ndarray,
    packed: np.ndarray,
    px_rad: np.ndarray,
    colours: np.ndarray,
    most: int,
    options: HypothesisOptions,
    looks: LikenessOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each arc of `rows`: inverse depths at both ends; score, best rival and agreement; up to `most` supporters; candidates.

    The score of a pair of depths is the sum over the other photos of the best likeness of colours and ends, times exp(-chi-square
    / 4); the agreement of the best is its score by the colours alone.
    """
    total = len(image)
    depth, score = np.full((len(rows), 2), np.nan), np.zeros((len(rows), 3))
    support, tried = np.full((len(rows), most), -1, dtype=np.int32), np.zeros(len(rows), dtype=np.int64)
    arc, found, weight = np.empty(total, dtype=np.int64), np.empty((total, 4)), np.empty((total, 2))
    others, seen, photo = np.empty(total, dtype=np.int64), np.full(total, -1, dtype=np.int64), -1
    for k in range(len(rows)):
        if image[rows[k]] != photo:
            photo = image[rows[k]]
            frames, begin, members = arcs_by_angle(photo, np.flatnonzero(neighbours[photo]), starts, packed)
        across = others[: arcs_across(packed[rows[k]], frames, begin, members, k, seen, others)]
        count = partners(rows[k], across, packed, px_rad, colours, options, looks, arc, found, weight)
        tried[k] = count
        if not count:
            continue
        order = np.argsort(found[:count, 0])
        pairs = by_first_depth(found[:count], order)
        alike, arcs, gate = weight[:count, 1].copy(), arc[order], options.agree_sigmas
        scores = pair_scores(pairs, order, alike, image[arc[:count]], gate)
        best, score[k, 0], score[k, 1] = _best(pairs, scores, gate)
        score[k, 2] = _agreement(best, pairs, weight[order, 0], image[arcs], gate)
        _gather(best, pairs, arcs, alike[order], gate, depth[k], support[k])
    return depth, score, support, tried


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def by_first_depth(found: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Rows of first and second depths and of their variances, of pairs in this order."""
    pairs = np.empty((4, len(order)))
    for h in range(len(order)):
        k = order[h]
        pairs[0, h], pairs[1, h] = found[k, 0], found[k, 1]
        pairs[2, h], pairs[3, h] = found[k, 2] ** 2, found[k, 3] ** 2
    return pairs


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def pair_scores(pairs: np.ndarray, order: np.ndarray, weight: np.ndarray, seen: np.ndarray, gate: float) -> np.ndarray:
    """What the other photos give to each pair; weight and photo are those of the pairs as they were before they were ordered,
    which is photo by photo: so the votes of one photo are in the fastest memory. Depths agree within `gate` standard
    deviations."""
    count = len(order)
    place = np.empty(count, dtype=np.int64)
    for h in range(count):
        place[order[h]] = h
    scores, votes, first = np.zeros(count), np.zeros(count), pairs[0]
    for k in range(count):
        if k and seen[k] != seen[k - 1]:
            scores += votes
            votes[:] = 0.0
        h = place[k]
        # A pair votes within its own standard deviation: most of them are small, and so is what they are compared with.
        reach = math.sqrt(2.0) * gate * math.sqrt(pairs[2, h])
        low, high = h, h + 1
        while low > 0 and first[low] >= first[h] - reach:
            low = max(low - STRIDE, 0)
        while high < count and first[high - 1] <= first[h] + reach:
            high = min(high + STRIDE, count)
        _vote(pairs, h, low, high, weight[k], gate, votes)
    return scores + votes


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _vote(pairs: np.ndarray, own: int, low: int, high: int, weight: float, gate: float, votes: np.ndarray) -> None:
    """Give the pairs from `low` to `high` what one of them gives, where that is more than they have.

    This is `_square` and exp(-chi-square / 4) without a branch and on slices, whose indices are never negative: so it is
    compiled to vector instructions. The exponential is the eighth power of its series, right to 1e-10 within the gate.
    """
    a, b, a_variance, b_variance = pairs[0, own], pairs[1, own], pairs[2, own], pairs[3, own]
    first, second = pairs[0][low:high], pairs[1][low:high]
    first_variance, second_variance = pairs[2][low:high], pairs[3][low:high]
    best, most = votes[low:high], gate**2
    for h in range(len(best)):
        off, other = first[h] - a, second[h] - b
        spread, wide = a_variance + first_variance[h], b_variance + second_variance[h]
        spread = spread if spread < 2.0 * a_variance else 2.0 * a_variance
        wide = wide if wide < 2.0 * b_variance else 2.0 * b_variance
        square = (off * off * wide + other * other * spread) / (spread * wide)
        x = square * (-0.25 / 8.0)
        near = 1 / 24 + x * (1 / 120 + x * (1 / 720 + x * (1 / 5040 + x * (1 / 40320))))
        near = 1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * near)))
        near = near * near
        near = near * near
        vote = weight * near * near if square <= most else 0.0
        best[h] = vote if vote > best[h] else best[h]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _square(pairs: np.ndarray, one: int, other: int) -> float:
    """Chi-square between two pairs of depths, of the variance of the other and at most as much again."""
    total = 0.0
    for end in range(2):
        variance = pairs[2 + end, other]
        variance += min(variance, pairs[2 + end, one])
        total += (pairs[end, other] - pairs[end, one]) ** 2 / variance
    return total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _best(pairs: np.ndarray, scores: np.ndarray, gate: float) -> tuple[int, float, float]:
    """Which pair of depths the other photos agree on most, its score, and that of its best rival."""
    best, rival = np.argmax(scores), 0.0
    for h in range(len(scores)):
        if scores[h] > rival and _square(pairs, best, h) > gate**2:
            rival = scores[h]
    return best, scores[best], rival


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _agreement(best: int, pairs: np.ndarray, weight: np.ndarray, seen: np.ndarray, gate: float) -> float:
    """What the other photos give to the best pair of depths, with another weight."""
    votes = np.zeros(seen.max() + 1)
    for k in range(len(weight)):
        square = _square(pairs, best, k)
        if square <= gate**2:
            votes[seen[k]] = max(votes[seen[k]], weight[k] * math.exp(-0.25 * square))
    return votes.sum()


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _gather(
    best: int, pairs: np.ndarray, arcs: np.ndarray, weight: np.ndarray, gate: float, depth: np.ndarray, support: np.ndarray
) -> None:
    """The arcs that agree with the best pair of depths, and the weighted mean of their depths."""
    sums, weights, at = np.zeros(2), np.zeros(2), 0
    for k in range(len(arcs)):
        if _square(pairs, best, k) > gate**2:
            continue
        if at < len(support):
            support[at] = arcs[k]
            at += 1
        for end in range(2):
            share = weight[k] / pairs[2 + end, k]
            sums[end] += share * pairs[end, k]
            weights[end] += share
    for end in range(2):
        depth[end] = sums[end] / weights[end]
