"""The least-squares fit of saddle.py, compiled: one corner after another, each by Levenberg and Marquardt's method.

All that a corner's window needs is in one flat buffer, in rows of ROW_LENGTH: distances that the compiler knows let it use the
processor's vectors, which it does not for rows that might overlap. Pixels and corner are counted from the middle of the window.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit
from scipy.special import ndtr

from calib_patterns.kernels.saddle_window import FIRST_FREE_ROW, GREY, PARAMETERS, ROW_LENGTH, U, V, window

JACOBIAN, LEFT, BUFFER_ROWS = FIRST_FREE_ROW, FIRST_FREE_ROW + PARAMETERS, FIRST_FREE_ROW + PARAMETERS + 1
"""More rows of the buffer: derivatives of the model, and what it leaves (observed minus model)."""
MIN_BLUR_PX = 0.3
_FAR, _PER_UNIT = 6.0, 64
"""The normal distribution function is 0 or 1 to 1e-9 beyond _FAR; its expansion around so many knots a unit is exact to 1e-9,
that of its density to 1e-7."""
_ANY_ORDER = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be taken in any order, which lets the compiler use the processor's vectors."""
_KNOTS = np.arange(-_FAR * _PER_UNIT, _FAR * _PER_UNIT + 1) / _PER_UNIT
_CDF = ndtr(_KNOTS)
_DENSITY = np.exp(-0.5 * _KNOTS**2) / math.sqrt(2.0 * math.pi)


@njit(inline="always", error_model="numpy")
@no_type_check
def _normal(x):
    """The normal distribution function and its density, by Taylor's series at the nearest knot."""
    # In this order what is no number, after a step that ran away, has a cell as well.
    at = min(max(-_FAR, x), _FAR)
    cell = np.int32(at * _PER_UNIT + _FAR * _PER_UNIT + 0.5)
    knot = cell / _PER_UNIT - _FAR
    t = at - knot
    at_knot = np.uintp(cell)
    density, kt = _DENSITY[at_knot], knot * t
    third = (knot * knot - 1.0) * t * t
    cdf = _CDF[at_knot] + density * t * (1.0 - 0.5 * kt + third / 6.0)
    return cdf, density * (1.0 - kt + 0.5 * third)


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER, error_model="numpy")
@no_type_check
def linearised(p: np.ndarray, curvature: np.ndarray, rows: np.ndarray, count: int) -> float:
    """Sum of squared residuals of one corner at `p` (11); fills the rows of the model's derivatives and the residuals for the
    first `count` pixels of `rows`, whose middle the corner is counted from."""
    p_u, p_v, light_u, light_v = p[0], p[1], p[8], p[9]
    cos_1, sin_1, cos_2, sin_2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    blur_1, blur_2 = math.exp(p[4]), math.exp(p[5])
    per_1, per_2 = 1.0 / blur_1, 1.0 / blur_2
    side = -1.0 if p[6] < 0 else 1.0
    gain, level, contrast = abs(p[6]), p[7], p[10]
    bend_of_1, bend_of_2 = curvature[0], curvature[1]
    # Blur along an edge moves it towards the inside of its bend; the blur along one edge is that across the other.
    bent_1, bent_2 = bend_of_1 * blur_2 * blur_2, bend_of_2 * blur_1 * blur_1
    cost = 0.0
    for k in range(count):
        du, dv = rows[U * ROW_LENGTH + k] - p_u, rows[V * ROW_LENGTH + k] - p_v
        along_1, across_1 = cos_1 * du + sin_1 * dv, cos_1 * dv - sin_1 * du
        along_2, across_2 = cos_2 * du + sin_2 * dv, cos_2 * dv - sin_2 * du
        bend_1, bend_2 = bend_of_1 * along_1, bend_of_2 * along_2
        h_1 = across_1 - 0.5 * (bend_1 * along_1 + bent_1)
        h_2 = -side * (across_2 - 0.5 * (bend_2 * along_2 + bent_2))
        a, b, c, d = (h_1 - gain) * per_1, (h_2 - gain) * per_2, (-h_1 - gain) * per_1, (-h_2 - gain) * per_2
        cdf_a, by_a = _normal(a)
        cdf_b, by_b = _normal(b)
        cdf_c, by_c = _normal(c)
        cdf_d, by_d = _normal(d)
        by_a, by_b, by_c, by_d = by_a * cdf_b, by_b * cdf_a, by_c * cdf_d, by_d * cdf_c
        product = side * (1.0 - 2.0 * (cdf_a * cdf_b + cdf_c * cdf_d))
        light = 1.0 + light_u * du + light_v * dv
        ink = level + contrast * product
        step = 2.0 * light * contrast
        by_h_1 = -step * side * (by_a - by_c) * per_1
        by_h_2 = step * (by_b - by_d) * per_2
        rows[JACOBIAN * ROW_LENGTH + k] = by_h_1 * (sin_1 + bend_1 * cos_1) + by_h_2 * (sin_2 + bend_2 * cos_2) - light_u * ink
        rows[(JACOBIAN + 1) * ROW_LENGTH + k] = (
            by_h_1 * (bend_1 * sin_1 - cos_1) + by_h_2 * (bend_2 * sin_2 - cos_2) - light_v * ink
        )
        rows[(JACOBIAN + 2) * ROW_LENGTH + k] = -by_h_1 * along_1 * (1.0 + bend_of_1 * across_1)
        rows[(JACOBIAN + 3) * ROW_LENGTH + k] = -by_h_2 * along_2 * (1.0 + bend_of_2 * across_2)
        rows[(JACOBIAN + 4) * ROW_LENGTH + k] = step * side * (a * by_a + c * by_c) - by_h_2 * bent_2
        rows[(JACOBIAN + 5) * ROW_LENGTH + k] = step * side * (b * by_b + d * by_d) - by_h_1 * bent_1
        rows[(JACOBIAN + 6) * ROW_LENGTH + k] = step * ((by_a + by_c) * per_1 + (by_b + by_d) * per_2)
        rows[(JACOBIAN + 7) * ROW_LENGTH + k] = light
        rows[(JACOBIAN + 8) * ROW_LENGTH + k] = du * ink
        rows[(JACOBIAN + 9) * ROW_LENGTH + k] = dv * ink
        rows[(JACOBIAN + 10) * ROW_LENGTH + k] = light * product
        left = rows[GREY * ROW_LENGTH + k] - light * ink
        rows[LEFT * ROW_LENGTH + k] = left
        cost += left * left
    return cost


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER)
@no_type_check
def _products(rows: np.ndarray, count: int, products: np.ndarray) -> None:
    """J'J and J'r: the products (12 x 12, the lower triangle) of the derivatives and the residuals, three rows by three."""
    # Unsigned: indices that count from the end, or slices, would cost more than the sums.
    one, two = np.uintp(ROW_LENGTH), np.uintp(2 * ROW_LENGTH)
    for m in range(0, PARAMETERS + 1, 3):
        for n in range(0, m + 1, 3):
            ax, ay, az, bx, by, bz, cx, cy, cz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                at_a, at_x = np.uintp((JACOBIAN + m) * ROW_LENGTH + k), np.uintp((JACOBIAN + n) * ROW_LENGTH + k)
                a, b, c, x, y, z = rows[at_a], rows[at_a + one], rows[at_a + two], rows[at_x], rows[at_x + one], rows[at_x + two]
                ax, ay, az = ax + a * x, ay + a * y, az + a * z
                bx, by, bz = bx + b * x, by + b * y, bz + b * z
                cx, cy, cz = cx + c * x, cy + c * y, cz + c * z
            products[m, n], products[m, n + 1], products[m, n + 2] = ax, ay, az
            products[m + 1, n], products[m + 1, n + 1], products[m + 1, n + 2] = bx, by, bz
            products[m + 2, n], products[m + 2, n + 1], products[m + 2, n + 2] = cx, cy, cz


