"""The least-squares fit of saddle.py, compiled: one corner after another, each by Levenberg and Marquardt's method.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit
from scipy.special import ndtr

PARAMETERS = 11
"""u, v, two edge angles, two log blurs, gain, a, l_u, l_v, b."""
MIN_BLUR_PX = 0.3
FEW_PIXELS = 2 * PARAMETERS
"""A window of fewer pixels than this is widened to the 5 x 5 around the corner."""
_FAR, _PER_UNIT = 6.0, 64
"""The normal distribution function is 0 or 1 to 1e-9 beyond _FAR, and cubic between so many knots a unit to 1e-9."""
_ANY_ORDER = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be taken in any order, which lets the compiler use the processor's vectors."""


def _cubics() -> np.ndarray:
    """Coefficients of the cubics that have the value and the slope of the distribution function at either end of a step."""
    knots = np.arange(-_FAR * _PER_UNIT, _FAR * _PER_UNIT + 2) / _PER_UNIT
    value, slope = ndtr(knots), np.exp(-0.5 * knots**2) / math.sqrt(2.0 * math.pi) / _PER_UNIT
    rise = np.diff(value)
    first, last = slope[:-1], slope[1:]
    return np.stack([value[:-1], first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise])


_C0, _C1, _C2, _C3 = _cubics()


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER)
@no_type_check
def _normal(x: np.ndarray, cdf: np.ndarray, density: np.ndarray, count: int) -> None:
    """The normal distribution function and its density at the first `count` values."""
    for k in range(count):
        at = (min(max(x[k], -_FAR), _FAR) + _FAR) * _PER_UNIT
        cell = np.int32(at)
        t = at - cell
        c1, c2, c3 = _C1[cell], _C2[cell], _C3[cell]
        cdf[k] = _C0[cell] + t * (c1 + t * (c2 + t * c3))
        density[k] = (c1 + t * (2.0 * c2 + 3.0 * t * c3)) * _PER_UNIT


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER)
@no_type_check
def linearised(
    p: np.ndarray,
    curvature: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    grey: np.ndarray,
    jacobian: np.ndarray,
    left: np.ndarray,
    work: np.ndarray,
) -> float:
    """Sum of squared residuals (observed minus model) of one corner at `p` (11); fills the model's derivatives (11 x k or more
    columns, so that rows are contiguous) and the residuals (k). `work` (12 x k or more) is overwritten."""
    cos_1, sin_1, cos_2, sin_2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    blur_1, blur_2 = math.exp(p[4]), math.exp(p[5])
    per_1, per_2 = 1.0 / blur_1, 1.0 / blur_2
    side = -1.0 if p[6] < 0 else 1.0
    gain, level, contrast = abs(p[6]), p[7], p[10]
    # Blur along an edge moves it towards the inside of its bend; the blur along one edge is that across the other.
    bent_1, bent_2 = curvature[0] * blur_2 * blur_2, curvature[1] * blur_1 * blur_1
    # Loops of few arrays each, which the compiler turns into vector instructions.
    for k in range(len(u)):
        du, dv = u[k] - p[0], v[k] - p[1]
        along_1, along_2 = cos_1 * du + sin_1 * dv, cos_2 * du + sin_2 * dv
        h_1 = cos_1 * dv - sin_1 * du - 0.5 * (curvature[0] * along_1 * along_1 + bent_1)
        h_2 = -side * (cos_2 * dv - sin_2 * du - 0.5 * (curvature[1] * along_2 * along_2 + bent_2))
        work[0, k], work[1, k] = (h_1 - gain) * per_1, (h_2 - gain) * per_2
        work[2, k], work[3, k] = (-h_1 - gain) * per_1, (-h_2 - gain) * per_2
    for m in range(4):
        _normal(work[m], work[4 + m], work[8 + m], len(u))
    cost = 0.0
    for k in range(len(u)):
        du, dv = u[k] - p[0], v[k] - p[1]
        along_1, across_1 = cos_1 * du + sin_1 * dv, cos_1 * dv - sin_1 * du
        along_2, across_2 = cos_2 * du + sin_2 * dv, cos_2 * dv - sin_2 * du
        a, b, c, d, cdf_a, cdf_b, cdf_c, cdf_d = work[:8, k]
        by_a, by_b, by_c, by_d = work[8, k] * cdf_b, work[9, k] * cdf_a, work[10, k] * cdf_d, work[11, k] * cdf_c
        product = side * (1.0 - 2.0 * (cdf_a * cdf_b + cdf_c * cdf_d))
        by_h_1 = -2.0 * side * (by_a - by_c) * per_1
        by_h_2 = 2.0 * (by_b - by_d) * per_2
        light = 1.0 + p[8] * du + p[9] * dv
        ink = level + contrast * product
        step = light * contrast
        bend_1, bend_2 = curvature[0] * along_1, curvature[1] * along_2
        jacobian[0, k] = step * (by_h_1 * (sin_1 + bend_1 * cos_1) + by_h_2 * (sin_2 + bend_2 * cos_2)) - p[8] * ink
        jacobian[1, k] = step * (by_h_1 * (bend_1 * sin_1 - cos_1) + by_h_2 * (bend_2 * sin_2 - cos_2)) - p[9] * ink
        jacobian[2, k] = -step * by_h_1 * along_1 * (1.0 + curvature[0] * across_1)
        jacobian[3, k] = -step * by_h_2 * along_2 * (1.0 + curvature[1] * across_2)
        jacobian[4, k] = step * (2.0 * side * (a * by_a + c * by_c) - by_h_2 * bent_2)
        jacobian[5, k] = step * (2.0 * side * (b * by_b + d * by_d) - by_h_1 * bent_1)
        jacobian[6, k] = 2.0 * step * ((by_a + by_c) * per_1 + (by_b + by_d) * per_2)
        jacobian[7, k] = light
        jacobian[8, k] = du * ink
        jacobian[9, k] = dv * ink
        jacobian[10, k] = light * product
        left[k] = grey[k] - light * ink
        cost += left[k] * left[k]
    return cost


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER)
@no_type_check
def _products(jacobian: np.ndarray, left: np.ndarray, normal: np.ndarray, slope: np.ndarray) -> None:
    """J'J (11 x 11) and J'r (11)."""
    for m in range(PARAMETERS):
        row = jacobian[m]
        total = 0.0
        for k in range(len(left)):
            total += row[k] * left[k]
        slope[m] = total
        for n in range(m + 1):
            other = jacobian[n]
            total = 0.0
            for k in range(len(left)):
                total += row[k] * other[k]
            normal[m, n] = total
            normal[n, m] = total


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER)
@no_type_check
def _lit(
    p: np.ndarray,
    curvature: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    grey: np.ndarray,
    jacobian: np.ndarray,
    left: np.ndarray,
    scratch: np.ndarray,
) -> float:
    """`linearised` at the level and contrast that suit the rest of `p` best, which `p` takes on; its light does not change."""
    p[7:] = 0.0
    p[10] = 1.0
    linearised(p, curvature, u, v, grey, jacobian, left, scratch)
    aa, ab, bb, a, b = len(u) + 1e-9, 0.0, 1e-9, 0.0, 0.0
    for k in range(len(u)):
        product = jacobian[10, k]
        ab, bb = ab + product, bb + product * product
        a, b = a + grey[k], b + product * grey[k]
    level, contrast = (a * bb - b * ab) / (aa * bb - ab * ab), (b * aa - a * ab) / (aa * bb - ab * ab)
    p[7], p[10] = level, contrast
    cost = 0.0
    for k in range(len(u)):
        for m in range(7):
            jacobian[m, k] *= contrast
        ink = level + contrast * jacobian[10, k]
        jacobian[8, k], jacobian[9, k] = (u[k] - p[0]) * ink, (v[k] - p[1]) * ink
        left[k] = grey[k] - ink
        cost += left[k] * left[k]
    return cost


