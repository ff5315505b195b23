"""Arcs refitted one after another, from the photo to what a refit tells of them; compiled.

What is read of an arc stays in the processor's caches, and no more of the photo is read than its edge points allow it to reach.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.kernels.bend import bend_of
from omnilines.extraction.kernels.circle import EVERY, LEFT, ROUNDS, fit_circle, own_places, scatter_of
from omnilines.extraction.kernels.profile import (
    BLURS_PX,
    OFFSETS_PX,
    along_weights,
    best_blur,
    projected,
    read_profiles,
    shifts,
    side_differences,
    side_weights,
    smoothed,
    supported,
)
from omnilines.extraction.kernels.reach import last_sample, middle_sample, reach, trim

WITHIN_PX = 0.8
"""An edge point so near to an arc, and nearly parallel to it, supports it."""
LEAST_COSINE = 0.97
"""Between an arc and an edge point that supports it: 14 degrees."""
MOST_GAP_PX = 5
MOST_SHIFT_PX = 1.5
"""Farther from an arc there is another edge."""
MOST_OFF_PX = 0.4
"""Mean distance of the last few edge places from an arc that ends there."""
LAST_OFF_PX = 0.25
"""Of the outermost two."""
BEND_PX = 0.8
"""How far the circle through one part of an arc passes from the end of the other where it bends."""
LEAST_PART = 8
"""Samples on either side of a bend."""
LEAST_CUT = 12
"""Samples cut off an arc that may be one themselves."""
LEAST_SAMPLES = 6
"""That a circle is fitted through."""
LAGS = 9
"""Distances in px for which the correlation of residuals is measured, 0 among them."""
_BEYOND = 3
"""Samples that are read beyond the last one that an arc may reach: there its contrast falls."""
_AGAIN = 2
"""Rounds of the fit in a wide window, which begins where that in the narrow one ended."""
_SIDES, _ALONG = side_weights(), along_weights()
_NOTHING = np.zeros((0, 1), dtype=np.float32)
_COLUMNS = (
    "used length_px support contrast blur_px rate low high a b wide_a wide_b m00 m01 m11 variance bend bend_ratio "
    "before_low before_high after_low after_high"
)
FIGURES = np.dtype([(name, np.float64) for name in _COLUMNS.split()])
"""Of an arc: samples used (0: it is lost); its length; the share of samples beside which there are edge points; contrast, blur
and mean rate; the angles of its ends; the change of its normal, and that in a wide window; the normal matrix, and the variance
that its inverse is to be multiplied by; where two circles explain it best, and the ratio F for it (0 where they are one
within BEND_PX); the ends of what was cut off before and after it (the low one below the high one where something was)."""


@njit(cache=True, nogil=True)
@no_type_check
def refit_arcs(
    image: np.ndarray,
    unit: float,
    number: np.ndarray,
    points: np.ndarray,
    closed: bool,
    starts: np.ndarray,
    angle: np.ndarray,
    pixel: np.ndarray,
    across: np.ndarray,
    rate: np.ndarray,
    valid: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    least_px: float,
    filters: np.ndarray,
    table: np.ndarray,
    products: np.ndarray,
) -> None:
    """Fill the FIGURES (n) of arcs with samples from starts[n] to starts[n + 1] and the ends `low` and `high` (n), and add the
    sums and numbers of products of residuals 0, 1, ... px apart (LAGS, 2).

    Arcs that do not come out at `least_px` are lost. `filters` are the `step_filters` of both windows.
    """
    longest = np.max(np.diff(starts))
    grey = np.empty((longest, image.shape[2], len(OFFSETS_PX)), dtype=np.float32)
    imaged, chosen = np.empty(longest, dtype=np.bool_), np.empty(longest, dtype=np.int64)
    room, sums = np.empty((6, longest)), np.empty((longest + 1, 6))
    for arc in range(len(low)):
        begin, end = starts[arc], starts[arc + 1]
        edge = supported(number, points, pixel[begin:end], across[begin:end], WITHIN_PX, LEAST_COSINE, closed) & valid[begin:end]
        inside = (angle[begin:end] >= low[arc]) & (angle[begin:end] <= high[arc])
        seed = middle_sample(inside, edge)
        if seed < 0:
            continue
        # What edge points allow.
        first = last_sample(inside, edge, _NOTHING, seed, -1, MOST_GAP_PX)
        last = last_sample(inside, edge, _NOTHING, seed, 1, MOST_GAP_PX)
        if last - first + 1 + 2 * _BEYOND < least_px and np.sum(inside) < least_px + LEAST_CUT:
            continue
        first, last = max(first - _BEYOND, 0), min(last + _BEYOND + 1, end - begin)
        one, size = slice(begin + first, begin + last), last - first
        read_profiles(image, unit, pixel[one], across[one], OFFSETS_PX, closed, grey[:size], imaged[:size])
        support = edge[first:last] & imaged[:size]
        found = _refit_arc(
            grey[:size],
            support,
            inside[first:last],
            angle[one],
            rate[one],
            least_px,
            filters,
            room,
            chosen,
            sums,
            table[arc : arc + 1],
            products,
        )
        if found[0] >= 0:
            _cut(edge & inside, angle[begin:end], found + first, table[arc : arc + 1])


@njit(cache=True, nogil=True)
@no_type_check
def _refit_arc(
    grey: np.ndarray,
    support: np.ndarray,
    inside: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    least_px: float,
    filters: np.ndarray,
    room: np.ndarray,
    chosen: np.ndarray,
    sums: np.ndarray,
    row: np.ndarray,
    products: np.ndarray,
) -> np.ndarray:
    """Fill a row of the figures but for what is cut off; the first and last sample, -1 where nothing is left. `room`, `chosen`
    and `sums` are room for its samples."""
    difference = side_differences(grey, _SIDES)
    found, place = np.empty(2, dtype=np.int64), np.empty(2)
    share = reach(inside, support, difference, smoothed(difference, support, _ALONG), MOST_GAP_PX, found, place)
    if found[0] < 0:
        return found
    begin, count = found[0], found[1] + 1 - found[0]
    here = slice(begin, begin + count)
    usable = support[here]
    step, strength = projected(grey[here], smoothed(difference[here], usable, _ALONG))
    blur = best_blur(step, usable, filters[0])
    shift = shifts(step, strength, filters[0, blur, 0])
    places = own_places(0, count, angle[here], rate[here], shift, strength, usable, MOST_SHIFT_PX, room, chosen)
    if places < LEAST_SAMPLES:
        return found
    a, b, scale, m00, m01, m11 = fit_circle(room, places, 0.0, 0.0, EVERY, ROUNDS)
    variance, used = scatter_of(room, places)
    if scale == 0.0 or used < LEAST_SAMPLES:
        return found
    residual, off = np.full(count, np.nan), np.empty(count)
    for i in range(places):
        residual[chosen[i]] = room[LEFT, i]
    for n in range(count):
        off[n] = shift[n] + rate[begin + n] * (a * math.cos(angle[begin + n]) + b * math.sin(angle[begin + n]))
    kept, at = np.array([0, count - 1]), place - begin
    trim(kept, at, residual, off, scale, MOST_OFF_PX, LAST_OFF_PX)
    found[0], found[1] = kept[0] + begin, kept[1] + begin
    if kept[1] - kept[0] + 1 < least_px:
        return found
    figures = row[0]
    part, ratio, apart_px = bend_of(room, places, LEAST_PART, sums)
    if apart_px > BEND_PX:
        figures.bend, figures.bend_ratio = angle[begin + chosen[part]], ratio
    figures.used, figures.length_px, figures.support, figures.variance = used, kept[1] - kept[0] + 1, share, variance
    figures.contrast, figures.blur_px = math.sqrt(np.sum(strength * usable) / used), BLURS_PX[blur]
    figures.rate = np.mean(rate)
    figures.low, figures.high = _angle_at(angle[here], at[0]), _angle_at(angle[here], at[1])
    figures.a, figures.b, figures.m00, figures.m01, figures.m11 = a, b, m00, m01, m11
    wide = shifts(step, strength, filters[1, blur, 0])
    places = own_places(0, count, angle[here], rate[here], wide, strength, usable, MOST_SHIFT_PX, room, chosen)
    if places >= LEAST_SAMPLES:
        a, b = fit_circle(room, places, a, b, scale, _AGAIN)[:2]
    figures.wide_a, figures.wide_b = a, b
    _add_products(residual, products)
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _angle_at(angle: np.ndarray, place: float) -> float:
    """At a fraction of samples; half a sample beyond the outermost ones at most."""
    below = min(max(math.floor(place), 0), len(angle) - 2)
    return angle[below] + min(max(place - below, -0.5), 1.5) * (angle[below + 1] - angle[below])


@njit(cache=True, nogil=True)
@no_type_check
def _add_products(residual: np.ndarray, products: np.ndarray) -> None:
    """Of residuals (NaN: none) so many px apart, their sums and how many there are."""
    for n in range(len(residual)):
        if math.isnan(residual[n]):
            continue
        for lag in range(min(LAGS, len(residual) - n)):
            if not math.isnan(residual[n + lag]):
                products[lag, 0] += residual[n] * residual[n + lag]
                products[lag, 1] += 1.0


@njit(cache=True, nogil=True)
@no_type_check
def _cut(edge: np.ndarray, angle: np.ndarray, found: np.ndarray, row: np.ndarray) -> None:
    """What of an arc as it was lies before and after the samples found, where that is mostly an edge and long enough."""
    outermost = np.flatnonzero(edge)
    if len(outermost) == 0:
        return
    begin, end = outermost[0], found[0] - 1
    if end - begin >= LEAST_CUT and 2 * np.sum(edge[begin : end + 1]) > end - begin:
        row[0].before_low, row[0].before_high = angle[begin], angle[end]
    begin, end = found[1] + 1, outermost[-1]
    if end - begin >= LEAST_CUT and 2 * np.sum(edge[begin : end + 1]) > end - begin:
        row[0].after_low, row[0].after_high = angle[begin], angle[end]
