"""How far an arc goes: from its middle outwards while an edge goes on, then inwards to where that lies on the circle; compiled.

Both directions are one: `step` is 1 from the first sample to the last one, -1 the other way.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.options import RefitOptions

CORNER_SAMPLES = 10
"""An edge turns away at a corner within so many samples."""
_LEAST_LEFT = 5
"""Samples of an arc that are not trimmed."""


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
def last_sample(inside: np.ndarray, support: np.ndarray, steady: np.ndarray, seed: int, step: int, max_gap: float) -> int:
    """How far an arc goes from sample `seed` on.

    It goes over gaps of at most `max_gap` samples, as long as three of five are supported at its end; and, beyond the samples
    of the arc as it was (`inside`), as long as its sides differ as they did (`steady`, (m, c); none: this is not asked for).
    """
    last, gap, core = seed, 0, seed
    n = seed + step
    while 0 <= n < len(inside) and gap <= max_gap:
        if inside[n]:
            core = n
        if support[n] and (inside[n] or len(steady) == 0 or _alike(steady, n, core - 4 * step)):
            goes_on = _supported_of(5, support, n, -step) >= 3
            if goes_on:
                last = n
        else:
            # Inside the arc as it was, what lies ahead bridges a gap of any length.
            goes_on = inside[n] and _supported_of(10, support, n + step, step) >= 5
        gap = 0 if goes_on else gap + 1
        n += step
    return last


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _supported_of(samples: int, support: np.ndarray, n: int, step: int) -> int:
    """How many of so many samples from number n on are supported."""
    count = 0
    for m in range(n, n + step * samples, step):
        if 0 <= m < len(support) and support[m]:
            count += 1
    return count


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _alike(steady: np.ndarray, n: int, inner: int) -> bool:
    """Whether the sides differ in the same way as inside the arc: beyond it another edge may go on."""
    inner = min(max(inner, 0), len(steady) - 1)
    product, square = 0.0, 0.0
    for c in range(steady.shape[1]):
        product += steady[n, c] * steady[inner, c]
        square += steady[inner, c] ** 2
    return product >= 0.4 * square


@njit(cache=True, nogil=True)
@no_type_check
def reach(
    inside: np.ndarray, support: np.ndarray, difference: np.ndarray, steady: np.ndarray, max_gap: float
) -> tuple[float, float]:
    """Where an arc begins and ends, as fractions of samples; the end before the begin where nothing is left.

    It goes as far as `last_sample` says; then to where the difference between both sides (m, c) falls to half of what it is
    (`steady`) inside the arc.
    """
    seed = middle_sample(inside, support)
    if seed < 0:
        return 0.0, -1.0
    first = last_sample(inside, support, steady, seed, -1, max_gap)
    last = last_sample(inside, support, steady, seed, 1, max_gap)
    return _half_way(difference, steady, first, -1), _half_way(difference, steady, last, 1)


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _half_way(difference: np.ndarray, steady: np.ndarray, last: int, step: int) -> float:
    """Where, from six samples inside `last` to three beyond it, the contrast first falls to half of what it is inside: a place
    between two samples."""
    inner = min(max(last - 6 * step, 0), len(steady) - 1)
    before = 1.0
    n = inner + step
    while 0 <= n < len(steady) and (n - last) * step <= 3:
        value = _contrast(difference, steady, n, n - step, inner)
        if value < 0.5:
            share = (before - 0.5) / max(before - value, 1e-9)
            return n - step * (1.5 - min(max(share, 0.0), 1.0))
        before = value
        n += step
    return n - 0.5 * step


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _contrast(difference: np.ndarray, steady: np.ndarray, n: int, m: int, inner: int) -> float:
    """Half way between two samples: their mean difference along that of the sample `inside`, as a share of it."""
    value, square = 0.0, 1e-9
    for c in range(difference.shape[1]):
        square += steady[inner, c] ** 2
        value += 0.5 * (difference[n, c] + difference[m, c]) * steady[inner, c]
    return value / square


@njit(cache=True, nogil=True)
@no_type_check
def trim(residual: np.ndarray, off: np.ndarray, scale: float, options: RefitOptions) -> tuple[int, int]:
    """The first and last sample of an arc, moved inwards to where the edge lies on the circle.

    There the mean residual of the next five samples that have one is at most `max_end_px`; it is more where the end of the arc
    follows another edge nearby. And the mean of the outermost two places `off`, supported or not, is at most `max_tip_px`, or
    twice its standard deviation (`scale` is that of one place) where noise makes that more: at a corner the edge turns away
    within a few pixels.
    """
    tip_px = max(options.max_tip_px, math.sqrt(2.0) * scale)
    first, last = 0, len(off) - 1
    first = _before_corner(off, _on_circle(residual, first, last, 1, options.max_end_px), last, 1, tip_px)
    last = _before_corner(off, _on_circle(residual, last, first, -1, options.max_end_px), first, -1, tip_px)
    return first, last


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _on_circle(residual: np.ndarray, n: int, stop: int, step: int, most_px: float) -> int:
    """The first sample from number n on with a mean residual (NaN: none) of at most so much over the next five that have one."""
    while (stop - n) * step > _LEAST_LEFT:
        total, count, m = 0.0, 0, n
        while count < 5 and (stop - m) * step >= 0:
            if not math.isnan(residual[m]):
                total += residual[m]
                count += 1
            m += step
        if abs(total) <= most_px * count:
            break
        n += step
    return n


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _before_corner(off: np.ndarray, n: int, stop: int, step: int, most_px: float) -> int:
    """The first of a few samples from number n on where the mean place of it and the next one is at most so far off; n where
    there is none."""
    for m in range(n, n + step * CORNER_SAMPLES, step):
        if (stop - m) * step <= _LEAST_LEFT:
            break
        if abs(off[m] + off[m + step]) <= 2.0 * most_px:
            return m
    return n
