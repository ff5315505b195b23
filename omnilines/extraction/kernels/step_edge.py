"""Profiles fitted with several blurred steps at once, one for each edge that crosses them; compiled.

A profile y_c(x) of channel c is level_c + sum_j h_jc Phi((x - x_j) / blur), with the places x_j common to all channels. The
heights are linear: they are solved for at every step of Gauss and Newton in the places (variable projection, Golub and Pereyra
1973).

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.profile import REORDERED

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


@njit(cache=True, nogil=True)
@no_type_check
def _blurred_steps(blur: float, between: float) -> tuple[np.ndarray, np.ndarray]:
    """A blurred step of 1 about 0 and its derivative at the distances (j / _PARTS + i) between - _FARTHEST_PX - _WIDEST_PX, in
    row j and column i: a step at any place is read from two rows, at as many columns as there are offsets."""
    columns = int(2.0 * (_FARTHEST_PX + _WIDEST_PX) / between) + 2
    half, bell = np.empty((_PARTS + 1, columns)), np.empty((_PARTS + 1, columns))
    for j in range(_PARTS + 1):
        for i in range(columns):
            x = ((j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX) / blur
            half[j, i] = 0.5 * math.erf(x * 0.7071067811865476)
            bell[j, i] = math.exp(-0.5 * x * x) / (blur * 2.5066282746310002)
    return half, bell


@njit(cache=True, nogil=True, fastmath=REORDERED, **BORROWED)
@no_type_check
def _blurred_step(
    offsets: np.ndarray,
    weight: np.ndarray,
    place: float,
    half: np.ndarray,
    bell: np.ndarray,
    j: int,
    design: np.ndarray,
    slope: np.ndarray,
) -> None:
    """A weighted step of 1 about 0 and its derivative by its place: between rows of the table by Hermite's cubic (good to 1e-8)
    and by a line (good to 2e-4)."""
    between = offsets[1] - offsets[0]
    x = (offsets[0] - min(max(place, -_FARTHEST_PX), _FARTHEST_PX) + _FARTHEST_PX + _WIDEST_PX) / between
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
def _heights(
    offsets: np.ndarray,
    weight: np.ndarray,
    place: np.ndarray,
    steps: int,
    half: np.ndarray,
    bell: np.ndarray,
    scaled: np.ndarray,
    design: np.ndarray,
    slope: np.ndarray,
    factor: np.ndarray,
    ridge: np.ndarray,
    height: np.ndarray,
) -> float:
    """Fill the design D for steps at these places, its slope, the factor of N = D'D + R, the ridge R and the heights
    h = N^-1 D'y; and the sum of squares that they leave of y, y'y - h'D'y - h'Rh."""
    for j in range(steps):
        _blurred_step(offsets, weight, place[j], half, bell, j, design, slope)
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
def _newton(
    steps: int,
    scaled: np.ndarray,
    design: np.ndarray,
    slope: np.ndarray,
    factor: np.ndarray,
    ridge: np.ndarray,
    height: np.ndarray,
    hessian: np.ndarray,
    pull: np.ndarray,
    column: np.ndarray,
    back: np.ndarray,
) -> None:
    """Normal matrix and right side of the places, with the heights projected out. With s a slope, r = y - D h what is left and
    w = D's, they hold s's - 2 w' N^-1 w + w' N^-1 D'D N^-1 w and s'r - w' N^-1 D'r, where D'r = R h."""
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
def _places(
    offsets: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    stiff: np.ndarray,
    square: float,
    rounds: int,
    half: np.ndarray,
    bell: np.ndarray,
    scaled: np.ndarray,
    here: np.ndarray,
    kept: np.ndarray,
    design: np.ndarray,
    slope: np.ndarray,
    factor: np.ndarray,
    ridge: np.ndarray,
    height: np.ndarray,
    hessian: np.ndarray,
    pull: np.ndarray,
    column: np.ndarray,
    back: np.ndarray,
) -> float:
    """Gauss and Newton from `start` (s), damped, to the places `kept`; the sum of squares that they leave. Design, heights and
    what follows are then as `_heights` and `_newton` leave them. Of a single round the step is taken unseen."""
    steps = len(start)
    for j in range(steps):
        here[j], kept[j] = start[j], start[j]
    least, left, refused = np.inf, 0.0, False
    for number in range(rounds):
        squares = _heights(offsets, weight, here, steps, half, bell, scaled, design, slope, factor, ridge, height)
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
        _newton(steps, scaled, design, slope, factor, ridge, height, hessian, pull, column, back)
        for j in range(steps):
            hold = square / stiff[min(j, 1)] ** 2
            hessian[j, j] += hold + 1e-9
            pull[0, j] += hold * (start[j] - here[j])
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
        left = _heights(offsets, weight, kept, steps, half, bell, scaled, design, slope, factor, ridge, height)
    return left


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def fit_steps(
    profile: np.ndarray,
    begin: int,
    offsets: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    count: np.ndarray,
    stiff: np.ndarray,
    sigma: np.ndarray,
    blur: float,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (m, s) of the steps of m profiles (m, c, k), begun at `start`; the variance of the first place (m), the heights
    (m, s, c) and the sum of squares that is left of the weighted profiles (m).

    `offsets`, equally far apart, and `weight` are those of the values of a profile from `begin` on. Profile m has `count` steps
    and noise of `sigma` in each value. `stiff` (s) are the standard deviations in px of the first place about its start and of
    the others: a faint step stays where its own arc says. There are at most so many rounds; after a single one, places are
    good to first order, and all else is that of their start.
    """
    m, channels, size = len(profile), profile.shape[1], len(offsets)
    known = min(size, profile.shape[2] - begin)
    place, variance = start.copy(), np.full(m, np.inf)
    heights, rest = np.zeros((m, MOST_STEPS, channels)), np.zeros(m)
    design, slope = np.empty((MOST_STEPS + 1, size)), np.empty((MOST_STEPS, size))
    factor, ridge = np.empty((MOST_STEPS + 1, MOST_STEPS + 1)), np.empty(MOST_STEPS + 1)
    height, hessian, pull = np.empty((channels, MOST_STEPS + 1)), np.empty((MOST_STEPS, MOST_STEPS)), np.empty((1, MOST_STEPS))
    column, back = np.empty((MOST_STEPS, MOST_STEPS + 1)), np.empty((MOST_STEPS, MOST_STEPS + 1))
    design[0] = weight
    half, bell = _blurred_steps(blur, offsets[1] - offsets[0])
    scaled, here, kept = np.zeros((channels, size)), np.empty(MOST_STEPS), np.empty(MOST_STEPS)
    for n in range(m):
        steps = count[n]
        for c in range(channels):
            for k in range(known):
                scaled[c, k] = profile[n, c, begin + k] * weight[k]
        square = sigma[n] * sigma[n]
        first = start[n, :steps]
        rest[n] = _places(
            offsets,
            weight,
            first,
            stiff,
            square,
            rounds,
            half,
            bell,
            scaled,
            here,
            kept,
            design,
            slope,
            factor,
            ridge,
            height,
            hessian,
            pull,
            column,
            back,
        )
        pull[0, :steps] = 0.0
        pull[0, 0] = 1.0
        _solve(hessian, steps, pull, 0)
        variance[n] = square * pull[0, 0]
        place[n, :steps] = kept[:steps]
        for c in range(channels):
            heights[n, :steps, c] = height[c, 1 : steps + 1]
    return place, variance, heights, rest
