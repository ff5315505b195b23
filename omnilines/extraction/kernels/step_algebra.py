"""What a fit of blurred steps is made of, many profiles at once; compiled.

The last index of every table is the lane, that of the profile: one instruction does the same for several of them.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.tables import Window

_UNROLLED = 5
"""Values of a profile that are summed over in one go."""
MOST_STEPS = 6
"""Steps of one profile: its own and the nearest of its neighbours."""
_RIDGE = 1e-6
"""Added to the normal matrix of the heights, of its diagonal: steps may lie on each other."""
_FARTHEST_PX, _WIDEST_PX = 12.0, 12.0
"""Places of steps and offsets that the table of a blurred step reaches."""
_FLAT = 9.0
"""Blurs from a step where it is flat to the last digit."""
_PARTS = 32
"""Rows of the table between two offsets."""


class Table(NamedTuple):
    """Blurred steps of 1 about 0 and their derivatives, at many distances."""

    half: Float[np.ndarray, " n"]
    bell: Float[np.ndarray, " n"]
    columns: int
    """Of each row; row after row."""
    blur: float


class Fit(NamedTuple):
    """Room for the fit of some profiles, used again for the next ones; l is the lane."""

    scaled: Float[np.ndarray, "c k l"]
    """Profile times weights, y."""
    design: Float[np.ndarray, "s1 k l"]
    """D, a row for the level and one for each step."""
    slope: Float[np.ndarray, "s k l"]
    """Its derivative by the places of the steps."""
    factor: Float[np.ndarray, "s1 s1 l"]
    """Of N = D'D + R; its diagonal is inverse, as in all factors here."""
    ridge: Float[np.ndarray, "s1 l"]
    """R."""
    height: Float[np.ndarray, "c s1 l"]
    """h."""
    squares: Float[np.ndarray, " l"]
    """Sum of squares that they leave of y."""
    total: Float[np.ndarray, " l"]
    row: Int[np.ndarray, " l"]
    """Where a step is read from the table, how far from there it is wanted, and where that is, in blurs."""
    shift: Float[np.ndarray, " l"]
    first: Float[np.ndarray, " l"]


class Move(NamedTuple):
    """Room for the places of the steps of some profiles and how they move."""

    start: Float[np.ndarray, "s l"]
    hold: Float[np.ndarray, "s l"]
    """What keeps each place near its start: the variance of the noise over the square of its standard deviation (px)."""
    here: Float[np.ndarray, "s l"]
    kept: Float[np.ndarray, "s l"]
    hessian: Float[np.ndarray, "s s l"]
    """That of the last move, as a factor."""
    newest: Float[np.ndarray, "s s l"]
    pull: Float[np.ndarray, "1 s l"]
    column: Float[np.ndarray, "s s1 l"]
    back: Float[np.ndarray, "s s1 l"]


