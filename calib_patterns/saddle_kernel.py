"""The least-squares fit of saddle.py, compiled: one corner after another, each by Levenberg and Marquardt's method.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

PARAMETERS = 11
"""u, v, two edge angles, two log blurs, gain, a, l_u, l_v, b."""
SETTLED_PX = 1e-3
MIN_BLUR_PX = 0.3


@njit(cache=True, nogil=True)
@no_type_check
def _cdf(x: float) -> float:
    return 0.5 * math.erfc(-x * 0.7071067811865476)


@njit(cache=True, nogil=True)
@no_type_check
def _density(x: float) -> float:
    return 0.3989422804014327 * math.exp(-0.5 * x * x)


@njit(cache=True, nogil=True)
@no_type_check
def normal_equations(
    p: np.ndarray, curvature: np.ndarray, u: np.ndarray, v: np.ndarray, grey: np.ndarray, normal: np.ndarray, slope: np.ndarray
) -> float:
    """Sum of squared residuals (observed minus model) of one corner at `p` (11); fills J'J (11 x 11) and J'r (11)."""
    normal[:] = 0.0
    slope[:] = 0.0
    j = np.empty(PARAMETERS)
    cost = 0.0
    cos_1, sin_1, cos_2, sin_2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    blur_1, blur_2 = math.exp(p[4]), math.exp(p[5])
    side = -1.0 if p[6] < 0 else 1.0
    gain, level, contrast = abs(p[6]), p[7], p[10]
    for k in range(len(u)):
        du, dv = u[k] - p[0], v[k] - p[1]
        along_1, across_1 = cos_1 * du + sin_1 * dv, cos_1 * dv - sin_1 * du
        along_2, across_2 = cos_2 * du + sin_2 * dv, cos_2 * dv - sin_2 * du
        h_1 = across_1 - 0.5 * curvature[0] * along_1 * along_1
        h_2 = -side * (across_2 - 0.5 * curvature[1] * along_2 * along_2)
        a, b, c, d = (h_1 - gain) / blur_1, (h_2 - gain) / blur_2, (-h_1 - gain) / blur_1, (-h_2 - gain) / blur_2
        cdf_a, cdf_b, cdf_c, cdf_d = _cdf(a), _cdf(b), _cdf(c), _cdf(d)
        by_a, by_b, by_c, by_d = _density(a) * cdf_b, _density(b) * cdf_a, _density(c) * cdf_d, _density(d) * cdf_c
        product = side * (1.0 - 2.0 * (cdf_a * cdf_b + cdf_c * cdf_d))
        by_h_1 = -2.0 * side * (by_a - by_c) / blur_1
        by_h_2 = 2.0 * (by_b - by_d) / blur_2
        light = 1.0 + p[8] * du + p[9] * dv
        ink = level + contrast * product
        step = light * contrast
        residual = grey[k] - light * ink
        bend_1, bend_2 = curvature[0] * along_1, curvature[1] * along_2
        j[0] = step * (by_h_1 * (sin_1 + bend_1 * cos_1) + by_h_2 * (sin_2 + bend_2 * cos_2)) - p[8] * ink
        j[1] = step * (by_h_1 * (bend_1 * sin_1 - cos_1) + by_h_2 * (bend_2 * sin_2 - cos_2)) - p[9] * ink
        j[2] = -step * by_h_1 * along_1 * (1.0 + curvature[0] * across_1)
        j[3] = -step * by_h_2 * along_2 * (1.0 + curvature[1] * across_2)
        j[4] = 2.0 * side * step * (a * by_a + c * by_c)
        j[5] = 2.0 * side * step * (b * by_b + d * by_d)
        j[6] = 2.0 * step * ((by_a + by_c) / blur_1 + (by_b + by_d) / blur_2)
        j[7] = light
        j[8] = du * ink
        j[9] = dv * ink
        j[10] = light * product
        cost += residual * residual
        for m in range(PARAMETERS):
            slope[m] += j[m] * residual
            for n in range(m + 1):
                normal[m, n] += j[m] * j[n]
    for m in range(PARAMETERS):
        for n in range(m):
            normal[n, m] = normal[m, n]
    return cost


@njit(cache=True, nogil=True)
@no_type_check
def fit_all(
    parameters: np.ndarray,
    curvature: np.ndarray,
    pixels: np.ndarray,
    grey: np.ndarray,
    counts: np.ndarray,
    max_blur_px: float,
    max_steps: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit every corner from its start, whose level and contrast are solved for; `parameters` (n x 11) become the solution.

    `pixels` (n x k x 2) and `grey` (n x k) hold the windows, of which the first `counts` rows are used. Returns the sums of
    squared residuals, J'J at the solution and whether the corner had stopped moving.
    """
    total = len(parameters)
    costs, normals, settled = np.empty(total), np.empty((total, PARAMETERS, PARAMETERS)), np.zeros(total, dtype=np.bool_)
    normal, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    trial_normal, trial_slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    low, high = math.log(MIN_BLUR_PX), math.log(max_blur_px)
    for i in range(total):
        u, v, level = pixels[i, : counts[i], 0].copy(), pixels[i, : counts[i], 1].copy(), grey[i, : counts[i]]
        p = parameters[i].copy()
        p[7], p[10] = 0.0, 0.0
        normal_equations(p, curvature[i], u, v, level, normal, slope)
        # Without light and contrast the residual is the photo itself.
        determinant = (normal[7, 7] + 1e-9) * (normal[10, 10] + 1e-9) - normal[7, 10] ** 2
        p[7] = (slope[7] * (normal[10, 10] + 1e-9) - slope[10] * normal[7, 10]) / determinant
        p[10] = (slope[10] * (normal[7, 7] + 1e-9) - slope[7] * normal[7, 10]) / determinant
        damping = 1e-3
        cost = normal_equations(p, curvature[i], u, v, level, normal, slope)
        for _ in range(max_steps):
            damped = normal.copy()
            for m in range(PARAMETERS):
                damped[m, m] += damping * normal[m, m] + 1e-9 * (1.0 + normal[m, m])
            step = np.linalg.solve(damped, slope)
            trial = p + step
            trial[4], trial[5] = min(max(trial[4], low), high), min(max(trial[5], low), high)
            trial_cost = normal_equations(trial, curvature[i], u, v, level, trial_normal, trial_slope)
            settled[i] = max(abs(step[0]), abs(step[1])) < SETTLED_PX
            better = trial_cost <= cost
            damping *= 0.2 if better else 10.0
            if better:
                p, cost = trial, trial_cost
                normal, trial_normal = trial_normal, normal
                slope, trial_slope = trial_slope, slope
            if settled[i]:
                break
        parameters[i] = p
        costs[i] = cost
        normals[i] = normal
    return costs, normals, settled
