"""Two edges so near to each other that they look like one: profiles fitted with two blurred steps, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

STEPS = 6
MOST_MOVE_PX = 1.5


@njit(cache=True, nogil=True)
@no_type_check
def _design(offsets: np.ndarray, weight: np.ndarray, x1: float, x2: float, blur: float, design: np.ndarray) -> None:
    """Columns: level, step at x1, step at x2, and the changes of both steps with their places; weighted."""
    for k in range(len(offsets)):
        a, b = (offsets[k] - x1) / blur, (offsets[k] - x2) / blur
        design[k, 0] = weight[k]
        design[k, 1] = weight[k] * 0.5 * math.erf(a * 0.7071067811865476)
        design[k, 2] = weight[k] * 0.5 * math.erf(b * 0.7071067811865476)
        design[k, 3] = -weight[k] * 0.3989422804014327 * math.exp(-0.5 * a * a) / blur
        design[k, 4] = -weight[k] * 0.3989422804014327 * math.exp(-0.5 * b * b) / blur


@njit(cache=True, nogil=True)
@no_type_check
def _linear(design: np.ndarray, columns: int, profile: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients (columns, c) of the first columns and the sum of squared residuals."""
    part = np.ascontiguousarray(design[:, :columns])
    normal = part.T @ part
    for p in range(columns):
        normal[p, p] += 1e-9 * (1.0 + normal[p, p])
    found = np.linalg.solve(normal, part.T @ profile)
    left = profile - part @ found
    return found, (left * left).sum()


@njit(cache=True, nogil=True)
@no_type_check
def _settled(
    scaled: np.ndarray, offsets: np.ndarray, weight: np.ndarray, pair: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Places of both steps of one weighted profile (k, c), moved from `pair` by Gauss and Newton; the linear coefficients (3, c)
    and the sum of squared residuals there."""
    size, channels = scaled.shape
    design = np.empty((size, 5))
    x1, x2 = pair[0], pair[1]
    cost = np.inf
    kept1, kept2 = x1, x2
    kept = np.zeros((3, channels))
    for _ in range(STEPS):
        _design(offsets, weight, x1, x2, blur, design)
        found, misfit = _linear(design, 3, scaled)
        if misfit >= cost:
            x1, x2 = 0.5 * (x1 + kept1), 0.5 * (x2 + kept2)
            continue
        cost, kept1, kept2, kept = misfit, x1, x2, found
        rest = scaled - np.ascontiguousarray(design[:, :3]) @ found
        # Gauss and Newton: both places, with the linear part projected out.
        a00, a01, a11, r0, r1 = 1e-9, 0.0, 1e-9, 0.0, 0.0
        basis = np.ascontiguousarray(design[:, :3])
        inner = basis.T @ basis + 1e-9 * np.eye(3)
        slopes = np.ascontiguousarray(design[:, 3:])
        slopes = slopes - basis @ np.linalg.solve(inner, basis.T @ slopes)
        for c in range(channels):
            for k in range(size):
                j1, j2 = slopes[k, 0] * found[1, c], slopes[k, 1] * found[2, c]
                a00 += j1 * j1
                a01 += j1 * j2
                a11 += j2 * j2
                r0 += j1 * rest[k, c]
                r1 += j2 * rest[k, c]
        a00, a11 = a00 * 1.01, a11 * 1.01
        determinant = a00 * a11 - a01 * a01
        x1 += min(max((a11 * r0 - a01 * r1) / determinant, -0.5), 0.5)
        x2 += min(max((a00 * r1 - a01 * r0) / determinant, -0.5), 0.5)
        x1 = min(max(x1, pair[0] - MOST_MOVE_PX), pair[0] + MOST_MOVE_PX)
        x2 = min(max(x2, pair[1] - MOST_MOVE_PX), pair[1] + MOST_MOVE_PX)
    return np.array([kept1, kept2]), kept, cost


@njit(cache=True, nogil=True)
@no_type_check
def two_steps(
    profile: np.ndarray, offsets: np.ndarray, weight: np.ndarray, starts: np.ndarray, pairs: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (m, 2) of two steps in each of m mean profiles (m, k, c) of pieces of arcs, and the steps' colours (m, 2, c).

    Also, of each arc, the sums of squared residuals with one step and with two. The pair of places that fits all pieces of
    an arc best is where each piece begins; one step may lie anywhere in the middle of the window too.
    """
    count, size, channels = profile.shape
    place, colour = np.zeros((count, 2)), np.zeros((count, 2, channels))
    arcs = len(starts) - 1
    single, double = np.zeros(arcs), np.zeros(arcs)
    design = np.empty((size, 5))
    # What a pair of places cannot explain is a projection, the same for every profile.
    left = np.empty((len(pairs), size, size))
    for p in range(len(pairs)):
        _design(offsets, weight, pairs[p, 0], pairs[p, 1], blur, design)
        part = np.ascontiguousarray(design[:, :3])
        left[p] = np.eye(size) - part @ np.linalg.pinv(part)
    grid = np.arange(-4, 5) * 0.25
    alone = np.empty((len(grid), size, size))
    for p in range(len(grid)):
        _design(offsets, weight, grid[p], 0.0, blur, design)
        part = np.ascontiguousarray(design[:, :2])
        alone[p] = np.eye(size) - part @ np.linalg.pinv(part)
    for arc in range(arcs):
        begin, end = starts[arc], starts[arc + 1]
        if begin == end:
            continue
        scaled = np.empty((end - begin, size, channels))
        for n in range(begin, end):
            for k in range(size):
                for c in range(channels):
                    scaled[n - begin, k, c] = profile[n, k, c] * weight[k]
        # Second moments of all pieces: the misfit of a projection is its trace with them.
        moment = np.zeros((size, size))
        for n in range(end - begin):
            moment += scaled[n] @ scaled[n].T
        single[arc] = np.inf
        for p in range(len(grid)):
            single[arc] = min(single[arc], (alone[p] * moment).sum())
        best, least = 0, np.inf
        for p in range(len(pairs)):
            misfit = (left[p] * moment).sum()
            if misfit < least:
                best, least = p, misfit
        for n in range(begin, end):
            places, kept, cost = _settled(scaled[n - begin], offsets, weight, pairs[best], blur)
            place[n] = places
            colour[n, 0], colour[n, 1] = kept[1], kept[2]
            double[arc] += cost
    return place, colour, single, double