@njit(cache=True, nogil=True)
@no_type_check
def blurred_steps(blur: float, between: float) -> Table:
    """A blurred step of 1 about 0 and its derivative at the distances (j / _PARTS + i) between - _FARTHEST_PX - _WIDEST_PX, in
    row j and column i: a step at any place is read from the row next to it, at as many columns as there are offsets."""
    columns = int(2.0 * (_FARTHEST_PX + _WIDEST_PX) / between) + 2
    half, bell = np.empty((_PARTS + 1, columns)), np.empty((_PARTS + 1, columns))
    for j in range(_PARTS + 1):
        for i in range(columns):
            x = ((j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX) / blur
            if abs(x) > _FLAT:
                half[j, i], bell[j, i] = math.copysign(0.5, x), 0.0
                continue
            half[j, i] = 0.5 * math.erf(x * 0.7071067811865476)
            bell[j, i] = math.exp(-0.5 * x * x) / (blur * 2.5066282746310002)
    return Table(half.ravel(), bell.ravel(), columns, blur)


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def row_of(first_px: float, between: float, place: float, table: Table) -> tuple[int, float, float]:
    """Where a step at a place is read from the table at offsets from `first_px` on: the first value, how far from there it is
    wanted, and the distance from the step there; both in blurs."""
    # In this order a place that is no number has a row as well.
    x = (first_px - min(max(-_FARTHEST_PX, place), _FARTHEST_PX) + _FARTHEST_PX + _WIDEST_PX) / between
    i = int(x)
    y = (x - i) * _PARTS
    j = int(y + 0.5)
    over = 1.0 / table.blur
    there_px = (j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX
    return j * table.columns + i, (y - j) * between / _PARTS * over, there_px * over


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def step_at(table: Table, at: int, shift: float, there: float) -> tuple[float, float]:
    """A step of 1 about 0 and its derivative by the offset, `shift` blurs from a value of the table that lies `there` from the
    step: by Taylor's series, good to 1e-8 and 4e-6."""
    bell, curved = table.bell[at], shift * shift * (there * there - 1.0)
    turn = shift * there
    step = table.half[at] + shift * table.blur * bell * (1.0 - 0.5 * turn + curved / 6.0)
    return step, bell * (1.0 - turn + 0.5 * curved)


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _blurred_step(window: Window, place: np.ndarray, steps: Table, j: int, fit: Fit) -> None:
    """Weighted steps of 1 about 0 and their derivatives by their places."""
    lanes = len(fit.row)
    offsets, weight = window.offsets_px, window.weight
    design, slope, row, shift, first = fit.design, fit.slope, fit.row, fit.shift, fit.first
    between = offsets[1] - offsets[0]
    for n in range(lanes):
        row[n], shift[n], first[n] = row_of(offsets[0], between, place[j, n], steps)
    for k in range(len(weight)):
        along = k * between / steps.blur
        for n in range(lanes):
            half, bell = step_at(steps, row[n] + k, shift[n], first[n] + along)
            design[1 + j, k, n], slope[j, k, n] = weight[k] * half, -weight[k] * bell


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _inner(a: np.ndarray, i: int, b: np.ndarray, j: int, total: np.ndarray) -> None:
    """Of row i of a and row j of b, lane by lane."""
    lanes = len(total)
    for n in range(lanes):
        total[n] = 0.0
    whole = a.shape[1] - a.shape[1] % _UNROLLED
    for k in range(0, whole, _UNROLLED):
        for n in range(lanes):
            total[n] += (
                a[i, k, n] * b[j, k, n]
                + a[i, k + 1, n] * b[j, k + 1, n]
                + a[i, k + 2, n] * b[j, k + 2, n]
                + a[i, k + 3, n] * b[j, k + 3, n]
                + a[i, k + 4, n] * b[j, k + 4, n]
            )
    for k in range(whole, a.shape[1]):
        for n in range(lanes):
            total[n] += a[i, k, n] * b[j, k, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def factorise(matrix: np.ndarray, size: int) -> None:
    """Cholesky factor in the lower triangle, in place; its diagonal is inverse."""
    lanes = matrix.shape[2]
    for i in range(size):
        for j in range(i + 1):
            for k in range(j):
                for n in range(lanes):
                    matrix[i, j, n] -= matrix[i, k, n] * matrix[j, k, n]
            for n in range(lanes):
                if i == j:
                    matrix[i, i, n] = 1.0 / math.sqrt(max(matrix[i, i, n], 1e-12))
                else:
                    matrix[i, j, n] *= matrix[j, j, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def forward(factor: np.ndarray, size: int, right: np.ndarray, row: int) -> None:
    """Solution of factor x = right, in place."""
    lanes = factor.shape[2]
    for i in range(size):
        for k in range(i):
            for n in range(lanes):
                right[row, i, n] -= factor[i, k, n] * right[row, k, n]
        for n in range(lanes):
            right[row, i, n] *= factor[i, i, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def backward(factor: np.ndarray, size: int, right: np.ndarray, row: int) -> None:
    """Solution of factor' x = right, in place."""
    lanes = factor.shape[2]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            for n in range(lanes):
                right[row, i, n] -= factor[k, i, n] * right[row, k, n]
        for n in range(lanes):
            right[row, i, n] *= factor[i, i, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def heights(window: Window, place: np.ndarray, steps: int, table: Table, fit: Fit) -> None:
    """Fill the design D for steps at these places, its slope, the factor of N = D'D + R, the ridge R and the heights
    h = N^-1 D'y; and the sum of squares that they leave of y, y'y - h'D'y - h'Rh."""
    lanes = len(fit.total)
    scaled, design, _, factor, ridge, height, squares, total, _, _, _ = fit
    for j in range(steps):
        _blurred_step(window, place, table, j, fit)
    for p in range(steps + 1):
        for q in range(p + 1):
            _inner(design, p, design, q, total)
            for n in range(lanes):
                factor[p, q, n] = total[n]
        for n in range(lanes):
            ridge[p, n] = _RIDGE * factor[p, p, n]
            factor[p, p, n] += ridge[p, n]
    factorise(factor, steps + 1)
    for n in range(lanes):
        squares[n] = 0.0
    for c in range(len(scaled)):
        # |L^-1 D'y|^2 is h'D'y.
        for p in range(steps + 1):
            _inner(design, p, scaled, c, total)
            for n in range(lanes):
                height[c, p, n] = total[n]
        forward(factor, steps + 1, height, c)
        for p in range(steps + 1):
            for n in range(lanes):
                squares[n] -= height[c, p, n] * height[c, p, n]
        backward(factor, steps + 1, height, c)
        _inner(scaled, c, scaled, c, total)
        for n in range(lanes):
            squares[n] += total[n]
        for p in range(steps + 1):
            for n in range(lanes):
                squares[n] -= height[c, p, n] * ridge[p, n] * height[c, p, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def newton(steps: int, fit: Fit, move: Move) -> None:
    """Normal matrix and right side of the places, with the heights projected out. With s a slope, r = y - D h what is left and
    w = D's, they hold s's - 2 w' N^-1 w + w' N^-1 D'D N^-1 w and s'r - w' N^-1 D'r, where D'r = R h."""
    lanes = len(fit.total)
    scaled, design, slope, factor, ridge, height, _, total, _, _, _ = fit
    newest, pull, column, back = move.newest, move.pull, move.column, move.back
    for i in range(steps):
        for p in range(steps + 1):
            _inner(design, p, slope, i, total)
            for n in range(lanes):
                column[i, p, n] = total[n]
                back[i, p, n] = total[n]
        forward(factor, steps + 1, back, i)
        backward(factor, steps + 1, back, i)
        for p in range(steps + 1):
            for n in range(lanes):
                column[i, p, n] += back[i, p, n] * ridge[p, n]
        for n in range(lanes):
            pull[0, i, n] = 0.0
        for c in range(len(scaled)):
            _inner(slope, i, scaled, c, total)
            for p in range(steps + 1):
                for n in range(lanes):
                    total[n] -= column[i, p, n] * height[c, p, n]
            for n in range(lanes):
                pull[0, i, n] += height[c, 1 + i, n] * total[n]
        for j in range(i + 1):
            _inner(slope, i, slope, j, total)
            for p in range(steps + 1):
                for n in range(lanes):
                    total[n] -= column[i, p, n] * back[j, p, n]
            for n in range(lanes):
                newest[i, j, n] = 0.0
            for c in range(len(scaled)):
                for n in range(lanes):
                    newest[i, j, n] += total[n] * height[c, 1 + i, n] * height[c, 1 + j, n]
