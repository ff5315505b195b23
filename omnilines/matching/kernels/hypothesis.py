"""Which arcs of other photos could show the line of an arc, and at what depths, compiled.

An arc fixes the plane of its line; what is open are the depths at its two ends. Every arc of another photo that could show the
same line gives a pair of depths: where its plane cuts the rays of both ends. `no_type_check` keeps the type checker of the tests
from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.matching.options import HypothesisOptions, LikenessOptions

LEAST_SQUARE_SINE = 1e-9
"""Of the angle between a line and a ray along it."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def likeness(first: np.ndarray, second: np.ndarray, flipped: bool, options: LikenessOptions) -> float:
    """exp(-chi-square / 2) per degree of freedom of the colours (side, channel) of two arcs, in (0, 1]; 0.3 if unknown.

    With differences x of n logarithms, each of variance s^2 but for a common gain of variance t^2, chi-square is
    (sum x^2 - t^2 (sum x)^2 / (s^2 + n t^2)) / s^2.
    """
    noise, gain = options.colour_sigma**2, options.gain_sigma**2
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
        best = min(best, one / 3 + options.one_side_chi_square)
    if known == 0:
        return 0.3
    if known == 2:
        best = min(best, (square - gain * total**2 / (noise + 6 * gain)) / noise / 6)
    else:
        best -= 0.5 * options.one_side_chi_square
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
def depths(i: int, j: int, packed: np.ndarray, options: HypothesisOptions, out: np.ndarray) -> bool:
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
    if min(high, length) - max(low, 0.0) < options.min_overlap_share * min(high - low, length):
        return False
    out[0], out[1] = m1 / mb, m2 / mb
    out[4] = 1.0 if flipped else 0.0
    return _depth_sigmas(p, q, bx, by, bz, mb, options.max_depth_sigma_share, out)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
@no_type_check
def _depth_sigmas(p: np.ndarray, q: np.ndarray, bx: float, by: float, bz: float, mb: float, most: float, out: np.ndarray) -> bool:
    """Standard deviations of the inverse depths in `out`; false where they are above `most` of them.

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
        if variance > (most * u * mb) ** 2:
            return False
        out[2 + end] = math.sqrt(variance) / abs(mb)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def ends_alike(i: int, j: int, packed: np.ndarray, px_rad: np.ndarray, found: np.ndarray, options: LikenessOptions) -> float:
    """How well arcs i and j, which show one line at the depths `found` of `depths`, end at the same places of it, in (0, 1].

    Each end counts s + (1 - s) / (1 + x^2), with s = `other_end`: what stands before a line ends it elsewhere in another photo.
    x is the distance from the end of the other arc along the line, in standard deviations of both: a pixel along each arc.
    """
    p, q, flipped = packed[i], packed[j], found[4] > 0.5
    near1, near2 = 1.0 / found[0], 1.0 / found[1]
    dx, dy, dz = p[3] * near2 - p[0] * near1, p[4] * near2 - p[1] * near1, p[5] * near2 - p[2] * near1
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    bx, by, bz = q[9] - p[9], q[10] - p[10], q[11] - p[11]
    nb = p[6] * bx + p[7] * by + p[8] * bz
    alike = 1.0
    for end in range(2):
        v, w = p[3 * end : 3 * end + 3], q[3:6] if flipped == (end == 0) else q[0:3]
        near, far = 1.0 / found[end], -nb / (p[6] * w[0] + p[7] * w[1] + p[8] * w[2])
        v_along, w_along = v[0] * dx + v[1] * dy + v[2] * dz, w[0] * dx + w[1] * dy + w[2] * dz
        off = bx * dx + by * dy + bz * dz + far * w_along - near * v_along
        # A pixel moves the point that a ray meets on the line by its distance over the sine of the angle between both.
        variance = (near * px_rad[i]) ** 2 / max(1.0 - v_along * v_along, LEAST_SQUARE_SINE)
        variance += (far * px_rad[j]) ** 2 / max(1.0 - w_along * w_along, LEAST_SQUARE_SINE)
        alike *= options.other_end + (1.0 - options.other_end) / (1.0 + off * off / variance)
    return alike


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def partners(
    i: int,
    others: np.ndarray,
    packed: np.ndarray,
    px_rad: np.ndarray,
    colours: np.ndarray,
    options: HypothesisOptions,
    looks: LikenessOptions,
    arc: np.ndarray,
    found: np.ndarray,
    weight: np.ndarray,
) -> int:
    """Those of the others that could show the line of arc i, with depths and, in columns of `weight`, the likeness of colours and
    that of colours and ends; how many."""
    count = 0
    out = np.empty(5)
    for j in others:
        if not depths(i, j, packed, options, out):
            continue
        alike = likeness(colours[i], colours[j], out[4] > 0.5, looks)
        if alike < looks.min_likeness:
            continue
        arc[count], weight[count, 0] = j, alike
        weight[count, 1] = alike * ends_alike(i, j, packed, px_rad, out, looks)
        for k in range(4):
            found[count, k] = out[k]
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def likenesses(
    first: np.ndarray, second: np.ndarray, one: np.ndarray, other: np.ndarray, flipped: np.ndarray, options: LikenessOptions
) -> np.ndarray:
    """`likeness` of rows of two tables of colours."""
    found = np.empty(len(one))
    for k in range(len(one)):
        found[k] = likeness(first[one[k]], second[other[k]], flipped[k], options)
    return found
