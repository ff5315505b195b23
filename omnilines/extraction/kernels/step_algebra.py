"""What a fit of blurred steps is made of, many profiles at once; compiled.

The last index of every table is the lane, that of the profile: one instruction does the same for several of them.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.tables import Window

_UNROLLED = 5
"""Values of a profile that are summed over in one go."""
MOST_STEPS = 6
"""Steps of one profile: its own and the nearest of its neighbours."""
_RIDGE = 1e-6
"""Added to the normal matrix of the heights, of its diagonal: steps may lie on each other."""
_FARTHEST = 36.0
"""Blurs from the middle of a profile to a step: farther ones are not told apart. There a bell is still a number."""
LEAST_BLUR_PX = 0.2
"""Any pixel blurs more."""
_POWERS = 2.0 ** np.arange(-1022, 1024)
"""Those of two that are numbers."""


class Fit(NamedTuple):
    """Room for the fit of some profiles, used again for the next ones; l is the lane."""

    scaled: Float[np.ndarray, "c k l"]
    """Profile times weights, y."""
    energy: Float[np.ndarray, " l"]
    """y'y."""
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
    first: Float[np.ndarray, " l"]
    """Distance of the middle offset from a step, in blurs."""
    bell: Float[np.ndarray, " l"]
    factor_up: Float[np.ndarray, " l"]
    bell_down: Float[np.ndarray, " l"]
    factor_down: Float[np.ndarray, " l"]


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


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _exponential(x: float) -> float:
    """exp of -700 to 700, to 1e-11 of it, in instructions for several lanes at once; the library takes them one by one."""
    power = math.floor(x * 1.4426950408889634 + 0.5)
    r = x - power * 0.6931471805599453
    total = 1.0 + r / 9.0
    for k in range(8, 0, -1):
        total = 1.0 + r * total * (1.0 / k)
    return total * _POWERS[np.int32(power) + 1022]


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED, **BORROWED)
@no_type_check
def _blurred_step(window: Window, place: np.ndarray, blur: float, j: int, fit: Fit) -> None:
    """Weighted steps of 1 about 0 and their derivatives by their places.

    The bell is that of the offset before times a factor, which is the factor before times exp(-d^2), d blurs between offsets;
    from the middle to both sides.
    """
    lanes, size = len(fit.total), len(window.weight)
    middle, between = size // 2, (window.offsets_px[1] - window.offsets_px[0]) / blur
    shrink = math.exp(-between * between)
    for n in range(lanes):
        # In this order a place that is no number is one as well.
        x = min(max(-_FARTHEST, (window.offsets_px[middle] - place[j, n]) / blur), _FARTHEST)
        fit.first[n], fit.bell[n] = x, _exponential(-0.5 * x * x)
        fit.factor_up[n] = _exponential(-between * (x + 0.5 * between))
    for n in range(lanes):
        fit.factor_down[n], fit.bell_down[n] = shrink / fit.factor_up[n], fit.bell[n]
    for k in range(middle, size):
        _one_offset(window.weight[k], (k - middle) * between, blur, j, k, fit.bell, fit)
        for n in range(lanes):
            fit.bell[n] *= fit.factor_up[n]
            fit.factor_up[n] *= shrink
    for k in range(middle - 1, -1, -1):
        for n in range(lanes):
            fit.bell_down[n] *= fit.factor_down[n]
            fit.factor_down[n] *= shrink
        _one_offset(window.weight[k], (k - middle) * between, blur, j, k, fit.bell_down, fit)


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED, **BORROWED)
@no_type_check
def _one_offset(weight: float, along: float, blur: float, j: int, k: int, bell: np.ndarray, fit: Fit) -> None:
    """Weighted steps and derivatives at one offset, `along` blurs from the middle one, where exp(-x^2 / 2) is the bell: the step
    by C. Hastings' approximation of erf (Abramowitz and Stegun 7.1.26), good to 8e-8."""
    level = -weight / (blur * 2.5066282746310002)
    for n in range(len(fit.total)):
        x = fit.first[n] + along
        t = 1.0 / (1.0 + 0.2316418882663604 * abs(x))
        tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429)))) * bell[n]
        fit.design[1 + j, k, n] = weight * math.copysign(0.5 - 0.5 * tail, x)
        fit.slope[j, k, n] = level * bell[n]


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
def heights(window: Window, place: np.ndarray, steps: int, blur: float, fit: Fit) -> None:
    """Fill the design D for steps at these places, its slope, the factor of N = D'D + R, the ridge R and the heights
    h = N^-1 D'y; and the sum of squares that they leave of y, y'y - h'D'y - h'Rh."""
    lanes = len(fit.total)
    design, factor, ridge, height = fit.design, fit.factor, fit.ridge, fit.height
    scaled, squares, total = fit.scaled, fit.squares, fit.total
    for j in range(steps):
        _blurred_step(window, place, blur, j, fit)
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
        squares[n] = fit.energy[n]
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
        for p in range(steps + 1):
            for n in range(lanes):
                squares[n] -= height[c, p, n] * ridge[p, n] * height[c, p, n]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def newton(steps: int, fit: Fit, move: Move) -> None:
    """Normal matrix and right side of the places, with the heights projected out. With s a slope, r = y - D h what is left and
    w = D's, they hold s's - 2 w' N^-1 w + w' N^-1 D'D N^-1 w and s'r - w' N^-1 D'r, where D'r = R h."""
    lanes = len(fit.total)
    scaled, design, slope, total = fit.scaled, fit.design, fit.slope, fit.total
    factor, ridge, height = fit.factor, fit.ridge, fit.height
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
