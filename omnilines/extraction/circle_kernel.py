"""The great circle through the shifts measured along an arc, and how far the arc goes; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED

LEAST_SCALE_PX = 0.05
"""Of the robust weights: smaller residuals are not told apart."""
ROUNDS = 4
CORNER_SAMPLES = 10
"""An edge turns away at a corner within so many samples."""


@njit(cache=True, nogil=True)
@no_type_check
def own_samples(begin: int, end: int, shift: np.ndarray, usable: np.ndarray, most_shift_px: float) -> np.ndarray:
    """Samples of an arc that are usable and not of another edge."""
    chosen = np.empty(end - begin, dtype=np.int64)
    count = 0
    for n in range(begin, end):
        if usable[n] and abs(shift[n]) < most_shift_px:
            chosen[count] = n
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _leftover(way: np.ndarray, shift: np.ndarray, a: float, b: float, left: np.ndarray) -> None:
    """Residuals of shifts about the circle changed by (a, b), for the way (n, 2) that a point goes with either."""
    for i in range(len(shift)):
        left[i] = shift[i] - a * way[i, 0] - b * way[i, 1]


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _normal_matrix(
    way: np.ndarray, shift: np.ndarray, share: np.ndarray, a: float, b: float, scale: float, weight: np.ndarray
) -> tuple[float, float, float, float, float]:
    """Matrix (m00, m01, m11) and right side of the least squares for (a, b). Their weights are the shares times Tukey's of the
    residuals about the circle changed by (a, b) as they are."""
    m00, m01, m11, r0, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(shift)):
        x, y = way[i, 0], way[i, 1]
        ratio = (shift[i] - a * x - b * y) / (4.7 * scale)
        w = (1.0 - ratio * ratio) ** 2 * share[i] if abs(ratio) < 1.0 else 0.0
        weight[i] = w
        m00 += w * x * x
        m01 += w * x * y
        m11 += w * y * y
        r0 += w * x * shift[i]
        r1 += w * y * shift[i]
    return m00, m01, m11, r0, r1


@njit(cache=True, nogil=True)
@no_type_check
def fit_circles(
    starts: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    shift: np.ndarray,
    strength: np.ndarray,
    usable: np.ndarray,
    most_shift_px: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each arc the change (a, b) of its normal, the inverse normal matrix (2, 2), the residuals' variance that it is to be
    multiplied by, and the number of samples used; and the residuals of all samples (NaN where there is none).

    A point at angle t moves by -rate (a cos t + b sin t) px across. Weights fall with the contrast, and by Tukey's function
    with the residual; shifts of `most_shift_px` or more are another edge.
    """
    arcs = len(starts) - 1
    change, inverse, variance = np.zeros((arcs, 2)), np.zeros((arcs, 2, 2)), np.zeros(arcs)
    used = np.zeros(arcs)
    residual = np.full(len(angle), np.nan)
    for arc in range(arcs):
        chosen = own_samples(starts[arc], starts[arc + 1], shift, usable, most_shift_px)
        count = len(chosen)
        if count < 3:
            continue
        share, off = strength[chosen], shift[chosen]
        share /= share + np.median(share)
        way, left, weight = np.empty((count, 2)), np.empty(count), np.empty(count)
        for i in range(count):
            n = chosen[i]
            way[i, 0], way[i, 1] = -rate[n] * math.cos(angle[n]), -rate[n] * math.sin(angle[n])
        a, b, scale = 0.0, 0.0, 1e9
        m00, m01, m11 = 0.0, 0.0, 0.0
        for _ in range(ROUNDS):
            m00, m01, m11, r0, r1 = _normal_matrix(way, off, share, a, b, scale, weight)
            determinant = m00 * m11 - m01 * m01
            if determinant <= 1e-12 * m00 * m11:
                break
            a, b = (m11 * r0 - m01 * r1) / determinant, (m00 * r1 - m01 * r0) / determinant
            _leftover(way, off, a, b, left)
            scale = max(1.4826 * np.median(np.abs(left)), LEAST_SCALE_PX)
        determinant = m00 * m11 - m01 * m01
        if determinant <= 1e-12 * m00 * m11:
            continue
        change[arc, 0], change[arc, 1] = a, b
        inverse[arc, 0, 0], inverse[arc, 1, 1] = m11 / determinant, m00 / determinant
        inverse[arc, 0, 1] = inverse[arc, 1, 0] = -m01 / determinant
        total, squares, kept = 0.0, 0.0, 0
        for i in range(count):
            residual[chosen[i]] = left[i]
            if weight[i] > 0.0:
                total += weight[i]
                squares += (weight[i] * left[i]) ** 2
                kept += 1
        # Sum of w^2 r^2 over sum of w: the variance that the inverse of sum w x x' is to be multiplied by, for residuals
        # whose variance is not 1 / w.
        variance[arc] = squares / total * kept / max(kept - 2, 1)
        used[arc] = kept
    return change, inverse, variance, used, residual