@njit(cache=True, nogil=True)
@no_type_check
def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution for a positive definite matrix, by Cholesky's factors, which overwrite it."""
    size = len(right)
    x = right.copy()
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            # The damping keeps pivots above this share, but for rounding.
            matrix[i, j] = math.sqrt(max(total, 1e-13 * matrix[i, i] + 1e-300)) if i == j else total / matrix[j, j]
        for k in range(i):
            x[i] -= matrix[i, k] * x[k]
        x[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x[i] -= matrix[k, i] * x[k]
        x[i] /= matrix[i, i]
    return x


@njit(cache=True, nogil=True)
@no_type_check
def _spread(normal: np.ndarray) -> float:
    """Mean of the first two diagonal elements of the inverse of J'J."""
    scale = 1e-6 + np.sqrt(np.diag(normal))
    total = 0.0
    for m in range(2):
        unit = np.zeros(PARAMETERS)
        unit[m] = 1.0
        scaled = normal / np.outer(scale, scale)
        for n in range(PARAMETERS):
            scaled[n, n] += 1e-9
        total += 0.5 * _solved(scaled, unit)[m] / scale[m] ** 2
    return total


@njit(cache=True, nogil=True)
@no_type_check
def _window(
    image: np.ndarray,
    corner: np.ndarray,
    into_squares: np.ndarray,
    plain: np.ndarray,
    half: int,
    stride: int,
    reach: float,
    u: np.ndarray,
    v: np.ndarray,
    grey: np.ndarray,
) -> int:
    """The pixels of a corner's window, one in `stride` of each row and column: within `reach` squares of it, within `half` px,
    and in what is of one colour."""
    height, width = image.shape
    row, column = round(corner[1]), round(corner[0])
    count, few = 0, False
    for attempt in range(2):
        near = 0
        count = 0
        for y in range(row - half, row + half + 1, stride):
            for x in range(column - half, column + half + 1, stride):
                du, dv = x - corner[0], y - corner[1]
                s = into_squares[0, 0] * du + into_squares[0, 1] * dv
                t = into_squares[1, 0] * du + into_squares[1, 1] * dv
                inside = max(abs(s), abs(t)) < reach and du * du + dv * dv < (half + 0.5) ** 2
                near += inside
                if not (inside or (few and max(abs(du), abs(dv)) < 2.51)):
                    continue
                if x < 0 or y < 0 or x >= width or y >= height or min(abs(s), abs(t)) >= plain[int(t > 0), int(s > 0)]:
                    continue
                u[count], v[count], grey[count] = x, y, image[y, x]
                count += 1
        few = near < FEW_PIXELS
        if not few or attempt == 1:
            break
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _fit(
    p: np.ndarray, curvature: np.ndarray, work: tuple, log_blur: tuple[float, float], max_steps: int, settled_px: float
) -> tuple[float, bool]:
    """One corner: the sum of squared residuals at the solution, which `p` becomes, and whether it had stopped moving."""
    u, v, grey, jacobian, left, scratch, normal, slope = work
    cost = _lit(p, curvature, u, v, grey, jacobian, left, scratch)
    _products(jacobian, left, normal, slope)
    damping, settled = 1e-3, False
    damped = np.empty((PARAMETERS, PARAMETERS))
    for _ in range(max_steps):
        damped[:] = normal
        for m in range(PARAMETERS):
            damped[m, m] += damping * normal[m, m] + 1e-9 * (1.0 + normal[m, m])
        step = _solved(damped, slope)
        trial = p + step
        trial[4], trial[5] = min(max(trial[4], log_blur[0]), log_blur[1]), min(max(trial[5], log_blur[0]), log_blur[1])
        trial_cost = linearised(trial, curvature, u, v, grey, jacobian, left, scratch)
        settled = max(abs(step[0]), abs(step[1])) < settled_px
        better = trial_cost <= cost
        damping *= 0.2 if better else 10.0
        if better:
            p[:], cost = trial, trial_cost
            _products(jacobian, left, normal, slope)
        if settled:
            break
    return cost, settled


@njit(cache=True, nogil=True)
@no_type_check
def fit_all(
    image: np.ndarray,
    parameters: np.ndarray,
    curvature: np.ndarray,
    into_squares: np.ndarray,
    plain: np.ndarray,
    half: int,
    stride: int,
    reach: float,
    max_blur_px: float,
    max_steps: int,
    settled_px: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit every corner from its start, whose level and contrast are solved for; `parameters` (n x 11) become the solution.

    `image` (h x w), windows as `saddle.fit_corners` states: `into_squares` (n x 2 x 2) takes pixels to squares, `plain`
    (n x 2 x 2), `half` px and `reach` squares limit them, of whose pixels one in `stride` each way
    is used. Returns the number of pixels in each window, the sums of squared
    residuals, the mean variance of both coordinates for noise of one grey level, and whether the corner had stopped moving.
    """
    total, most = len(parameters), (2 * half + 1) ** 2
    counts, costs, settled = np.empty(total, np.int64), np.empty(total), np.zeros(total, dtype=np.bool_)
    spreads, normal, slope = np.empty(total), np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    u, v, grey, left = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    jacobian, scratch = np.empty((PARAMETERS, most)), np.empty((12, most))
    log_blur = (math.log(MIN_BLUR_PX), math.log(max_blur_px))
    for i in range(total):
        n = _window(image, parameters[i, :2].copy(), into_squares[i], plain[i], half, stride, reach, u, v, grey)
        work = (u[:n], v[:n], grey[:n], jacobian, left[:n], scratch, normal, slope)
        costs[i], settled[i] = _fit(parameters[i], curvature[i], work, log_blur, max_steps, settled_px)
        counts[i], spreads[i] = n, _spread(normal)
    return counts, costs, spreads, settled
