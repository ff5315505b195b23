"""The great circle through the shifts measured along an arc; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED

LEAST_SCALE_PX = 0.05
"""Of the robust weights: smaller residuals are not told apart."""
ROUNDS = 4
BEGIN = np.array([0.0, 0.0, 1e9])
"""Of rounds: no change, and a scale at which all residuals count."""


@njit(cache=True, nogil=True)
@no_type_check
def own_samples(begin: int, end: int, shift: np.ndarray, usable: np.ndarray, most_shift_px: float) -> np.ndarray:
    """Samples of an arc that are usable and not of another edge."""
    chosen = np.empty(end - begin, dtype=np.int64)
    count = 0
    for n in range(begin, end):
        if usable[n] and abs(shift[n]) < most_shift_px:
            chosen[count] = n
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _leftover(way: np.ndarray, shift: np.ndarray, a: float, b: float, left: np.ndarray) -> None:
    """Residuals of shifts about the circle changed by (a, b), for the way (n, 2) that a point goes with either."""
    for i in range(len(shift)):
        left[i] = shift[i] - a * way[i, 0] - b * way[i, 1]


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _normal_matrix(
    way: np.ndarray, shift: np.ndarray, share: np.ndarray, a: float, b: float, scale: float, weight: np.ndarray
) -> tuple[float, float, float, float, float]:
    """Matrix (m00, m01, m11) and right side of the least squares for (a, b). Their weights are the shares times Tukey's of the
    residuals about the circle changed by (a, b) as they are."""
    m00, m01, m11, r0, r1 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(shift)):
        x, y = way[i, 0], way[i, 1]
        ratio = (shift[i] - a * x - b * y) / (4.7 * scale)
        w = (1.0 - ratio * ratio) ** 2 * share[i] if abs(ratio) < 1.0 else 0.0
        weight[i] = w
        m00 += w * x * x
        m01 += w * x * y
        m11 += w * y * y
        r0 += w * x * shift[i]
        r1 += w * y * shift[i]
    return m00, m01, m11, r0, r1


@njit(cache=True, nogil=True)
@no_type_check
def fit_circle(
    way: np.ndarray, off: np.ndarray, share: np.ndarray, start: np.ndarray, rounds: int, weight: np.ndarray, left: np.ndarray
) -> tuple[np.ndarray, np.ndarray, bool]:
    """The change (a, b) of the normal of an arc and the scale of the residuals, and the normal matrix (m00, m01, m11), by so many
    rounds of weighted least squares from the change and scale `start`; false where they are not defined.

    The places of the edge are `off` (n) for the `way` (n, 2) that a point goes with either. Weights are the shares times Tukey's
    of the residuals; they and the residuals are filled in.
    """
    a, b, scale = start[0], start[1], start[2]
    m00, m01, m11, good = 0.0, 0.0, 0.0, False
    for _ in range(rounds):
        m00, m01, m11, r0, r1 = _normal_matrix(way, off, share, a, b, scale, weight)
        determinant = m00 * m11 - m01 * m01
        good = determinant > 1e-12 * m00 * m11
        if not good:
            break
        a, b = (m11 * r0 - m01 * r1) / determinant, (m00 * r1 - m01 * r0) / determinant
        _leftover(way, off, a, b, left)
        scale = max(1.4826 * np.median(np.abs(left)), LEAST_SCALE_PX)
    return np.array([a, b, scale]), np.array([m00, m01, m11]), good


@njit(cache=True, nogil=True)
@no_type_check
def ways(angle: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """How far (n, 2) samples of an arc go across with either of the two changes of its normal."""
    way = np.empty((len(angle), 2))
    for n in range(len(angle)):
        way[n, 0], way[n, 1] = -rate[n] * math.cos(angle[n]), -rate[n] * math.sin(angle[n])
    return way


@njit(cache=True, nogil=True)
@no_type_check
def shares(strength: np.ndarray) -> np.ndarray:
    """Weights of samples: they rise with the contrast, up to 1."""
    return strength / (strength + np.median(strength))


@njit(cache=True, nogil=True)
@no_type_check
def scatter_of(weight: np.ndarray, left: np.ndarray) -> tuple[float, int]:
    """Sum of w^2 r^2 over sum of w: the variance that the inverse of sum w x x' is to be multiplied by, for residuals whose
    variance is not 1 / w; and how many of them have a weight."""
    total, squares, kept = 1e-300, 0.0, 0
    for i in range(len(weight)):
        if weight[i] > 0.0:
            total += weight[i]
            squares += (weight[i] * left[i]) ** 2
            kept += 1
    return squares / total * kept / max(kept - 2, 1), kept


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def invert(matrix: np.ndarray, inverse: np.ndarray) -> None:
    """Fill the inverse (2, 2) of a normal matrix (m00, m01, m11)."""
    determinant = matrix[0] * matrix[2] - matrix[1] * matrix[1]
    inverse[0, 0], inverse[1, 1] = matrix[2] / determinant, matrix[0] / determinant
    inverse[0, 1] = inverse[1, 0] = -matrix[1] / determinant


@njit(cache=True, nogil=True)
@no_type_check
def fit_circles(
    starts: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    shift: np.ndarray,
    strength: np.ndarray,
    usable: np.ndarray,
    most_shift_px: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each arc the change (a, b) of its normal, the inverse normal matrix (2, 2), the residuals' variance that it is to be
    multiplied by, and the number of samples used; and the residuals of all samples (NaN where there is none).

    A point at angle t moves by -rate (a cos t + b sin t) px across. Weights fall with the contrast, and by Tukey's function
    with the residual; shifts of `most_shift_px` or more are another edge.
    """
    arcs = len(starts) - 1
    change, inverse, variance = np.zeros((arcs, 2)), np.zeros((arcs, 2, 2)), np.zeros(arcs)
    used = np.zeros(arcs)
    residual = np.full(len(angle), np.nan)
    for arc in range(arcs):
        chosen = own_samples(starts[arc], starts[arc + 1], shift, usable, most_shift_px)
        count = len(chosen)
        if count < 3:
            continue
        weight, left = np.empty(count), np.empty(count)
        found, matrix, good = fit_circle(
            ways(angle[chosen], rate[chosen]), shift[chosen], shares(strength[chosen]), BEGIN, ROUNDS, weight, left
        )
        if not good:
            continue
        change[arc] = found[:2]
        invert(matrix, inverse[arc])
        variance[arc], used[arc] = scatter_of(weight, left)
        residual[chosen] = left
    return change, inverse, variance, used, residual
