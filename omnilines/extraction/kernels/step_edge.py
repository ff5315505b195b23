"""Profiles fitted with several blurred steps at once, one for each edge that crosses them; compiled.

A profile y_c(x) of channel c is level_c + sum_j h_jc Phi((x - x_j) / blur), with the places x_j common to all channels. The
heights are linear: they are solved for at every step of Gauss and Newton in the places (variable projection, Golub and Pereyra
1973).

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.profile import REORDERED
from omnilines.extraction.kernels.tables import Stepped, Window

MOST_STEPS = 6
"""Steps of one profile: its own and the nearest of its neighbours."""
ROUNDS = 5
SETTLED_PX = 0.01
_MOST_MOVE_PX = 0.5
_RIDGE = 1e-6
"""Added to the normal matrix of the heights, of its diagonal: steps may lie on each other."""
_FARTHEST_PX, _WIDEST_PX = 12.0, 12.0
"""Places of steps and offsets that the table of a blurred step reaches."""
_PARTS = 32
"""Rows of the table between two offsets."""


class Table(NamedTuple):
    """Blurred steps of 1 about 0 and their derivatives, at many distances."""

    half: Float[np.ndarray, "p1 l"]
    bell: Float[np.ndarray, "p1 l"]


class Hold(NamedTuple):
    """What keeps the places of steps near their starts: the variance of the noise over the squares of `stiff_px`, those of the
    first place and of the others."""

    variance: float
    stiff_px: Float[np.ndarray, "2"]


class Fit(NamedTuple):
    """Room for the fit of one profile, used again for the next."""

    scaled: Float[np.ndarray, "c k"]
    """Profile times weights, y."""
    design: Float[np.ndarray, "s1 k"]
    """D, a row for the level and one for each step."""
    slope: Float[np.ndarray, "s k"]
    """Its derivative by the places of the steps."""
    factor: Float[np.ndarray, "s1 s1"]
    """Of N = D'D + R."""
    ridge: Float[np.ndarray, " s1"]
    """R."""
    height: Float[np.ndarray, "c s1"]
    """h."""


class Move(NamedTuple):
    """Room for the places of the steps of one profile and how they move."""

    here: Float[np.ndarray, " s"]
    kept: Float[np.ndarray, " s"]
    hessian: Float[np.ndarray, "s s"]
    pull: Float[np.ndarray, "1 s"]
    column: Float[np.ndarray, "s s1"]
    back: Float[np.ndarray, "s s1"]


