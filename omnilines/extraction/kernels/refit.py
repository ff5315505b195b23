"""Arcs refitted one after another, from the photo to what a refit tells of them; compiled.

What is read of an arc stays in the processor's caches, and no more of the photo is read than its edge points allow it to reach.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numba import njit

from omnilines.extraction.kernels.bend import bend_of
from omnilines.extraction.kernels.chroma import chroma_noise
from omnilines.extraction.kernels.circle import EVERY, LEFT, ROUNDS, fill_ways, fit_circle, own_places, scatter_of
from omnilines.extraction.kernels.profile import (
    BLURS_PX,
    OFFSETS_PX,
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
from omnilines.extraction.kernels.tables import Edgels, Picture, Places, Samples
from omnilines.extraction.options import RefitOptions, SupportOptions

LEAST_PART = 8
"""Samples on either side of a bend."""
LEAST_SAMPLES = 6
"""That a circle is fitted through."""
LAGS = 9
"""Distances in px for which the correlation of residuals is measured, 0 among them."""
_BEYOND = 3
"""Samples that are read beyond the last one that an arc may reach: there its contrast falls."""
_AGAIN = 2
"""Rounds of the fit in a wide window, which begins where that in the narrow one ended."""
_SIDES = side_weights()
_NOTHING = np.zeros((0, 1), dtype=np.float32)
_COLUMNS = (
    "used length_px support contrast blur_px rate low high a b wide_a wide_b m00 m01 m11 variance bend bend_ratio "
    "before_low before_high after_low after_high chroma_share chroma_sum chroma_squares squares"
)
FIGURES = np.dtype([(name, np.float64) for name in _COLUMNS.split()])
"""Of an arc: samples used (0: it is lost); its length; the share of samples beside which there are edge points; contrast, blur
and mean rate; the angles of its ends; the change of its normal, and that in a wide window; the normal matrix, and the variance
that its inverse is to be multiplied by; where two circles explain it best, and the ratio F for it (0 where they are one within
`SupportOptions.within_px`); the ends of what was cut off before and after it (the low one below the high one where something
was); what `chroma_noise` says of it."""


class Limits(NamedTuple):
    """What a refit asks for."""

    min_px: float
    """Shorter arcs are lost."""
    min_cut_px: float
    """What is cut off an arc and is shorter is lost."""
    support: SupportOptions
    fit: RefitOptions


class Filters(NamedTuple):
    """Weights of a refit."""

    windows: Float32[np.ndarray, "2 b 4 k"]
    """The `step_filters` of the narrow and the wide window."""
    along: Float32[np.ndarray, " l"]
    """The `along_weights`."""


class Seen(NamedTuple):
    """Samples of one arc: whether edge points support them, whether they are of the arc as it was, angle and rate."""

    support: Bool[np.ndarray, " m"]
    inside: Bool[np.ndarray, " m"]
    angle: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]


class Room(NamedTuple):
    """Room for what is made of one arc, used again for the next."""

    places: Float[np.ndarray, "6 m"]
    """As `circle.py` has it."""
    ways: Float[np.ndarray, "2 m"]
    chosen: Int[np.ndarray, " m"]
    sums: Float[np.ndarray, "m1 6"]


@njit(cache=True, nogil=True)
@no_type_check
def refit_arcs(
    picture: Picture,
    edgels: Edgels,
    at: Samples,
    ends: np.ndarray,
    limits: Limits,
    filters: Filters,
    table: np.ndarray,
    products: np.ndarray,
) -> None:
    """Fill the FIGURES (n) of arcs with the samples `at` and the ends (n, 2), and add the sums and numbers of products of
    residuals 0, 1, ... px apart (LAGS, 2)."""
    longest = np.max(np.diff(at.starts))
    grey = np.empty((longest, picture.image.shape[2], len(OFFSETS_PX)), dtype=np.float32)
    imaged = np.empty(longest, dtype=np.bool_)
    room = Room(np.empty((6, longest)), np.empty((2, longest)), np.empty(longest, dtype=np.int64), np.empty((longest + 1, 6)))
    most_gap = limits.support.max_blind_px
    for arc in range(len(ends)):
        begin, end = at.starts[arc], at.starts[arc + 1]
        angle = at.angle[begin:end]
        edge = supported(edgels, at.pixel[begin:end], at.across[begin:end], limits.support) & at.valid[begin:end]
        inside = (angle >= ends[arc, 0]) & (angle <= ends[arc, 1])
        seed = middle_sample(inside, edge)
        if seed < 0:
            continue
        # What edge points allow.
        first = last_sample(inside, edge, _NOTHING, seed, -1, most_gap)
        last = last_sample(inside, edge, _NOTHING, seed, 1, most_gap)
        if last - first + 1 + 2 * _BEYOND < limits.min_px and np.sum(inside) < limits.min_px + limits.min_cut_px:
            continue
        first, last = max(first - _BEYOND, 0), min(last + _BEYOND + 1, end - begin)
        one, size = slice(begin + first, begin + last), last - first
        read_profiles(picture, at.pixel[one], at.across[one], OFFSETS_PX, grey[:size], imaged[:size])
        seen = Seen(edge[first:last] & imaged[:size], inside[first:last], at.angle[one], at.rate[one])
        low, high = _refit_arc(grey[:size], seen, limits, filters, room, table[arc : arc + 1], products)
        if low >= 0:
            _cut(edge & inside, angle, low + first, high + first, limits.min_cut_px, table[arc : arc + 1])


@njit(cache=True, nogil=True)
@no_type_check
def _refit_arc(
    grey: np.ndarray, seen: Seen, limits: Limits, filters: Filters, room: Room, row: np.ndarray, products: np.ndarray
) -> tuple[int, int]:
    """Fill a row of the figures but for what is cut off; the first and last sample, -1 where nothing is left."""
    difference = side_differences(grey, _SIDES)
    steady = smoothed(difference, seen.support, filters.along)
    low, high = reach(seen.inside, seen.support, difference, steady, limits.support.max_blind_px)
    if high <= low + 1.0:
        return -1, -1
    # Samples whose middle lies in the arc.
    begin, last = math.ceil(low), math.floor(high)
    here, count = slice(begin, last + 1), last + 1 - begin
    angle, rate, usable = seen.angle[here], seen.rate[here], seen.support[here]
    steady = smoothed(difference[here], usable, filters.along)
    step, strength = projected(grey[here], steady)
    blur = best_blur(step, usable, filters.windows[0])
    shift = shifts(step, strength, filters.windows[0, blur, 0])
    most_px = limits.fit.max_shift_px
    ways, chosen = room.ways, room.chosen
    fill_ways(angle, rate, ways)
    places = own_places(Places(angle, rate, shift, strength, usable), ways, 0, count, most_px, room.places, chosen)
    if places < LEAST_SAMPLES:
        return begin, last
    a, b, scale, m00, m01, m11 = fit_circle(room.places, places, 0.0, 0.0, EVERY, ROUNDS)
    variance, used = scatter_of(room.places, places)
    if scale == 0.0 or used < LEAST_SAMPLES:
        return begin, last
    residual, off = np.full(count, np.nan), np.empty(count)
    for i in range(places):
        residual[chosen[i]] = room.places[LEFT, i]
    for n in range(count):
        off[n] = shift[n] - a * ways[0, n] - b * ways[1, n]
    begins, ends = trim(residual, off, scale, limits.fit)
    if ends - begins + 1 < limits.min_px:
        return begin + begins, begin + ends
    share = np.mean(usable[begins : ends + 1])
    figures, filter_row = row[0], filters.windows[0, blur, 0]
    figures.chroma_share, figures.chroma_sum, figures.chroma_squares, figures.squares = chroma_noise(
        grey[here], steady, filter_row, room.places, chosen, places
    )
    part, ratio, apart_px = bend_of(room.places, places, LEAST_PART, room.sums)
    if apart_px > limits.support.within_px:
        figures.bend, figures.bend_ratio = angle[chosen[part]], ratio
    figures.used, figures.length_px, figures.support, figures.variance = used, ends - begins + 1, share, variance
    figures.contrast, figures.blur_px = math.sqrt(np.sum(strength * usable) / used), BLURS_PX[blur]
    figures.rate = np.mean(seen.rate)
    figures.low = _angle_at(angle, low - begin if begins == 0 else begins - 0.5)
    figures.high = _angle_at(angle, high - begin if ends == count - 1 else ends + 0.5)
    figures.a, figures.b, figures.m00, figures.m01, figures.m11 = a, b, m00, m01, m11
    wide = shifts(step, strength, filters.windows[1, blur, 0])
    places = own_places(Places(angle, rate, wide, strength, usable), ways, 0, count, most_px, room.places, chosen)
    if places >= LEAST_SAMPLES:
        a, b = fit_circle(room.places, places, a, b, scale, _AGAIN)[:2]
    figures.wide_a, figures.wide_b = a, b
    _add_products(residual, products)
    return begin + begins, begin + ends


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
def _cut(edge: np.ndarray, angle: np.ndarray, first: int, last: int, least: float, row: np.ndarray) -> None:
    """What of an arc as it was lies before and after the samples found, where that is mostly an edge and long enough."""
    outermost = np.flatnonzero(edge)
    if len(outermost) == 0:
        return
    begin, end = outermost[0], first - 1
    if end - begin >= least and 2 * np.sum(edge[begin : end + 1]) > end - begin:
        row[0].before_low, row[0].before_high = angle[begin], angle[end]
    begin, end = last + 1, outermost[-1]
    if end - begin >= least and 2 * np.sum(edge[begin : end + 1]) > end - begin:
        row[0].after_low, row[0].after_high = angle[begin], angle[end]