@njit(cache=True, nogil=True, fastmath=_ANY_ORDER, error_model="numpy")
@no_type_check
def _lit(p: np.ndarray, curvature: np.ndarray, rows: np.ndarray, count: int) -> float:
    """`linearised` at the level and contrast that suit the rest of `p` best, which `p` takes on; its light does not change."""
    p[7:] = 0.0
    p[10] = 1.0
    linearised(p, curvature, rows, count)
    p_u, p_v = p[0], p[1]
    aa, ab, bb, a, b = count + 1e-9, 0.0, 1e-9, 0.0, 0.0
    for k in range(count):
        product, grey = rows[(JACOBIAN + 10) * ROW_LENGTH + k], rows[GREY * ROW_LENGTH + k]
        ab, bb = ab + product, bb + product * product
        a, b = a + grey, b + product * grey
    p[7], p[10] = (a * bb - b * ab) / (aa * bb - ab * ab), (b * aa - a * ab) / (aa * bb - ab * ab)
    level, contrast, cost = p[7], p[10], 0.0
    for m in range(7):
        row = rows[(JACOBIAN + m) * ROW_LENGTH :][:count]
        for k in range(count):
            row[k] *= contrast
    for k in range(count):
        ink = level + contrast * rows[(JACOBIAN + 10) * ROW_LENGTH + k]
        rows[(JACOBIAN + 8) * ROW_LENGTH + k] = (rows[U * ROW_LENGTH + k] - p_u) * ink
        rows[(JACOBIAN + 9) * ROW_LENGTH + k] = (rows[V * ROW_LENGTH + k] - p_v) * ink
        left = rows[GREY * ROW_LENGTH + k] - ink
        rows[LEFT * ROW_LENGTH + k] = left
        cost += left * left
    return cost


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
@no_type_check
def _factor(matrix: np.ndarray) -> None:
    """Cholesky's factor of a positive definite matrix in its lower triangle, the diagonal inverted."""
    for i in range(PARAMETERS):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            # The damping keeps pivots above this share, but for rounding.
            matrix[i, j] = 1.0 / math.sqrt(max(total, 1e-13 * matrix[i, i] + 1e-300)) if i == j else total * matrix[j, j]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
