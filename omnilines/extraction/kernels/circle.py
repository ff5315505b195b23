"""The great circle through the shifts measured along an arc; compiled.

A place of the edge at angle t of an arc, `off` px across it, is a row (x, y, off, share, weight, left) of a room that is used
again for one arc after another: it moves by x a + y b px where the normal changes by (a, b), it counts with its share, in
the last round of a fit with its weight, and what that leaves of it is `left`.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.tables import Places

X, Y, OFF, SHARE, WEIGHT, LEFT = range(6)
LEAST_SCALE_PX = 0.05
"""Of the robust weights: smaller residuals are not told apart."""
ROUNDS = 4
EVERY = 1e9
"""A scale at which all residuals count."""
_HALVINGS = 14
"""Of the interval that holds a median."""


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _median(room: np.ndarray, row: int, count: int) -> float:
    """Of the sizes of `count` values, to 1e-4 of the largest one. Halving an interval takes no copy, and no branch for each."""
    low, high = 0.0, 0.0
    for i in range(count):
        high = max(high, abs(room[row, i]))
    for _ in range(_HALVINGS):
        middle, below = 0.5 * (low + high), 0
        for i in range(count):
            below += abs(room[row, i]) <= middle
        if 2 * below < count:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def fill_ways(angle: np.ndarray, rate: np.ndarray, ways: np.ndarray) -> None:
    """How far (px across) points at angles of an arc move where its normal changes by (a, b): ways[0] a + ways[1] b, with
    -rate (cos t, sin t) in the first columns of `ways`."""
    for n in range(len(angle)):
        ways[0, n], ways[1, n] = -rate[n] * math.cos(angle[n]), -rate[n] * math.sin(angle[n])


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def own_places(
    places: Places, ways: np.ndarray, begin: int, end: int, max_shift_px: float, room: np.ndarray, chosen: np.ndarray
) -> int:
    """Fill the room with the places of an arc, numbers `begin` to `end`, that are usable and not of another edge, and `chosen`
    with their numbers; how many.

    `ways` are those of the arc (`fill_ways`). Shares rise with the contrast, up to 1.
    """
    shift, strength, usable = places.shift, places.strength, places.usable
    count = 0
    for n in range(begin, end):
        if usable[n] and abs(shift[n]) < max_shift_px:
            chosen[count] = n
            room[X, count], room[Y, count] = ways[0, n - begin], ways[1, n - begin]
            room[OFF, count], room[SHARE, count] = shift[n], strength[n]
            count += 1
    middle = _median(room, SHARE, count)
    for i in range(count):
        room[SHARE, i] = room[SHARE, i] / (room[SHARE, i] + middle)
    return count


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _normal_matrix(room: np.ndarray, count: int, a: float, b: float, scale: float) -> tuple[float, float, float, float, float]:
    """Matrix (m00, m01, m11) and right side of the least squares for (a, b). Their weights are the shares times Tukey's of the
    residuals about the circle changed by (a, b) as they are."""
    m00, m01, m11, r0, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
    over = 1.0 / (4.7 * scale)
    for i in range(count):
        x, y, off = room[X, i], room[Y, i], room[OFF, i]
        ratio = (off - a * x - b * y) * over
        inside = max(1.0 - ratio * ratio, 0.0)
        w = inside * inside * room[SHARE, i]
        room[WEIGHT, i] = w
        m00 += w * x * x
        m01 += w * x * y
        m11 += w * y * y
        r0 += w * x * off
        r1 += w * y * off
    return m00, m01, m11, r0, r1


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def fit_circle(
    room: np.ndarray, count: int, a: float, b: float, scale: float, rounds: int
) -> tuple[float, float, float, float, float, float]:
    """The change (a, b) of the normal of an arc, the scale of the residuals and the normal matrix (m00, m01, m11), by so many
    rounds of weighted least squares from a change and a scale; a scale of 0 where they are not defined.

    Weights are the shares times Tukey's of the residuals.
    """
    m00, m01, m11 = 0.0, 0.0, 0.0
    for _ in range(rounds):
        m00, m01, m11, r0, r1 = _normal_matrix(room, count, a, b, scale)
        determinant = m00 * m11 - m01 * m01
        if determinant <= 1e-12 * m00 * m11:
            return 0.0, 0.0, 0.0, m00, m01, m11
        a, b = (m11 * r0 - m01 * r1) / determinant, (m00 * r1 - m01 * r0) / determinant
        for i in range(count):
            room[LEFT, i] = room[OFF, i] - a * room[X, i] - b * room[Y, i]
        scale = max(1.4826 * _median(room, LEFT, count), LEAST_SCALE_PX)
    return a, b, scale, m00, m01, m11


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def scatter_of(room: np.ndarray, count: int) -> tuple[float, int]:
    """Sum of w^2 r^2 over sum of w: the variance that the inverse of sum w x x' is to be multiplied by, for residuals whose
    variance is not 1 / w; and how many of them have a weight."""
    total, squares, kept = 1e-300, 0.0, 0
    for i in range(count):
        total += room[WEIGHT, i]
        squares += (room[WEIGHT, i] * room[LEFT, i]) ** 2
        kept += room[WEIGHT, i] > 0.0
    return squares / total * kept / max(kept - 2, 1), kept


@njit(cache=True, nogil=True)
@no_type_check
def fit_circles(
    starts: np.ndarray, places: Places, max_shift_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each arc, with the places from starts[n] on, the change (a, b) of its normal, the inverse normal matrix (2, 2), the
    residuals' variance that it is to be multiplied by, and the number of places used; and the residuals of all (NaN: none).

    Weights rise with the strength, and fall by Tukey's function with the residual; shifts of `max_shift_px` or more are another
    edge.
    """
    arcs = len(starts) - 1
    change, inverse, variance = np.zeros((arcs, 2)), np.zeros((arcs, 2, 2)), np.zeros(arcs)
    used, longest = np.zeros(arcs), 0
    residual = np.full(len(places.shift), np.nan)
    for arc in range(arcs):
        longest = max(longest, starts[arc + 1] - starts[arc])
    room, ways, chosen = np.empty((6, longest)), np.empty((2, longest)), np.empty(longest, dtype=np.int64)
    for arc in range(arcs):
        begin, end = starts[arc], starts[arc + 1]
        fill_ways(places.angle[begin:end], places.rate[begin:end], ways)
        count = own_places(places, ways, begin, end, max_shift_px, room, chosen)
        if count < 3:
            continue
        a, b, scale, m00, m01, m11 = fit_circle(room, count, 0.0, 0.0, EVERY, ROUNDS)
        if scale == 0.0:
            continue
        change[arc, 0], change[arc, 1] = a, b
        determinant = m00 * m11 - m01 * m01
        inverse[arc, 0, 0], inverse[arc, 1, 1] = m11 / determinant, m00 / determinant
        inverse[arc, 0, 1] = inverse[arc, 1, 0] = -m01 / determinant
        variance[arc], used[arc] = scatter_of(room, count)
        for i in range(count):
            residual[chosen[i]] = room[LEFT, i]
    return change, inverse, variance, used, residual
