"""For every arc the 3D line that other photos agree on, compiled.

An arc fixes the plane of its line; what is open are the depths at its two ends. Every arc of another photo that could show the
same line gives a pair of depths: where its plane cuts the rays of both ends. True partners give one pair of depths again and
again; the others scatter. `no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.matching.epipolar_kernel import arcs_across, arcs_by_angle

LEAST_OVERLAP = 0.25
"""Of the shorter of two stretches of the line, seen in two photos."""
MOST_SIGMA = 0.3
"""Largest standard deviation of an inverse depth, as a share of it: farther lines, and baselines along the plane, say nothing."""
GATE = 3.0
"""Standard deviations within which two depths agree."""
COLOUR_SIGMA, GAIN_SIGMA = 0.12, 0.25
"""Of the logarithm of a colour beside one edge in two photos, and of a gain common to all of them."""
ONE_SIDE = 3.0
"""Added to chi-square where only one side looks the same: the other may be seen through to something else."""
LEAST_LIKENESS = 0.05


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def likeness(first: np.ndarray, second: np.ndarray, flipped: bool) -> float:
    """exp(-chi-square / 2) per degree of freedom of the colours (side, channel) of two arcs, in (0, 1]; 0.3 if unknown.

    With differences x of n logarithms, each of variance s^2 but for a common gain of variance t^2, chi-square is
    (sum x^2 - t^2 (sum x)^2 / (s^2 + n t^2)) / s^2.
    """
    noise, gain = COLOUR_SIGMA**2, GAIN_SIGMA**2
    total, square, best, known = 0.0, 0.0, np.inf, 0
    for side in range(2):
        other = 1 - side if flipped else side
        own_total, own_square = 0.0, 0.0
        for channel in range(3):
            x = first[side, channel] - second[other, channel]
            own_total += x
            own_square += x * x
        if math.isnan(own_total):
            continue
        known += 1
        total += own_total
        square += own_square
        one = (own_square - gain * own_total**2 / (noise + 3 * gain)) / noise
        best = min(best, one / 3 + ONE_SIDE)
    if known == 0:
        return 0.3
    if known == 2:
        best = min(best, (square - gain * total**2 / (noise + 6 * gain)) / noise / 6)
    else:
        best -= 0.5 * ONE_SIDE
    return math.exp(-0.5 * best)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cross_variance(x: float, y: float, cosine: float, sine: float, first: float, second: float) -> float:
    """Variance across an arc, at the point (x, y) of its plane, of the circle through two ends with standard deviations (rad).

    One end lies at (1, 0), the other at (cosine, sine). At the angle t and the distance r the circle moves by
    r (sin(span - t) first + sin(t) second) / sin(span).
    """
    return ((sine * x - cosine * y) ** 2 * first**2 + y * y * second**2) / max(sine * sine, 1e-18)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
@no_type_check
def depths(i: int, j: int, packed: np.ndarray, out: np.ndarray) -> bool:
    """The line of arcs i and j: inverse depths at both ends of i and their standard deviations into `out`; false if none.

    A row of `packed` holds both end bearings, normal and centre (world) and the standard deviations of both ends across the arc.
    With m the normal of plane j and b from the centre of i to that of j, the ray V meets the plane at 1 / u, u = m.V / m.b.
    out[4] is 1 where the direction of j along the line is against that of i.
    """
    p, q = packed[i], packed[j]
    bx, by, bz = q[9] - p[9], q[10] - p[10], q[11] - p[11]
    nb = p[6] * bx + p[7] * by + p[8] * bz
    n1 = p[6] * q[0] + p[7] * q[1] + p[8] * q[2]
    n2 = p[6] * q[3] + p[7] * q[4] + p[8] * q[5]
    # The rays of j meet plane i before their camera: n . (b + depth w) = 0.
    if nb * n1 >= 0.0 or nb * n2 >= 0.0:
        return False
    mb = q[6] * bx + q[7] * by + q[8] * bz
    m1 = q[6] * p[0] + q[7] * p[1] + q[8] * p[2]
    m2 = q[6] * p[3] + q[7] * p[4] + q[8] * p[5]
    if mb * m1 <= 0.0 or mb * m2 <= 0.0:
        return False
    near1, near2, far1, far2 = mb / m1, mb / m2, -nb / n1, -nb / n2
    # The line is (near1 V1, near2 V2), seen from centre i.
    x, y, z = p[0] * near1, p[1] * near1, p[2] * near1
    dx, dy, dz = p[3] * near2 - x, p[4] * near2 - y, p[5] * near2 - z
    low = (bx + far1 * q[0] - x) * dx + (by + far1 * q[1] - y) * dy + (bz + far1 * q[2] - z) * dz
    high = (bx + far2 * q[3] - x) * dx + (by + far2 * q[4] - y) * dy + (bz + far2 * q[5] - z) * dz
    length = dx * dx + dy * dy + dz * dz
    flipped = high < low
    if flipped:
        low, high = high, low
    if min(high, length) - max(low, 0.0) < LEAST_OVERLAP * min(high - low, length):
        return False
    out[0], out[1] = m1 / mb, m2 / mb
    out[4] = 1.0 if flipped else 0.0
    return _depth_sigmas(p, q, bx, by, bz, mb, out)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
@no_type_check
def _depth_sigmas(p: np.ndarray, q: np.ndarray, bx: float, by: float, bz: float, mb: float, out: np.ndarray) -> bool:
    """Standard deviations of the inverse depths in `out`; false where they say nothing.

    du = dm . (V - u b) / m.b, and V - u b points from centre j to the point that is seen, in the plane of j.
    """
    mn = p[6] * q[6] + p[7] * q[7] + p[8] * q[8]
    fx, fy, fz = q[7] * q[2] - q[8] * q[1], q[8] * q[0] - q[6] * q[2], q[6] * q[1] - q[7] * q[0]
    cosine, sine = q[3] * q[0] + q[4] * q[1] + q[5] * q[2], q[3] * fx + q[4] * fy + q[5] * fz
    for end in range(2):
        u = out[end]
        x, y, z = p[3 * end] - u * bx, p[3 * end + 1] - u * by, p[3 * end + 2] - u * bz
        ahead, beside = x * q[0] + y * q[1] + z * q[2], x * fx + y * fy + z * fz
        variance = cross_variance(ahead, beside, cosine, sine, q[12], q[13]) + (mn * p[12 + end]) ** 2
        if variance > (MOST_SIGMA * u * mb) ** 2:
            return False
        out[2 + end] = math.sqrt(variance) / abs(mb)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def partners(
    i: int,
    others: np.ndarray,
    packed: np.ndarray,
    colours: np.ndarray,
    arc: np.ndarray,
    found: np.ndarray,
    weight: np.ndarray,
) -> int:
    """Those of the others that could show the line of arc i, with depths and likeness; how many."""
    count = 0
    out = np.empty(5)
    for j in others:
        if not depths(i, j, packed, out):
            continue
        alike = likeness(colours[i], colours[j], out[4] > 0.5)
        if alike < LEAST_LIKENESS:
            continue
        arc[count], weight[count] = j, alike
        for k in range(4):
            found[count, k] = out[k]
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _square(one: np.ndarray, at: int, other: np.ndarray, k: int) -> float:
    """Chi-square between two pairs of depths, of the variance of the other and at most as much again; infinite beyond GATE."""
    total = 0.0
    for end in range(2):
        variance = other[k, 2 + end] ** 2
        variance += min(variance, one[at, 2 + end] ** 2)
        total += (other[k, end] - one[at, end]) ** 2 / variance
        if total > GATE**2:
            return np.inf
    return total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _best(found: np.ndarray, weight: np.ndarray, seen: np.ndarray, images: int) -> tuple[int, float, float]:
    """Which pair of depths, sorted by the first, the other photos agree on most, its score, and that of its best rival."""
    count = len(found)
    first, second = found[:, 0].copy(), found[:, 1].copy()
    first_variance, second_variance = found[:, 2] ** 2, found[:, 3] ** 2
    column, photos = np.full(images, -1, dtype=np.int64), 0
    for photo in seen:
        if column[photo] < 0:
            column[photo] = photos
            photos += 1
    votes = np.zeros((photos, count))
    for k in range(count):
        # A pair votes within its own standard deviation: most of them are small, and so is what they are compared with. This is
        # `_square`, written out where it is asked most often.
        reach, own = math.sqrt(2.0) * GATE * found[k, 2], votes[column[seen[k]]]
        for h in range(np.searchsorted(first, first[k] - reach), count):
            off = first[h] - first[k]
            if off > reach:
                break
            spread = first_variance[k] + min(first_variance[k], first_variance[h])
            if off * off > GATE**2 * spread:
                continue
            other = second[h] - second[k]
            wide = second_variance[k] + min(second_variance[k], second_variance[h])
            square = off * off / spread + other * other / wide
            if square <= GATE**2:
                own[h] = max(own[h], weight[k] * math.exp(-0.25 * square))
    best, score = -1, 0.0
    scores = votes.sum(0)
    for h in range(count):
        if scores[h] > score:
            score, best = scores[h], h
    rival = 0.0
    for h in range(len(found)):
        if best >= 0 and scores[h] > rival and _square(found, best, found, h) == np.inf:
            rival = scores[h]
    return best, score, rival


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def best_lines(
    rows: np.ndarray,
    image: np.ndarray,
    starts: np.ndarray,
    neighbours: np.ndarray,
    packed: np.ndarray,
    colours: np.ndarray,
    most: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each arc of `rows`: inverse depths at both ends, score and best rival, up to `most` supporters, candidates.

    The score of a pair of depths is the sum over the other photos of the best likeness times exp(-chi-square / 4).
    """
    total = len(image)
    depth, score = np.full((len(rows), 2), np.nan), np.zeros((len(rows), 2))
    support, tried = np.full((len(rows), most), -1, dtype=np.int32), np.zeros(len(rows), dtype=np.int64)
    arc, found, weight = np.empty(total, dtype=np.int64), np.empty((total, 4)), np.empty(total)
    others, seen, photo = np.empty(total, dtype=np.int64), np.full(total, -1, dtype=np.int64), -1
    for k in range(len(rows)):
        if image[rows[k]] != photo:
            photo = image[rows[k]]
            frames, begin, members = arcs_by_angle(photo, np.flatnonzero(neighbours[photo]), starts, packed)
        across = others[: arcs_across(packed[rows[k]], frames, begin, members, k, seen, others)]
        count = partners(rows[k], across, packed, colours, arc, found, weight)
        tried[k] = count
        if not count:
            continue
        order = np.argsort(found[:count, 0])
        arcs, pairs, weights = arc[order], found[order], weight[order]
        best, score[k, 0], score[k, 1] = _best(pairs, weights, image[arcs], len(neighbours))
        if best >= 0:
            _gather(best, arcs, pairs, weights, depth[k], support[k])
    return depth, score, support, tried


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _gather(best: int, arcs: np.ndarray, found: np.ndarray, weight: np.ndarray, depth: np.ndarray, support: np.ndarray) -> None:
    """The arcs that agree with the best pair of depths, and the weighted mean of their depths."""
    sums, weights, at = np.zeros(2), np.zeros(2), 0
    for k in range(len(arcs)):
        if _square(found, best, found, k) == np.inf:
            continue
        if at < len(support):
            support[at] = arcs[k]
            at += 1
        for end in range(2):
            share = weight[k] / found[k, 2 + end] ** 2
            sums[end] += share * found[k, end]
            weights[end] += share
    for end in range(2):
        depth[end] = sums[end] / weights[end]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def likenesses(first: np.ndarray, second: np.ndarray, one: np.ndarray, other: np.ndarray, flipped: np.ndarray) -> np.ndarray:
    """`likeness` of rows of two tables of colours."""
    found = np.empty(len(one))
    for k in range(len(one)):
        found[k] = likeness(first[one[k]], second[other[k]], flipped[k])
    return found