@no_type_check
def _solve(factor: np.ndarray, x: np.ndarray) -> None:
    """The right side `x` becomes the solution, by what `_factor` returns."""
    for i in range(PARAMETERS):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total * factor[i, i]
    for i in range(PARAMETERS - 1, -1, -1):
        x[i] *= factor[i, i]
        for k in range(i):
            x[k] -= factor[i, k] * x[i]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _spread(products: np.ndarray, matrix: np.ndarray) -> float:
    """Mean of the first two diagonal elements of the inverse of J'J, of which `matrix` is overwritten."""
    last = PARAMETERS - 1
    # In reverse order, so that the last block of the factor is that of the two.
    for m in range(PARAMETERS):
        for n in range(m + 1):
            scale = (1e-6 + math.sqrt(products[last - m, last - m])) * (1e-6 + math.sqrt(products[last - n, last - n]))
            matrix[m, n] = products[last - n, last - m] / scale + (1e-9 if m == n else 0.0)
    _factor(matrix)
    v, across, u = matrix[last - 1, last - 1], matrix[last, last - 1], matrix[last, last]
    of_u, of_v = u * u, v * v * (1.0 + (across * u) ** 2)
    return 0.5 * (of_u / (1e-6 + math.sqrt(products[0, 0])) ** 2 + of_v / (1e-6 + math.sqrt(products[1, 1])) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fit(
    p: np.ndarray, curvature: np.ndarray, work: tuple, count: int, log_blur: tuple, max_steps: int, settled_px: float
) -> tuple:
    """One corner: the sum of squared residuals at the solution, which `p` becomes, and the length of the last step (px)."""
    rows, products, damped, step, trial = work
    cost = _lit(p, curvature, rows, count)
    _products(rows, count, products)
    damping, last_px = 1e-3, np.inf
    for _ in range(max_steps):
        for m in range(PARAMETERS):
            step[m] = products[PARAMETERS, m]
            for n in range(m + 1):
                damped[m, n] = products[m, n]
            damped[m, m] += damping * products[m, m] + 1e-9 * (1.0 + products[m, m])
        _factor(damped)
        _solve(damped, step)
        for m in range(PARAMETERS):
            trial[m] = p[m] + step[m]
        trial[4], trial[5] = min(max(trial[4], log_blur[0]), log_blur[1]), min(max(trial[5], log_blur[0]), log_blur[1])
        trial_cost = linearised(trial, curvature, rows, count)
        last_px = max(abs(step[0]), abs(step[1]))
        better = trial_cost <= cost
        damping *= 0.2 if better else 10.0
        if better:
            p[:], cost = trial, trial_cost
            _products(rows, count, products)
        if last_px < settled_px:
            break
    return cost, last_px


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
    (n x 2 x 2), `half` px (MAX_HALF_WINDOW_PX at most) and `reach` squares limit them, of whose pixels one in `stride` each way
    is used. Returns the number of pixels in each window, the sums of squared residuals, the mean variance of both coordinates
    for noise of one grey level, and how far the corner moved in its last step (px).
    """
    total = len(parameters)
    counts, costs, last_px = np.empty(total, np.int64), np.empty(total), np.empty(total)
    spreads, rows = np.empty(total), np.empty(BUFFER_ROWS * ROW_LENGTH)
    products, damped = np.empty((PARAMETERS + 1, PARAMETERS + 1)), np.empty((PARAMETERS, PARAMETERS))
    work = (rows, products, damped, np.empty(PARAMETERS), np.empty(PARAMETERS))
    log_blur = (math.log(MIN_BLUR_PX), math.log(max_blur_px))
    for i in range(total):
        p = parameters[i]
        counts[i] = window(image, p, into_squares[i], plain[i], half, stride, reach, rows)
        column, row = round(p[0]), round(p[1])
        p[0], p[1] = p[0] - column, p[1] - row
        costs[i], last_px[i] = _fit(p, curvature[i], work, counts[i], log_blur, max_steps, settled_px)
        p[0], p[1] = p[0] + column, p[1] + row
        spreads[i] = _spread(products, damped)
    return counts, costs, spreads, last_px