@njit(cache=True, nogil=True)
@no_type_check
def _blurred_steps(blur: float, between: float) -> Table:
    """A blurred step of 1 about 0 and its derivative at the distances (j / _PARTS + i) between - _FARTHEST_PX - _WIDEST_PX, in
    row j and column i: a step at any place is read from two rows, at as many columns as there are offsets."""
    columns = int(2.0 * (_FARTHEST_PX + _WIDEST_PX) / between) + 2
    half, bell = np.empty((_PARTS + 1, columns)), np.empty((_PARTS + 1, columns))
    for j in range(_PARTS + 1):
        for i in range(columns):
            x = ((j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX) / blur
            half[j, i] = 0.5 * math.erf(x * 0.7071067811865476)
            bell[j, i] = math.exp(-0.5 * x * x) / (blur * 2.5066282746310002)
    return Table(half, bell)


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _blurred_step(window: Window, place: float, steps: Table, j: int, design: np.ndarray, slope: np.ndarray) -> None:
    """A weighted step of 1 about 0 and its derivative by its place: between rows of the table by Hermite's cubic (good to 1e-8)
    and by a line (good to 2e-4)."""
    offsets, weight = window.offsets_px, window.weight
    half, bell = steps
    between = offsets[1] - offsets[0]
    # In this order a place that is no number has a row as well.
    x = (offsets[0] - min(max(-_FARTHEST_PX, place), _FARTHEST_PX) + _FARTHEST_PX + _WIDEST_PX) / between
    i = int(x)
    y = (x - i) * _PARTS
    row = int(y)
    s = y - row
    t = 1.0 - s
    after, rise = s * s * (3.0 - 2.0 * s), between / _PARTS
    left, right = s * t * t * rise, -s * s * t * rise
    for k in range(len(weight)):
        low, high = bell[row, i + k], bell[row + 1, i + k]
        value = half[row, i + k] + after * (half[row + 1, i + k] - half[row, i + k]) + left * low + right * high
        design[1 + j, k] = weight[k] * value
        slope[j, k] = -weight[k] * (t * low + s * high)


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _inner(a: np.ndarray, i: int, b: np.ndarray, j: int) -> float:
    """Of row i of a and row j of b."""
    total = 0.0
    for k in range(a.shape[1]):
        total += a[i, k] * b[j, k]
    return total


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _factor(matrix: np.ndarray, size: int) -> None:
    """Cholesky factor in the lower triangle, in place; its diagonal is inverse."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = 1.0 / math.sqrt(max(total, 1e-12))
            else:
                matrix[i, j] = total * matrix[j, j]


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _forward(factor: np.ndarray, size: int, right: np.ndarray, row: int) -> None:
    """Solution of factor x = right, in place."""
    for i in range(size):
        total = right[row, i]
        for k in range(i):
            total -= factor[i, k] * right[row, k]
        right[row, i] = total * factor[i, i]


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _solve(factor: np.ndarray, size: int, right: np.ndarray, row: int) -> None:
    """Solution of factor factor' x = right, in place."""
    _forward(factor, size, right, row)
    _backward(factor, size, right, row)


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _backward(factor: np.ndarray, size: int, right: np.ndarray, row: int) -> None:
    """Solution of factor' x = right, in place."""
    for i in range(size - 1, -1, -1):
        total = right[row, i]
        for k in range(i + 1, size):
            total -= factor[k, i] * right[row, k]
        right[row, i] = total * factor[i, i]


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _heights(window: Window, place: np.ndarray, steps: int, table: Table, fit: Fit) -> float:
    """Fill the design D for steps at these places, its slope, the factor of N = D'D + R, the ridge R and the heights
    h = N^-1 D'y; and the sum of squares that they leave of y, y'y - h'D'y - h'Rh."""
    scaled, design, slope, factor, ridge, height = fit
    for j in range(steps):
        _blurred_step(window, place[j], table, j, design, slope)
    for p in range(steps + 1):
        for q in range(p + 1):
            factor[p, q] = _inner(design, p, design, q)
        ridge[p] = _RIDGE * factor[p, p]
        factor[p, p] += ridge[p]
    _factor(factor, steps + 1)
    squares = 0.0
    for c in range(len(scaled)):
        # |L^-1 D'y|^2 is h'D'y.
        for p in range(steps + 1):
            height[c, p] = _inner(design, p, scaled, c)
        _forward(factor, steps + 1, height, c)
        for p in range(steps + 1):
            squares -= height[c, p] * height[c, p]
        _backward(factor, steps + 1, height, c)
        for p in range(steps + 1):
            squares -= height[c, p] * ridge[p] * height[c, p]
        squares += _inner(scaled, c, scaled, c)
    return squares


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _newton(steps: int, fit: Fit, move: Move) -> None:
    """Normal matrix and right side of the places, with the heights projected out. With s a slope, r = y - D h what is left and
    w = D's, they hold s's - 2 w' N^-1 w + w' N^-1 D'D N^-1 w and s'r - w' N^-1 D'r, where D'r = R h."""
    scaled, design, slope, factor, ridge, height = fit
    _, _, hessian, pull, column, back = move
    for i in range(steps):
        for p in range(steps + 1):
            column[i, p] = _inner(design, p, slope, i)
            back[i, p] = column[i, p]
        _solve(factor, steps + 1, back, i)
        pull[0, i] = 0.0
        for c in range(len(scaled)):
            inner = _inner(slope, i, scaled, c)
            for p in range(steps + 1):
                inner -= (column[i, p] + back[i, p] * ridge[p]) * height[c, p]
            pull[0, i] += height[c, 1 + i] * inner
        for j in range(i + 1):
            common = 0.0
            for c in range(len(scaled)):
                common += height[c, 1 + i] * height[c, 1 + j]
            inner = _inner(slope, i, slope, j)
            for p in range(steps + 1):
                inner -= (column[i, p] + back[i, p] * ridge[p]) * back[j, p]
            hessian[i, j] = inner * common


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _places(window: Window, start: np.ndarray, hold: Hold, rounds: int, table: Table, fit: Fit, move: Move) -> float:
    """Gauss and Newton from `start` (s), damped, to the places `kept`; the sum of squares that they leave. Design, heights and
    what follows are then as `_heights` and `_newton` leave them. Of a single round the step is taken unseen."""
    here, kept, hessian, pull, _, _ = move
    square, stiff = hold
    steps = len(start)
    for j in range(steps):
        here[j], kept[j] = start[j], start[j]
    least, left, refused = np.inf, 0.0, False
    for number in range(rounds):
        squares = _heights(window, here, steps, table, fit)
        cost = squares
        for j in range(steps):
            cost += square * ((here[j] - start[j]) / stiff[min(j, 1)]) ** 2
        refused = cost > least
        if refused:
            for j in range(steps):
                here[j] = 0.5 * (here[j] + kept[j])
            continue
        least, left = cost, squares
        for j in range(steps):
            kept[j] = here[j]
        if number > 0 and number == rounds - 1:
            break
        _newton(steps, fit, move)
        for j in range(steps):
            back = square / stiff[min(j, 1)] ** 2
            hessian[j, j] += back + 1e-9
            pull[0, j] += back * (start[j] - here[j])
        _factor(hessian, steps)
        _solve(hessian, steps, pull, 0)
        farthest = 0.0
        for j in range(steps):
            here[j] += min(max(pull[0, j], -_MOST_MOVE_PX), _MOST_MOVE_PX)
            farthest = max(farthest, abs(pull[0, j]))
        if farthest < SETTLED_PX or rounds == 1:
            # What is left of the steps and heights after so small a move is of second order.
            for j in range(steps):
                kept[j] = here[j]
            break
    if refused:
        left = _heights(window, kept, steps, table, fit)
    return left


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def fit_steps(
    stepped: Stepped, sigma: np.ndarray, window: Window, stiff: np.ndarray, blur: float, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (m, s) of the steps of m profiles, begun at theirs; the variance of the first place (m), the heights (m, s, c) and
    the sum of squares that is left of the weighted profiles (m).

    Profile m has noise of `sigma` in each value. `stiff` (2) are the standard deviations in px of the first place about its start
    and of the others: a faint step stays where its own arc says. There are at most so many rounds; after a single one, places are
    good to first order, and all else is that of their start.
    """
    profile, start, count = stepped
    m, channels, size, begin = len(profile), profile.shape[1], len(window.weight), window.begin
    known = min(size, profile.shape[2] - begin)
    place, variance = start.copy(), np.full(m, np.inf)
    heights, rest = np.zeros((m, MOST_STEPS, channels)), np.zeros(m)
    fit = Fit(
        np.zeros((channels, size)),
        np.empty((MOST_STEPS + 1, size)),
        np.empty((MOST_STEPS, size)),
        np.empty((MOST_STEPS + 1, MOST_STEPS + 1)),
        np.empty(MOST_STEPS + 1),
        np.empty((channels, MOST_STEPS + 1)),
    )
    move = Move(
        np.empty(MOST_STEPS),
        np.empty(MOST_STEPS),
        np.empty((MOST_STEPS, MOST_STEPS)),
        np.empty((1, MOST_STEPS)),
        np.empty((MOST_STEPS, MOST_STEPS + 1)),
        np.empty((MOST_STEPS, MOST_STEPS + 1)),
    )
    fit.design[0] = window.weight
    table = _blurred_steps(blur, window.offsets_px[1] - window.offsets_px[0])
    for n in range(m):
        steps = count[n]
        for c in range(channels):
            for k in range(known):
                fit.scaled[c, k] = profile[n, c, begin + k] * window.weight[k]
        square = sigma[n] * sigma[n]
        rest[n] = _places(window, start[n, :steps], Hold(square, stiff), rounds, table, fit, move)
        move.pull[0, :steps] = 0.0
        move.pull[0, 0] = 1.0
        _solve(move.hessian, steps, move.pull, 0)
        variance[n] = square * move.pull[0, 0]
        place[n, :steps] = move.kept[:steps]
        for c in range(channels):
            heights[n, :steps, c] = fit.height[c, 1 : steps + 1]
    return place, variance, heights, rest