@njit(cache=True, nogil=True)
@no_type_check
def reach(
    starts: np.ndarray,
    inside: np.ndarray,
    support: np.ndarray,
    difference: np.ndarray,
    steady: np.ndarray,
    most_gap: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and last sample of each arc (n, 2), -1 where nothing is left; where it ends, as fractions of samples (n, 2); and the
    share of supported samples between.

    `inside` tells the samples of the arc as it was. From its middle supported sample it goes outwards over gaps of at most
    `most_gap` samples, as long as three of five are supported at its end; then to where the difference between both sides
    (m, c) falls to half of what it is (`steady`) inside the arc.
    """
    arcs = len(starts) - 1
    found, place, share = np.full((arcs, 2), -1, dtype=np.int64), np.zeros((arcs, 2)), np.zeros(arcs)
    for arc in range(arcs):
        begin, end = starts[arc], starts[arc + 1]
        total = 0
        for n in range(begin, end):
            if inside[n] and support[n]:
                total += 1
        if total == 0:
            continue
        seen, seed = 0, -1
        for n in range(begin, end):
            if inside[n] and support[n]:
                seen += 1
                if 2 * seen >= total:
                    seed = n
                    break
        for side in range(2):
            step = 1 if side == 1 else -1
            last, gap, core = seed, 0, seed
            n = seed + step
            while begin <= n < end and gap <= most_gap:
                if inside[n]:
                    core = n
                if support[n] and (inside[n] or _alike(steady, n, core - 4 * step, begin, end)):
                    near = 0
                    for m in range(5):
                        if begin <= n - step * m < end and support[n - step * m]:
                            near += 1
                    # Inside the arc as it was, a single supported sample leads on; beyond it a run does.
                    if near >= 3:
                        last, gap = n, 0
                    else:
                        gap += 1
                elif inside[n] and _goes_on(support, n, step, begin, end):
                    gap = 0
                else:
                    gap += 1
                n += step
            place[arc, side] = _half_way(difference, steady, last, step, begin, end)
        if place[arc, 1] <= place[arc, 0] + 1.0:
            continue
        # Samples whose middle lies in the arc.
        found[arc, 0], found[arc, 1] = math.ceil(place[arc, 0]), math.floor(place[arc, 1])
        total = 0
        for n in range(found[arc, 0], found[arc, 1] + 1):
            if support[n]:
                total += 1
        share[arc] = total / (found[arc, 1] - found[arc, 0] + 1)
    return found, place, share


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _goes_on(support: np.ndarray, n: int, step: int, begin: int, end: int) -> bool:
    """Whether most of the next ten samples are supported."""
    count = 0
    for m in range(1, 11):
        if begin <= n + step * m < end and support[n + step * m]:
            count += 1
    return count >= 5


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _alike(steady: np.ndarray, n: int, inner: int, begin: int, end: int) -> bool:
    """Whether the sides differ in the same way as inside the arc: beyond it another edge may go on."""
    inner = min(max(inner, begin), end - 1)
    product, square = 0.0, 0.0
    for c in range(steady.shape[1]):
        product += steady[n, c] * steady[inner, c]
        square += steady[inner, c] ** 2
    return product >= 0.4 * square


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _half_way(difference: np.ndarray, steady: np.ndarray, last: int, step: int, begin: int, end: int) -> float:
    """Where, from six samples inside `last` to three beyond it, the contrast first falls to half of what it is inside: a place
    between two samples."""
    inner = min(max(last - 6 * step, begin), end - 1)
    square = 1e-9
    for c in range(difference.shape[1]):
        square += steady[inner, c] ** 2
    before = 1.0
    n = inner + step
    while begin <= n < end and (n - last) * step <= 3:
        value = 0.0
        # The mean of two samples is the contrast half a sample back.
        for c in range(difference.shape[1]):
            value += 0.5 * (difference[n, c] + difference[n - step, c]) * steady[inner, c]
        value /= square
        if value < 0.5:
            share = (before - 0.5) / max(before - value, 1e-9)
            return n - step * (1.5 - min(max(share, 0.0), 1.0))
        before = value
        n += step
    return n - 0.5 * step


@njit(cache=True, nogil=True)
@no_type_check
def trim(found: np.ndarray, place: np.ndarray, residual: np.ndarray, off: np.ndarray, most_px: float, last_px: float) -> None:
    """Move the first and last sample (n, 2) of each arc, and where it ends, inwards to where the edge lies on the circle.

    There the mean residual of the next five samples that have one is at most `most_px`; it is more where the end of the arc
    follows another edge nearby. And the mean of the outermost two places `off`, supported or not, is at most `last_px`, or twice
    its standard deviation where noise makes that more: at a corner the edge turns away within a few pixels.
    """
    for arc in range(len(found)):
        if found[arc, 0] < 0:
            continue
        known = residual[found[arc, 0] : found[arc, 1] + 1]
        known = np.abs(known[~np.isnan(known)])
        scatter = 1.4826 * np.median(known) if len(known) else 0.0
        last = max(last_px, math.sqrt(2.0) * scatter)
        for side in range(2):
            step = 1 if side == 0 else -1
            n, stop = found[arc, side], found[arc, 1 - side]
            while (stop - n) * step > 5:
                total, count, m = 0.0, 0, n
                while count < 5 and (stop - m) * step >= 0:
                    if not math.isnan(residual[m]):
                        total += residual[m]
                        count += 1
                    m += step
                if count == 0 or abs(total) <= most_px * count:
                    break
                n += step
            for m in range(n, n + step * CORNER_SAMPLES, step):
                if (stop - m) * step <= 5:
                    break
                if abs(off[m] + off[m + step]) <= 2.0 * last:
                    n = m
                    break
            if n != found[arc, side]:
                found[arc, side], place[arc, side] = n, n - 0.5 * step
