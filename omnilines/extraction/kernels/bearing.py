"""Bearings of places in the photo, and pixels of rays, read off grids of nodes; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.tables import Charts


@njit(cache=True, nogil=True)
@no_type_check
def smooth_cells(node: np.ndarray, valid: np.ndarray, most_share: float) -> np.ndarray:
    """Between which nodes (i, j) and (i + 1, j + 1) of a grid (h, w, c) Lagrange's bicubic of the 16 around is good.

    Its error is at most 9/384 of the sum of the fourth derivatives, measured by fourth differences; it may be `most_share` of
    the step to the next node.
    """
    rows, columns = valid.shape
    fine = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(2, rows - 2):
        for j in range(2, columns - 2):
            error, by_u, by_v, seen = 0.0, 0.0, 0.0, True
            for c in range(node.shape[2]):
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


@njit(cache=True, nogil=True)
@no_type_check
def chart_table(pixel: np.ndarray) -> np.ndarray:
    """Of pixels (h, w, 2) of nodes their derivatives per step down, across and both, by differences of five nodes: (h, w, 8),
    the pixel first. Two nodes at each border have none."""
    rows, columns = pixel.shape[:2]
    table = np.zeros((rows, columns, 8))
    table[..., :2] = pixel
    for i in range(2, rows - 2):
        for j in range(columns):
            for c in range(2):
                table[i, j, 2 + c] = (
                    8.0 * (pixel[i + 1, j, c] - pixel[i - 1, j, c]) - pixel[i + 2, j, c] + pixel[i - 2, j, c]
                ) / 12.0
    for i in range(rows):
        for j in range(2, columns - 2):
            for c in range(4):
                inner, outer = table[i, j + 1, c] - table[i, j - 1, c], table[i, j + 2, c] - table[i, j - 2, c]
                table[i, j, 4 + c] = (8.0 * inner - outer) / 12.0
    return table


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _cell(charts: Charts, x: float, y: float, z: float, size: float) -> tuple[int, int, float, float]:
    """Where a ray of this length meets its chart: the node (-1 where the chart is not good there), that below it, and the shares
    of the way to that and to the next one across."""
    begin, shape, origin, step, _, good = charts
    side = 1 if z < 0.0 else 0
    rows, columns = shape[side, 0], shape[side, 1]
    over = size + abs(z)
    if rows == 0 or not over > 0.0:
        return -1, 0, 0.0, 0.0
    p, q = (x / over - origin[side, 0]) / step[side], (y / over - origin[side, 1]) / step[side]
    # In this order what is no number is not inside.
    if not (p >= 2.0 and q >= 2.0 and p < rows - 3 and q < columns - 3):
        return -1, 0, 0.0, 0.0
    i, j = int(p), int(q)
    first = begin[side] + i * columns + j
    return first if good[first] else -1, first + columns, p - i, q - j


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _hermite(t: float, weight: np.ndarray) -> None:
    """Weights of the values at 0 and 1 and of the derivatives there, for the value at t (row 0) and its derivative (row 1)."""
    s = 1.0 - t
    weight[0, 1] = t * t * (3.0 - 2.0 * t)
    weight[0, 0] = 1.0 - weight[0, 1]
    weight[0, 2], weight[0, 3] = t * s * s, -t * t * s
    weight[1, 1] = 6.0 * t * s
    weight[1, 0] = -weight[1, 1]
    weight[1, 2], weight[1, 3] = s * (1.0 - 3.0 * t), t * (3.0 * t - 2.0)


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _read(node: np.ndarray, first: int, below: int, c: int, down: np.ndarray, p: int, across: np.ndarray, q: int) -> float:
    """Coordinate c of the pixel in a cell by the weights of rows p and q."""
    total = 0.0
    for k in range(2):
        at = below if k == 1 else first
        for d in range(2):
            total += down[p, k + 2 * d] * (
                across[q, 0] * node[at, 2 * d + c]
                + across[q, 1] * node[at + 1, 2 * d + c]
                + across[q, 2] * node[at, 4 + 2 * d + c]
                + across[q, 3] * node[at + 1, 4 + 2 * d + c]
            )
    return total


@njit(cache=True, nogil=True)
@no_type_check
def read_pixels(charts: Charts, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of rays (n, 3) of any length, and whether their chart is good there; the pixel is 0 where not."""
    pixels, known = np.zeros((len(rays), 2)), np.zeros(len(rays), dtype=np.bool_)
    down, across = np.empty((2, 4)), np.empty((2, 4))
    for n in range(len(rays)):
        x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
        first, below, s, t = _cell(charts, x, y, z, math.sqrt(x * x + y * y + z * z))
        if first < 0:
            continue
        known[n] = True
        _hermite(s, down)
        _hermite(t, across)
        for c in range(2):
            pixels[n, c] = _read(charts.node, first, below, c, down, 0, across, 0)
    return pixels, known


@njit(cache=True, nogil=True)
@no_type_check
def read_changes(
    charts: Charts, frame: np.ndarray, owner: np.ndarray, angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (m, 2) at angles on the circles `owner` of frames (n, 3, 3) with the columns normal, first, second, their changes
    per radian along the circle and towards its normal, and whether their chart is good there; they are 0 where not."""
    count = len(owner)
    pixel, along, side = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((count, 2))
    known = np.zeros(count, dtype=np.bool_)
    down, across, ray, ahead = np.empty((2, 4)), np.empty((2, 4)), np.empty(3), np.empty(3)
    for n in range(count):
        arc, cosine, sine = owner[n], math.cos(angle[n]), math.sin(angle[n])
        for k in range(3):
            ray[k] = cosine * frame[arc, k, 1] + sine * frame[arc, k, 2]
            ahead[k] = cosine * frame[arc, k, 2] - sine * frame[arc, k, 1]
        first, below, s, t = _cell(charts, ray[0], ray[1], ray[2], 1.0)
        if first < 0:
            continue
        known[n] = True
        _hermite(s, down)
        _hermite(t, across)
        # The chart's place (x, y) / (1 + |z|) moves by ((dx, dy) - (x, y) d|z| / (1 + |z|)) / (1 + |z|).
        sign, size = (-1.0 if ray[2] < 0.0 else 1.0), 1.0 + abs(ray[2])
        over = 1.0 / (size * charts.step[1 if ray[2] < 0.0 else 0])
        x, y = ray[0] * sign / size, ray[1] * sign / size
        a0, a1 = (ahead[0] - x * ahead[2]) * over, (ahead[1] - y * ahead[2]) * over
        b0, b1 = (frame[arc, 0, 0] - x * frame[arc, 2, 0]) * over, (frame[arc, 1, 0] - y * frame[arc, 2, 0]) * over
        for c in range(2):
            pixel[n, c] = _read(charts.node, first, below, c, down, 0, across, 0)
            by_row = _read(charts.node, first, below, c, down, 1, across, 0)
            by_column = _read(charts.node, first, below, c, down, 0, across, 1)
            along[n, c], side[n, c] = by_row * a0 + by_column * a1, by_row * b0 + by_column * b1
    return pixel, along, side, known
