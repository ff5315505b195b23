"""Edge points of a colour gradient, compiled: the strongest point across each edge, to a fraction of a pixel.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.profile import REORDERED


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def add_products(by_u: np.ndarray, by_v: np.ndarray, tensor: np.ndarray) -> None:
    """Add those of the derivatives (h, w) of one channel to J = sum over channels of grad grad', as (uu, uv, vv) (3, h, w)."""
    height, width = by_u.shape
    for i in range(height):
        for j in range(width):
            tensor[0, i, j] += by_u[i, j] * by_u[i, j]
            tensor[1, i, j] += by_u[i, j] * by_v[i, j]
            tensor[2, i, j] += by_v[i, j] * by_v[i, j]


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def strengths(tensor: np.ndarray, strength: np.ndarray) -> None:
    """The steepest change of colour: the square root of the largest eigenvalue of J (S. Di Zenzo 1986, A note on the gradient of
    a multi-image)."""
    height, width = strength.shape
    for i in range(height):
        for j in range(width):
            half = np.float32(0.5) * (tensor[0, i, j] - tensor[2, i, j])
            root = np.sqrt(half * half + tensor[1, i, j] * tensor[1, i, j])
            strength[i, j] = np.sqrt(np.float32(0.5) * (tensor[0, i, j] + tensor[2, i, j]) + root)


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _direction(tensor: np.ndarray, i: int, j: int) -> tuple[float, float]:
    """Of the steepest change, one of two: the eigenvector of J, from whichever of its two forms does not cancel."""
    half, uv = 0.5 * (tensor[0, i, j] - tensor[2, i, j]), tensor[1, i, j]
    root = math.sqrt(half * half + uv * uv)
    x, y = (half + root, uv) if half >= 0 else (uv, root - half)
    length = math.sqrt(x * x + y * y)
    if length > 0.0:
        return x / length, y / length
    return 1.0, 0.0


@njit(cache=True, nogil=True, **BORROWED)
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
    strength: np.ndarray, tensor: np.ndarray, allowed: np.ndarray, threshold: float, first: int, last: int
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
            x, y = _direction(tensor, i, j)
            before, after = _at(strength, j - x, i - y), _at(strength, j + x, i + y)
            if here <= before or here < after:
                continue
            shift = 0.5 * (after - before) / (2.0 * here - before - after)
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


@njit(cache=True, nogil=True)
@no_type_check
def second_differences(image: np.ndarray, allowed: np.ndarray, tops: np.ndarray, rows: int, counts: np.ndarray) -> None:
    """Count the values of |the mask (1 -2 1)' (1 -2 1)| on the first channel of an image at pixels allowed, in bands of `rows`
    rows from `tops` on; pixels beyond a band are mirrored at its border pixels."""
    height, width = image.shape[:2]
    for top in tops:
        last = min(top + rows, height) - 1
        for i in range(top, last + 1):
            above = min(i + 1, last) if i == top else i - 1
            below = max(i - 1, top) if i == last else i + 1
            for j in range(width):
                if not allowed[i, j]:
                    continue
                left = min(j + 1, width - 1) if j == 0 else j - 1
                right = max(j - 1, 0) if j == width - 1 else j + 1
                value = np.int64(0)
                for row, share in ((above, 1), (i, -2), (below, 1)):
                    value += share * (np.int64(image[row, left, 0]) + image[row, right, 0] - 2 * np.int64(image[row, j, 0]))
                counts[abs(value)] += 1
