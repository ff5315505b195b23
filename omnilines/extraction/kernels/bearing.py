"""Bearings of places in the photo, read off a grid of nodes; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED


@njit(cache=True, nogil=True)
@no_type_check
def smooth_cells(node: np.ndarray, valid: np.ndarray, most_share: float) -> np.ndarray:
    """Between which nodes (i, j) and (i + 1, j + 1) of a grid (h, w, 3) Lagrange's bicubic of the 16 around is good.

    Its error is at most 9/384 of the sum of the fourth derivatives, measured by fourth differences; it may be `most_share` of
    the step to the next node.
    """
    rows, columns = valid.shape
    fine = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(2, rows - 2):
        for j in range(2, columns - 2):
            error, by_u, by_v, seen = 0.0, 0.0, 0.0, True
            for c in range(3):
                here = 6.0 * node[i, j, c]
                fourth_u = here + node[i, j - 2, c] + node[i, j + 2, c] - 4.0 * (node[i, j - 1, c] + node[i, j + 1, c])
                fourth_v = here + node[i - 2, j, c] + node[i + 2, j, c] - 4.0 * (node[i - 1, j, c] + node[i + 1, j, c])
                error += (abs(fourth_u) + abs(fourth_v)) ** 2
                by_u += (node[i, j + 1, c] - node[i, j, c]) ** 2
                by_v += (node[i + 1, j, c] - node[i, j, c]) ** 2
            for p in range(-1, 2):
                for q in range(-1, 2):
                    seen = seen and valid[i + p, j + q]
            fine[i, j] = seen and 9.0 / 384.0 * math.sqrt(error) < most_share * math.sqrt(min(by_u, by_v))
    good = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(rows - 1):
        for j in range(columns - 1):
            good[i, j] = fine[i, j] and fine[i + 1, j] and fine[i, j + 1] and fine[i + 1, j + 1]
    return good


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _cubic(t: float, weight: np.ndarray) -> None:
    """Lagrange's weights of nodes at -1, 0, 1, 2 for a place t in [0, 1)."""
    weight[0] = -t * (t - 1.0) * (t - 2.0) / 6.0
    weight[1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
    weight[2] = -(t + 1.0) * t * (t - 2.0) / 2.0
    weight[3] = (t + 1.0) * t * (t - 1.0) / 6.0


@njit(cache=True, nogil=True)
@no_type_check
def read_bearings(
    node: np.ndarray, good: np.ndarray, origin_px: float, step_px: float, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (n, 3) of places (u, v) in a grid of nodes `step_px` apart whose first is at (origin_px, origin_px), and whether
    the grid is good there; where it is not, the bearing is 0."""
    bearing, known = np.zeros((len(places), 3)), np.zeros(len(places), dtype=np.bool_)
    wu, wv = np.empty(4), np.empty(4)
    for n in range(len(places)):
        x, y = (places[n, 0] - origin_px) / step_px, (places[n, 1] - origin_px) / step_px
        j, i = math.floor(x), math.floor(y)
        if i < 1 or j < 1 or i > good.shape[0] - 3 or j > good.shape[1] - 3 or not good[i, j]:
            continue
        known[n] = True
        _cubic(x - j, wu)
        _cubic(y - i, wv)
        for c in range(3):
            total = 0.0
            for p in range(4):
                row = 0.0
                for q in range(4):
                    row += wu[q] * node[i - 1 + p, j - 1 + q, c]
                total += wv[p] * row
            bearing[n, c] = total
    return bearing, known
