"""Where a line begins and ends, from the stretches of it that photos show, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.structure.options import ClippingOptions

SETTLING = 4
"""Times that the ends around a mean are averaged anew; each takes off three quarters of what the mean is out."""


@njit(cache=True, nogil=True)
@no_type_check
def covered(low: np.ndarray, high: np.ndarray, sigma: np.ndarray, image: np.ndarray, options: ClippingOptions) -> np.ndarray:
    """Stretches (k, 2) that enough photos show, gaps shorter than some standard deviations left out of account.

    A photo that shows the line before a place and beyond it, but not there, says that it has a gap, unless something hides it.
    Where more photos say so than show it, there is one.
    """
    count = len(low)
    places = np.concatenate((low, high))
    photos = image.max() + 1
    shown, before, beyond = np.zeros(photos, dtype=np.int64), np.zeros(photos, dtype=np.int64), np.zeros(photos, dtype=np.int64)
    for arc in range(count):
        beyond[image[arc]] += 1
    depth, against, was = 0, 0, False
    found, made = np.empty((count, 2)), 0
    gap = options.gap_sigmas * np.median(sigma)
    for at in np.argsort(places, kind="mergesort"):
        photo = image[at % count]
        depth -= shown[photo] > 0
        against -= _gap(shown[photo], before[photo], beyond[photo])
        if at < count:
            shown[photo] += 1
            beyond[photo] -= 1
        else:
            shown[photo] -= 1
            before[photo] += 1
        depth += shown[photo] > 0
        against += _gap(shown[photo], before[photo], beyond[photo])
        now = depth >= max(options.min_photos_everywhere, against)
        if now and not was:
            if made and places[at] - found[made - 1, 1] <= gap:
                made -= 1
            else:
                found[made, 0] = places[at]
        elif was and not now:
            found[made, 1] = places[at]
            made += 1
        was = now
    return found[:made]


@njit(cache=True, nogil=True)
@no_type_check
def _gap(shown: int, before: int, beyond: int) -> bool:
    """Whether a photo with so many arcs at a place, and so many on either side of it, shows a gap there."""
    return shown == 0 and before > 0 and beyond > 0


@njit(cache=True, nogil=True)
@no_type_check
def agreed(ends: np.ndarray, sigma: np.ndarray, image: np.ndarray, sigmas: float) -> tuple[float, float]:
    """The outermost place at which the upper ends of several photos agree, and its standard deviation; NaN if they do nowhere.

    Ends agree that are nearer to each other than so many standard deviations `sigmas`.

    Where a line is hidden its ends differ from photo to photo, and where an arc was drawn too long it stands alone; where the
    line itself ends they agree. At least two photos have to, and half as many as at the place where most do. Of several arcs of a
    photo the outermost end counts: at the others the photo shows that the line goes on.
    """
    rows = _outermost(ends, image)
    ends, sigma, count = ends[rows], sigma[rows], len(rows)
    voters, most = np.zeros(count, dtype=np.int64), 0
    for i in range(count):
        for j in range(count):
            voters[i] += _agree(ends, sigma, sigmas, i, j)
        most = max(most, voters[i])
    best = -1
    for i in range(count):
        if voters[i] >= max(2, (most + 1) // 2) and (best < 0 or ends[i] > ends[best]):
            best = i
    if best < 0:
        return np.nan, np.nan
    member = np.empty(count, dtype=np.bool_)
    for j in range(count):
        member[j] = _agree(ends, sigma, sigmas, best, j)
    place, spread = _mean(ends, sigma, member)
    # Those that agree with the outermost lie too far out on average: those that agree with their mean do not.
    for _ in range(SETTLING):
        for j in range(count):
            member[j] = abs(ends[j] - place) <= sigmas * math.hypot(sigma[j], spread)
        if member.sum() < 2:
            break
        place, spread = _mean(ends, sigma, member)
    return place, spread


@njit(cache=True, nogil=True)
@no_type_check
def _outermost(ends: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The row of the largest end of every photo."""
    last = np.full(image.max() + 1, -1, dtype=np.int64)
    for j in range(len(ends)):
        if last[image[j]] < 0 or ends[j] > ends[last[image[j]]]:
            last[image[j]] = j
    return last[last >= 0]


@njit(cache=True, nogil=True)
@no_type_check
def _mean(ends: np.ndarray, sigma: np.ndarray, member: np.ndarray) -> tuple[float, float]:
    """Weighted mean of some of the ends, and its standard deviation."""
    weight = total = 0.0
    for j in range(len(ends)):
        if member[j]:
            weight += 1.0 / sigma[j] ** 2
            total += ends[j] / sigma[j] ** 2
    return total / weight, 1.0 / math.sqrt(weight)


@njit(cache=True, nogil=True)
@no_type_check
def _agree(ends: np.ndarray, sigma: np.ndarray, sigmas: float, i: int, j: int) -> bool:
    return abs(ends[j] - ends[i]) <= sigmas * math.sqrt(sigma[i] ** 2 + min(sigma[i], sigma[j]) ** 2)


@njit(cache=True, nogil=True)
@no_type_check
def clipped(
    starts: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    sigma: np.ndarray,
    image: np.ndarray,
    views: np.ndarray,
    options: ClippingOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The supported stretches of lines, arcs sorted by line: (k, 2) positions, line and number of photos of each stretch.

    `sigma` (n, 2) are those of the lower and upper ends. A stretch is one that enough photos show at every place and views[line]
    in all; it ends where its ends agree, drawn in by some standard deviations.
    """
    total = len(low)
    ends, line, seen = np.empty((total, 2)), np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    made = 0
    for k in range(len(starts) - 1):
        first, last = starts[k], starts[k + 1]
        if last - first < options.min_photos_everywhere:
            continue
        lows, highs, photos, spread = low[first:last], high[first:last], image[first:last], sigma[first:last]
        for begin, end in covered(lows, highs, spread.ravel(), photos, options):
            own = (highs > begin) & (lows < end)
            number = len(np.unique(photos[own]))
            if number < views[k]:
                continue
            top, top_sigma = agreed(highs[own], spread[own, 1], photos[own], options.agree_sigmas)
            bottom, bottom_sigma = agreed(-lows[own], spread[own, 0], photos[own], options.agree_sigmas)
            if not math.isnan(top):
                end = min(end, top) - options.drawn_in_sigmas * top_sigma
            if not math.isnan(bottom):
                begin = max(begin, -bottom) + options.drawn_in_sigmas * bottom_sigma
            if end > begin:
                ends[made, 0], ends[made, 1] = begin, end
                line[made], seen[made] = k, number
                made += 1
    return ends[:made], line[:made], seen[:made]
