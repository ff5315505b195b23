"""Colours at places beside arcs: medians of what a photo shows there; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def median_logs(image: np.ndarray, unit: float, pixel: np.ndarray, valid: np.ndarray, closed: bool, dark: float) -> np.ndarray:
    """(n, 3): for the places (n, k, p, 2) of each row the mean over k of the median over p of ln(grey level of 255 + dark), of
    those that are valid and in the image (h, w, c), between its pixels by interpolation; NaN where there is none.

    A photo of fewer than three channels has three equal ones."""
    height, width, channels = image.shape
    rows, lines, places = valid.shape
    used = 3 if channels >= 3 else 1
    result = np.full((rows, 3), np.nan)
    grey, total = np.empty((used, places)), np.empty(used)
    for n in range(rows):
        total[:] = 0.0
        some = 0
        for k in range(lines):
            count = 0
            for p in range(places):
                u, v = pixel[n, k, p, 0], pixel[n, k, p, 1]
                if not valid[n, k, p] or not (v >= 0.0 and v <= height - 1 and (closed or (u >= 0.0 and u <= width - 1))):
                    continue
                j, i = math.floor(u), math.floor(v)
                s, t = u - j, v - i
                below, beside = min(i + 1, height - 1), j + 1
                j, beside = (j % width, beside % width) if closed else (j, min(beside, width - 1))
                for c in range(used):
                    top = (1.0 - s) * image[i, j, c] + s * image[i, beside, c]
                    bottom = (1.0 - s) * image[below, j, c] + s * image[below, beside, c]
                    grey[c, count] = ((1.0 - t) * top + t * bottom) / unit
                count += 1
            if count == 0:
                continue
            some += 1
            for c in range(used):
                level = np.sort(grey[c, :count])
                total[c] += 0.5 * (math.log(level[(count - 1) // 2] + dark) + math.log(level[count // 2] + dark))
        if some > 0:
            for c in range(3):
                result[n, c] = total[min(c, used - 1)] / some
    return result
