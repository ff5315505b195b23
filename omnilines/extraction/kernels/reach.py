"""How far an arc goes: from its middle outwards while an edge goes on, then inwards to where that lies on the circle; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED

CORNER_SAMPLES = 10
"""An edge turns away at a corner within so many samples."""


@njit(cache=True, nogil=True)
@no_type_check
def middle_sample(inside: np.ndarray, support: np.ndarray) -> int:
    """The middle one of the supported samples of an arc as it was, -1 where there is none."""
    total, seen = 0, 0
    for n in range(len(inside)):
        total += inside[n] and support[n]
    for n in range(len(inside)):
        seen += inside[n] and support[n]
        if 2 * seen >= total and total > 0:
            return n
    return -1


@njit(cache=True, nogil=True)
@no_type_check
def last_sample(inside: np.ndarray, support: np.ndarray, steady: np.ndarray, seed: int, step: int, most_gap: int) -> int:
    """How far an arc goes from sample `seed` on, forwards or backwards (`step`).

    It goes over gaps of at most `most_gap` samples, as long as three of five are supported at its end; and, beyond the samples
    of the arc as it was (`inside`), as long as its sides differ as they did (`steady`, (m, c); none: this is not asked for).
    """
    begin, end = 0, len(inside)
    last, gap, core = seed, 0, seed
    n = seed + step
    while begin <= n < end and gap <= most_gap:
        if inside[n]:
            core = n
        if support[n] and (inside[n] or len(steady) == 0 or _alike(steady, n, core - 4 * step, begin, end)):
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
    return last


@njit(cache=True, nogil=True)
@no_type_check
def reach(
    inside: np.ndarray,
    support: np.ndarray,
    difference: np.ndarray,
    steady: np.ndarray,
    most_gap: int,
    found: np.ndarray,
    place: np.ndarray,
) -> float:
    """Fill the first and last sample of an arc, -1 where nothing is left, and where it ends, as fractions of samples; the share
    of supported samples between.

    It goes as far as `last_sample` says; then to where the difference between both sides (m, c) falls to half of what it is
    (`steady`) inside the arc.
    """
    found[:] = -1
    seed = middle_sample(inside, support)
    if seed < 0:
        return 0.0
    for side in range(2):
        step = 1 if side == 1 else -1
        last = last_sample(inside, support, steady, seed, step, most_gap)
        place[side] = _half_way(difference, steady, last, step, 0, len(inside))
    if place[1] <= place[0] + 1.0:
        return 0.0
    # Samples whose middle lies in the arc.
    found[0], found[1] = math.ceil(place[0]), math.floor(place[1])
    return np.sum(support[found[0] : found[1] + 1]) / (found[1] - found[0] + 1)


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
def trim(
    found: np.ndarray, place: np.ndarray, residual: np.ndarray, off: np.ndarray, scale: float, most_px: float, last_px: float
) -> None:
    """Move the first and last sample of an arc, and where it ends, inwards to where the edge lies on the circle.

    There the mean residual of the next five samples that have one is at most `most_px`; it is more where the end of the arc
    follows another edge nearby. And the mean of the outermost two places `off`, supported or not, is at most `last_px`, or
    twice its standard deviation (`scale` is that of one place) where noise makes that more: at a corner the edge turns away
    within a few pixels.
    """
    last = max(last_px, math.sqrt(2.0) * scale)
    for side in range(2):
        step = 1 if side == 0 else -1
        n, stop = found[side], found[1 - side]
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
        if n != found[side]:
            found[side], place[side] = n, n - 0.5 * step
