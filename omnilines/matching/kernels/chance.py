"""Which photos show a line, and where else in them it would be shown, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.matching.kernels.hypothesis import likeness
from omnilines.matching.options import LikenessOptions


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def shown_and_beside(
    direction: np.ndarray,
    moment: np.ndarray,
    span: np.ndarray,
    line_colours: np.ndarray,
    own: np.ndarray,
    least_share: np.ndarray,
    packed: np.ndarray,
    px_rad: np.ndarray,
    colours: np.ndarray,
    starts: np.ndarray,
    asked_starts: np.ndarray,
    asked: np.ndarray,
    reach_px: float,
    most_square: float,
    min_overlap_share: float,
    looks: LikenessOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Of the lines asked[asked_starts[p] : asked_starts[p + 1]] in each photo p: widths (px) within which an arc of the photo
    shows the line, NaN where none does; and the length (px) of all other places, up to `reach_px` to both sides, at which arcs of
    the photo would show it.

    `span` (l, 2) are the positions along each line between which it is known, `own` (n,) the line of each arc or -1, and
    `least_share` (l,) what of each line another arc that shows it has to cover. The plane of a line is turned by t about an axis
    square to the middle of the line: distances h from it become h - t cos(f), f the angle from that middle. An arc shows it where
    the sum of (h - t cos f)^2 / s^2 over its ends is at most `most_square`.
    """
    photos = len(starts) - 1
    width, beside = np.full(len(asked), np.nan), np.zeros(len(asked))
    at, view = np.empty(4), np.empty(9)
    for photo in range(photos):
        begin, end = starts[photo], starts[photo + 1]
        ends, most_rad = packed[begin:end, :6].T.copy(), (reach_px + 6.0) * px_rad[begin:end]
        low, high, close = np.empty(end - begin), np.empty(end - begin), np.empty(end - begin, dtype=np.bool_)
        for place in range(asked_starts[photo], asked_starts[photo + 1] if begin < end else asked_starts[photo]):
            line, count = asked[place], 0
            _view(packed[begin], direction[line], moment[line], span[line], view)
            _within(ends, view, most_rad, close)
            for arc in range(begin, end):
                mine = own[arc] == line
                if not mine and not close[arc - begin]:
                    continue
                flipped = _seen(packed[arc], direction[line], view, mine, min_overlap_share, least_share[line], at)
                if flipped < 0:
                    continue
                first, second = at[2] / packed[arc, 12], at[3] / packed[arc, 13]
                h, k = at[0] / packed[arc, 12], at[1] / packed[arc, 13]
                square = first * first + second * second
                middle = (h * first + k * second) / square
                rest = most_square - (h * h + k * k - middle * middle * square)
                if not mine and (
                    rest <= 0.0 or likeness(line_colours[line], colours[arc], flipped > 0, looks) < looks.min_likeness
                ):
                    continue
                middle, half = middle / px_rad[arc], math.sqrt(max(rest, 0.0) / square) / px_rad[arc]
                if mine or abs(middle) < half:
                    if not width[place] >= 2.0 * half:
                        width[place] = 2.0 * half
                else:
                    low[count], high[count] = max(middle - half, -reach_px), min(middle + half, reach_px)
                    count += 1
            beside[place] = _covered(low[:count], high[:count])
    return width, beside


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _view(p: np.ndarray, d: np.ndarray, moment: np.ndarray, span: np.ndarray, out: np.ndarray) -> None:
    """How the photo of an arc sees a line, into `out`: the unit normal of its plane, the unit vector to its nearest point, the
    angles from there at which it begins and ends, and the middle of them."""
    mx = moment[0] - (p[10] * d[2] - p[11] * d[1])
    my = moment[1] - (p[11] * d[0] - p[9] * d[2])
    mz = moment[2] - (p[9] * d[1] - p[10] * d[0])
    distance = math.sqrt(mx * mx + my * my + mz * mz)
    out[0], out[1], out[2] = mx / distance, my / distance, mz / distance
    # d x m.
    out[3], out[4], out[5] = d[1] * out[2] - d[2] * out[1], d[2] * out[0] - d[0] * out[2], d[0] * out[1] - d[1] * out[0]
    base = p[9] * d[0] + p[10] * d[1] + p[11] * d[2]
    out[6], out[7] = math.atan2(span[0] - base, distance), math.atan2(span[1] - base, distance)
    out[8] = 0.5 * (out[6] + out[7])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _within(ends: np.ndarray, view: np.ndarray, most_rad: np.ndarray, close: np.ndarray) -> None:
    """Whether both ends of each arc, columns of coordinates, lie so near the plane of a line. Asked of every arc and every line:
    without a branch, it is compiled to vector instructions."""
    ax, ay, az, bx, by, bz = ends[0], ends[1], ends[2], ends[3], ends[4], ends[5]
    nx, ny, nz = view[0], view[1], view[2]
    for arc in range(len(close)):
        first = abs(ax[arc] * nx + ay[arc] * ny + az[arc] * nz)
        last = abs(bx[arc] * nx + by[arc] * ny + bz[arc] * nz)
        close[arc] = (first <= most_rad[arc]) & (last <= most_rad[arc])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _seen(
    p: np.ndarray, d: np.ndarray, view: np.ndarray, mine: bool, min_overlap_share: float, least_share: float, out: np.ndarray
) -> int:
    """Distances (rad) of both ends of an arc from the plane of a line and cosines of their angles from its middle into `out`.

    1 where the arc runs against the line, 0 where along it, -1 where it is not its own and does not lie beside it, or beside too
    little of it.
    """
    out[0] = p[0] * view[0] + p[1] * view[1] + p[2] * view[2]
    out[1] = p[3] * view[0] + p[4] * view[1] + p[5] * view[2]
    first = math.atan2(p[0] * d[0] + p[1] * d[1] + p[2] * d[2], p[0] * view[3] + p[1] * view[4] + p[2] * view[5])
    last = math.atan2(p[3] * d[0] + p[4] * d[1] + p[5] * d[2], p[3] * view[3] + p[4] * view[4] + p[5] * view[5])
    low, high, begin, end = min(first, last), max(first, last), view[6], view[7]
    overlap, shorter = min(end, high) - max(begin, low), min(end - begin, high - low)
    if not mine and (high - low > math.pi or overlap < min_overlap_share * shorter):
        return -1
    if not mine:
        covered = math.tan(min(end, high)) - math.tan(max(begin, low))
        if covered < least_share * (math.tan(end) - math.tan(begin)):
            return -1
    out[2], out[3] = math.cos(first - view[8]), math.cos(last - view[8])
    return 1 if last < first else 0


@njit(cache=True, nogil=True)
@no_type_check
def _covered(low: np.ndarray, high: np.ndarray) -> float:
    """Length of the union of intervals."""
    total, end = 0.0, -np.inf
    for k in np.argsort(low):
        total += max(high[k] - max(low[k], end), 0.0)
        end = max(end, high[k])
    return total


@njit(cache=True, nogil=True)
@no_type_check
def at_least(chance: np.ndarray, line: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Probability of each line that at least times[line] of its independent events come true; `line` is that of each event, in
    ascending order."""
    found, first = np.empty(len(times)), 0
    for own in range(len(times)):
        last = first
        while last < len(line) and line[last] == own:
            last += 1
        just = np.zeros(last - first + 1)
        just[0] = 1.0
        for event in range(first, last):
            for k in range(event - first + 1, 0, -1):
                just[k] += chance[event] * (just[k - 1] - just[k])
            just[0] *= 1.0 - chance[event]
        found[own] = just[times[own] :].sum()
        first = last
    return found
