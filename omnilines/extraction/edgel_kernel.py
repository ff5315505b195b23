"""Edge points of a colour gradient, compiled: the strongest point across each edge, to a fraction of a pixel.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def colour_gradient(by_u: np.ndarray, by_v: np.ndarray, strength: np.ndarray, direction: np.ndarray) -> None:
    """Strength and direction of the steepest change of colour, from the derivatives (h, w, c) of its channels.

    They are the square root of the largest eigenvalue of J = sum over channels of grad grad' and its eigenvector (S. Di Zenzo
    1986, A note on the gradient of a multi-image). The direction (h, w, 2) has no sign: it is one of two.
    """
    height, width, channels = by_u.shape
    for i in range(height):
        for j in range(width):
            uu, uv, vv = 0.0, 0.0, 0.0
            for c in range(channels):
                gu, gv = by_u[i, j, c], by_v[i, j, c]
                uu += gu * gu
                uv += gu * gv
                vv += gv * gv
            half = 0.5 * (uu - vv)
            root = math.sqrt(half * half + uv * uv)
            strength[i, j] = math.sqrt(0.5 * (uu + vv) + root)
            # The eigenvector, from whichever of its two forms does not cancel.
            x, y = (half + root, uv) if half >= 0 else (uv, root - half)
            length = math.sqrt(x * x + y * y)
            if length > 0.0:
                direction[i, j, 0] = x / length
                direction[i, j, 1] = y / length
            else:
                direction[i, j, 0] = 1.0
                direction[i, j, 1] = 0.0


@njit(cache=True, nogil=True)
@no_type_check
def _at(image: np.ndarray, u: float, v: float) -> float:
    j, i = math.floor(u), math.floor(v)
    s, t = u - j, v - i
    above = (1.0 - s) * image[i, j] + s * image[i, j + 1]
    below = (1.0 - s) * image[i + 1, j] + s * image[i + 1, j + 1]
    return (1.0 - t) * above + t * below


@njit(cache=True, nogil=True)
@no_type_check
def ridge_points(
    strength: np.ndarray, direction: np.ndarray, allowed: np.ndarray, threshold: float, first: int, last: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (row, column) in rows `first` to `last` whose strength is at least the threshold and largest across the edge, and
    their points (u, v, direction u, direction v): the top of a parabola through the strength there and a pixel to either side.
    """
    width = strength.shape[1]
    room = 1024
    cells, points = np.empty((room, 2), dtype=np.int32), np.empty((room, 4), dtype=np.float32)
    count = 0
    for i in range(max(first, 2), min(last, strength.shape[0] - 2)):
        for j in range(2, width - 2):
            here = strength[i, j]
            if here < threshold or not allowed[i, j]:
                continue
            x, y = direction[i, j, 0], direction[i, j, 1]
            before, after = _at(strength, j - x, i - y), _at(strength, j + x, i + y)
            if here <= before or here < after:
                continue
            shift = 0.5 * (after - before) / (2.0 * here - before - after)
            if abs(shift) > 0.75:
                continue
            if count == room:
                room *= 2
                more_cells, more_points = np.empty((room, 2), dtype=np.int32), np.empty((room, 4), dtype=np.float32)
                more_cells[:count], more_points[:count] = cells, points
                cells, points = more_cells, more_points
            cells[count, 0], cells[count, 1] = i, j
            points[count, 0], points[count, 1] = j + shift * x, i + shift * y
            points[count, 2], points[count, 3] = x, y
            count += 1
    return cells[:count].copy(), points[:count].copy()
