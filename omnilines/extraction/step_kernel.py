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

from omnilines.extraction.profile_kernel import REORDERED

MOST_STEPS = 6
"""Steps of one profile: its own and the nearest of its neighbours."""
ROUNDS = 5
SETTLED_PX = 0.003
_MOST_MOVE_PX = 0.5


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def _factor(matrix: np.ndarray, size: int) -> None:
    """Cholesky factor in the lower triangle, in place."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = math.sqrt(max(total, 1e-12))
            else:
                matrix[i, j] = total / matrix[j, j]


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def _solve(factor: np.ndarray, size: int, right: np.ndarray) -> None:
    """Solution of factor factor' x = right, in place."""
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * right[k]
        right[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = right[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * right[k]
        right[i] = total / factor[i, i]


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def _heights(
    offsets: np.ndarray, weight: np.ndarray, place: np.ndarray, steps: int, blur: float, scaled: np.ndarray, work: tuple
) -> float:
    """Fill `work` for steps at these places: design, factor, heights, what is left; its sum of squares."""
    design, factor, height, left = work[0], work[1], work[2], work[3]
    size, channels = scaled.shape
    columns = steps + 1
    for k in range(size):
        design[k, 0] = weight[k]
        for j in range(steps):
            design[k, 1 + j] = 0.5 * weight[k] * math.erf((offsets[k] - place[j]) / blur * 0.7071067811865476)
    for p in range(columns):
        for q in range(p + 1):
            total = 0.0
            for k in range(size):
                total += design[k, p] * design[k, q]
            factor[p, q] = total
        factor[p, p] *= 1.0 + 1e-6
    _factor(factor, columns)
    squares = 0.0
    for c in range(channels):
        for p in range(columns):
            total = 0.0
            for k in range(size):
                total += design[k, p] * scaled[k, c]
            height[c, p] = total
        _solve(factor, columns, height[c])
        for k in range(size):
            total = scaled[k, c]
            for p in range(columns):
                total -= design[k, p] * height[c, p]
            left[c, k] = total
            squares += total * total
    return squares


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def _newton(
    offsets: np.ndarray, weight: np.ndarray, place: np.ndarray, steps: int, blur: float, channels: int, work: tuple
) -> None:
    """Normal matrix and right side of the places, with the heights projected out."""
    design, factor, height, left, slope, hessian, pull, column = work
    size = len(offsets)
    for j in range(steps):
        for k in range(size):
            a = (offsets[k] - place[j]) / blur
            slope[j, k] = -weight[k] * 0.3989422804014327 / blur * math.exp(-0.5 * a * a)
        for p in range(steps + 1):
            total = 0.0
            for k in range(size):
                total += design[k, p] * slope[j, k]
            column[p] = total
        _solve(factor, steps + 1, column)
        for k in range(size):
            for p in range(steps + 1):
                slope[j, k] -= design[k, p] * column[p]
    for i in range(steps):
        pull[i] = 0.0
        for j in range(i + 1):
            inner, common = 0.0, 0.0
            for k in range(size):
                inner += slope[i, k] * slope[j, k]
            for c in range(channels):
                common += height[c, 1 + i] * height[c, 1 + j]
            hessian[i, j] = inner * common
        for c in range(channels):
            total = 0.0
            for k in range(size):
                total += slope[i, k] * left[c, k]
            pull[i] += height[c, 1 + i] * total


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def fit_steps(
    profile: np.ndarray,
    offsets: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    count: np.ndarray,
    stiff: np.ndarray,
    sigma: np.ndarray,
    blur: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places (m, s) of the steps of m profiles (m, k, c), begun at `start`; the variance of the first place (m), the heights
    (m, s, c) and what is left of the weighted profiles (m, k, c).

    Profile m has `count` steps and noise of `sigma` in each value. `stiff` (s) are the standard deviations in px of the
    first place about its start and of the others: a faint step stays where its own arc says.
    """
    m, size, channels = profile.shape
    place, variance = start.copy(), np.full(m, np.inf)
    heights, rest = np.zeros((m, MOST_STEPS, channels)), np.zeros((m, size, channels))
    work = (
        np.empty((size, MOST_STEPS + 1)),
        np.empty((MOST_STEPS + 1, MOST_STEPS + 1)),
        np.empty((channels, MOST_STEPS + 1)),
        np.empty((channels, size)),
        np.empty((MOST_STEPS, size)),
        np.empty((MOST_STEPS, MOST_STEPS)),
        np.empty(MOST_STEPS),
        np.empty(MOST_STEPS + 1),
    )
    hessian, pull = work[5], work[6]
    scaled, here, kept = np.empty((size, channels)), np.empty(MOST_STEPS), np.empty(MOST_STEPS)
    for n in range(m):
        steps = count[n]
        for k in range(size):
            for c in range(channels):
                scaled[k, c] = profile[n, k, c] * weight[k]
        square = sigma[n] * sigma[n]
        here[:steps] = start[n, :steps]
        kept[:steps] = start[n, :steps]
        least = np.inf
        for _ in range(ROUNDS):
            cost = _heights(offsets, weight, here, steps, blur[n], scaled, work)
            for j in range(steps):
                cost += square * ((here[j] - start[n, j]) / stiff[min(j, 1)]) ** 2
            if cost > least:
                for j in range(steps):
                    here[j] = 0.5 * (here[j] + kept[j])
                continue
            least = cost
            kept[:steps] = here[:steps]
            _newton(offsets, weight, here, steps, blur[n], channels, work)
            for j in range(steps):
                hold = square / stiff[min(j, 1)] ** 2
                hessian[j, j] += hold + 1e-9
                pull[j] += hold * (start[n, j] - here[j])
            _factor(hessian, steps)
            _solve(hessian, steps, pull)
            farthest = 0.0
            for j in range(steps):
                here[j] += min(max(pull[j], -_MOST_MOVE_PX), _MOST_MOVE_PX)
                farthest = max(farthest, abs(pull[j]))
            if farthest < SETTLED_PX:
                break
        _heights(offsets, weight, kept, steps, blur[n], scaled, work)
        pull[:steps] = 0.0
        pull[0] = 1.0
        _solve(hessian, steps, pull)
        variance[n] = square * pull[0]
        for j in range(steps):
            place[n, j] = kept[j]
            for c in range(channels):
                heights[n, j, c] = work[2][c, 1 + j]
        for k in range(size):
            for c in range(channels):
                rest[n, k, c] = work[3][c, k]
    return place, variance, heights, rest


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def crossings(
    pixel: np.ndarray,
    across: np.ndarray,
    own: np.ndarray,
    other_pixel: np.ndarray,
    other_across: np.ndarray,
    other: np.ndarray,
    height: int,
    width: int,
    closed: bool,
    reach_px: float,
    least_cosine: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the profiles at m pixels are crossed: places (m, s), the first 0 for the arc `own` (m) of the profile itself, then
    its nearest neighbours among points a pixel apart on arcs `other`; and the number of places."""
    cell = 8
    rows, columns = height // cell + 2, width // cell + 2
    head = np.full((rows, columns), -1, dtype=np.int32)
    following = np.full(len(other), -1, dtype=np.int32)
    for n in range(len(other)):
        i, j = int(other_pixel[n, 1]) // cell, int(other_pixel[n, 0]) // cell
        if 0 <= i < rows and 0 <= j < columns:
            following[n] = head[i, j]
            head[i, j] = n
    place, count = np.zeros((len(pixel), MOST_STEPS)), np.ones(len(pixel), dtype=np.int64)
    arcs, along_of, offset_of = np.empty(64, dtype=np.int64), np.empty(64), np.empty(64)
    last = width // cell
    for n in range(len(pixel)):
        u, v, x, y = pixel[n, 0], pixel[n, 1], across[n, 0], across[n, 1]
        found = 0
        row, column = int(v) // cell, int(u) // cell
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for shifted in range(column - 2, column + 3):
                j = shifted
                if closed:
                    j = shifted % (last + 1)
                elif shifted < column - 1 or shifted > column + 1 or shifted < 0 or shifted >= columns:
                    continue
                k = head[i, j]
                while k >= 0:
                    du, dv = other_pixel[k, 0] - u, other_pixel[k, 1] - v
                    if closed:
                        du -= width * round(du / width)
                    along, offset = -y * du + x * dv, x * du + y * dv
                    cosine = x * other_across[k, 0] + y * other_across[k, 1]
                    if other[k] != own[n] and abs(along) <= 1.0 and abs(cosine) >= least_cosine:
                        # Along the neighbour to where it meets the profile.
                        sine = -y * other_across[k, 0] + x * other_across[k, 1]
                        offset += along * sine / cosine
                        if abs(offset) <= reach_px:
                            index = 0
                            while index < found and arcs[index] != other[k]:
                                index += 1
                            if index == found and found < 64:
                                arcs[index], along_of[index] = other[k], np.inf
                                found += 1
                            if index < found and abs(along) < along_of[index]:
                                along_of[index], offset_of[index] = abs(along), offset
                    k = following[k]
        while count[n] < MOST_STEPS and found > 0:
            best = 0
            for index in range(1, found):
                if abs(offset_of[index]) < abs(offset_of[best]):
                    best = index
            place[n, count[n]] = offset_of[best]
            count[n] += 1
            found -= 1
            arcs[best], offset_of[best] = arcs[found], offset_of[found]
    return place, count
