"""Edge points of a colour gradient, compiled: the strongest point across each edge, to a fraction of a pixel.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _mirrored(n: int, size: int) -> int:
    """The number of a row that stands for row n beyond the border of an image: mirrored at the border's own."""
    n %= max(2 * size - 2, 1)
    return n if n < size else 2 * size - 2 - n


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _add(values: np.ndarray, share: float, total: np.ndarray) -> None:
    for j in range(len(total)):
        total[j] += share * values[j]


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _add_products(above: np.ndarray, here: np.ndarray, below: np.ndarray, uu: np.ndarray, uv: np.ndarray, vv: np.ndarray) -> None:
    """Of the derivatives in a row, by Scharr's masks on it and the rows above and below it, which have one pixel more at each
    side."""
    side, middle = np.float32(3 / 32), np.float32(10 / 32)
    for j in range(len(uu)):
        by_u = side * (above[j + 2] - above[j] + below[j + 2] - below[j]) + middle * (here[j + 2] - here[j])
        by_v = side * (below[j] - above[j] + below[j + 2] - above[j + 2]) + middle * (below[j + 1] - above[j + 1])
        uu[j] += by_u * by_u
        uv[j] += by_u * by_v
        vv[j] += by_v * by_v


@njit(cache=True, nogil=True)
@no_type_check
def gradient_products(image: np.ndarray, closed: bool, low: int, high: int, weight: np.ndarray) -> np.ndarray:
    """J = sum over channels of grad grad' in the rows `low` to `high` of an image (h, w, c), as (uu, uv, vv) (3, high - low, w).

    The derivatives are those of the image smoothed by `weight` (k, odd) along both ways; beyond its border it is mirrored, or
    goes on around its seam.
    """
    height, width, channels = image.shape
    taps, rows, pad = len(weight), high - low, len(weight) // 2 + 1
    tensor = np.zeros((3, rows, width), dtype=np.float32)
    smooth = np.empty((rows + 2, width + 2), dtype=np.float32)
    row, along = np.empty(width + 2 * pad, dtype=np.float32), np.empty(width + 2, dtype=np.float32)
    for c in range(channels):
        smooth[:] = np.float32(0.0)
        for r in range(rows + 2 * pad):
            line = image[_mirrored(low - pad + r, height)]
            for j in range(width):
                row[pad + j] = line[j, c]
            for q in range(1, pad + 1):
                row[pad - q] = line[-q % width if closed else _mirrored(-q, width), c]
                row[pad + width - 1 + q] = line[(q - 1) % width if closed else _mirrored(width - 1 + q, width), c]
            along[:] = np.float32(0.0)
            for t in range(taps):
                _add(row[t : t + width + 2], weight[t], along)
            for t in range(max(r - rows - 1, 0), min(taps, r + 1)):
                _add(along, weight[t], smooth[r - t])
        for i in range(rows):
            _add_products(smooth[i], smooth[i + 1], smooth[i + 2], tensor[0, i], tensor[1, i], tensor[2, i])
    return tensor


@njit(cache=True, nogil=True, **REORDERED)
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


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED, **BORROWED)
@no_type_check
def _ridge_row(
    strengths: tuple[np.ndarray, np.ndarray, np.ndarray],
    tensor: tuple[np.ndarray, np.ndarray, np.ndarray],
    threshold: float,
    row: np.ndarray,
    good: np.ndarray,
) -> None:
    """Of the pixels 1 to w - 2 of the middle one of three rows of strengths: the direction across in `row` (3, w - 2), how far
    along it the top of a parabola through three strengths is, and whether the pixel is `good` (w - 2). `tensor` is its row of J.

    All pixels are worked on, with choices in the place of branches, so that one instruction does it for many. The direction is
    the eigenvector of J, from whichever of its two forms does not cancel; a pixel along it is read between four, bilinear.
    """
    half_of, one, two, none = np.float32(0.5), np.float32(1.0), np.float32(2.0), np.float32(0.0)
    above, here, below = strengths
    by_uu, by_uv, by_vv = tensor
    for j in range(len(good)):
        middle, uv = here[j + 1], by_uv[j + 1]
        half = half_of * (by_uu[j + 1] - by_vv[j + 1])
        root = np.sqrt(half * half + uv * uv) + abs(half)
        over = one / np.sqrt(max(root * root + uv * uv, np.float32(1e-30)))
        x, y = (root if half >= none else uv) * over, (uv if half >= none else root) * over
        left, up = x < none, y < none
        east, west, south, north = here[j + 2], here[j], below[j + 1], above[j + 1]
        falling = below[j + 2] if left == up else below[j]
        rising = above[j] if left == up else above[j + 2]
        a, b = abs(x), abs(y)
        shares = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
        after, before = shares[0] * middle, shares[0] * middle
        after += shares[1] * (west if left else east) + shares[2] * (north if up else south)
        after += shares[3] * (rising if up else falling)
        before += shares[1] * (east if left else west) + shares[2] * (south if up else north)
        before += shares[3] * (falling if up else rising)
        row[0, j], row[1, j], row[2, j] = x, y, half_of * (after - before) / (two * middle - before - after)
        good[j] = np.uint8(1) if (middle >= threshold) & (middle > before) & (middle >= after) else np.uint8(0)


@njit(cache=True, nogil=True)
@no_type_check
def ridge_points(
    strength: np.ndarray, tensor: np.ndarray, allowed: np.ndarray, threshold: float, first: int, last: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (row, column) in rows `first` to `last` whose strength is at least the threshold and largest across the edge, and
    their points (u, v, direction u, direction v): the top of a parabola through the strength there and a pixel to either side.
    """
    width = strength.shape[1]
    room = max((last - first) * width // 8, width)
    cells, points = np.empty((room, 2), dtype=np.int32), np.empty((room, 4), dtype=np.float32)
    row, good = np.empty((3, max(width - 2, 0)), dtype=np.float32), np.empty(max(width - 2, 0), dtype=np.uint8)
    count = 0
    for i in range(max(first, 2), min(last, strength.shape[0] - 2)):
        rows = strength[i - 1], strength[i], strength[i + 1]
        _ridge_row(rows, (tensor[0, i], tensor[1, i], tensor[2, i]), np.float32(threshold), row, good)
        if count + width > room:
            room = 2 * room + width
            more_cells, more_points = np.empty((room, 2), dtype=np.int32), np.empty((room, 4), dtype=np.float32)
            more_cells[:count], more_points[:count] = cells[:count], points[:count]
            cells, points = more_cells, more_points
        for j in range(2, width - 2):
            if good[j - 1] and allowed[i, j]:
                x, y, shift = row[0, j - 1], row[1, j - 1], row[2, j - 1]
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
