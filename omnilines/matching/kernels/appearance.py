"""Colours at places beside arcs: medians of what a photo shows there; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def median_logs(
    image: np.ndarray,
    unit: float,
    pixel: np.ndarray,
    step: np.ndarray,
    valid: np.ndarray,
    offsets: np.ndarray,
    closed: bool,
    dark: float,
) -> np.ndarray:
    """(n, 2, 3): for the two sides of places (n, p, 2), the first where `step` (n, p, 2) leads, the mean over `offsets` (px) of
    the median over p of ln(grey level of 255 + dark) so far beside the places, of those that are valid and in the image
    (h, w, c), between its pixels by interpolation; NaN where there is none.

    A photo of fewer than three channels has three equal ones."""
    height, width, channels = image.shape
    rows, places = valid.shape
    used = 3 if channels >= 3 else 1
    result = np.full((rows, 2, 3), np.nan)
    grey, total = np.empty((used, places)), np.empty(used)
    for row in range(2 * rows):
        n, side = row // 2, row % 2
        total[:] = 0.0
        some = 0
        for offset in offsets:
            count = 0
            for p in range(places):
                if not valid[n, p]:
                    continue
                x, y = step[n, p, 0], step[n, p, 1]
                by = (offset if side == 0 else -offset) / max(math.sqrt(x * x + y * y), 1e-300)
                u, v = pixel[n, p, 0] + by * x, pixel[n, p, 1] + by * y
                if not (v >= 0.0 and v <= height - 1 and (closed or (u >= 0.0 and u <= width - 1))):
                    continue
                j, i = math.floor(u), math.floor(v)
                s, t = u - j, v - i
                below, beside = min(i + 1, height - 1), j + 1
                j, beside = (j % width, beside % width) if closed else (j, min(beside, width - 1))
                for c in range(used):
                    top = (1.0 - s) * image[i, j, c] + s * image[i, beside, c]
                    bottom = (1.0 - s) * image[below, j, c] + s * image[below, beside, c]
                    # Kept in order.
                    value, k = ((1.0 - t) * top + t * bottom) / unit, count
                    while k > 0 and grey[c, k - 1] > value:
                        grey[c, k] = grey[c, k - 1]
                        k -= 1
                    grey[c, k] = value
                count += 1
            if count == 0:
                continue
            some += 1
            for c in range(used):
                total[c] += 0.5 * (math.log(grey[c, (count - 1) // 2] + dark) + math.log(grey[c, count // 2] + dark))
        if some > 0:
            for c in range(3):
                result[n, side, c] = total[min(c, used - 1)] / some
    return result
