"""Where an arc bends: two edges that nearly go on in each other, fitted as one; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def _left(total: np.ndarray) -> tuple[float, float, float]:
    """Of the sums (w xx, w xy, w yy, w xz, w yz, w zz) the circle (a, b) and the weighted squares that it leaves."""
    determinant = total[0] * total[2] - total[1] * total[1]
    if determinant <= 1e-12 * total[0] * total[2]:
        return 0.0, 0.0, total[5]
    a = (total[2] * total[3] - total[1] * total[4]) / determinant
    b = (total[0] * total[4] - total[1] * total[3]) / determinant
    return a, b, max(total[5] - a * total[3] - b * total[4], 0.0)


@njit(cache=True, nogil=True)
@no_type_check
def bend_of(way: np.ndarray, off: np.ndarray, share: np.ndarray, least: int) -> tuple[int, float, float]:
    """The place of an edge before which two circles instead of one leave least of the squares of the places `off` (n), -1 where
    there is none; the ratio F of what is gained to what is left, for a correlation of 1; and how far (px) the circle of the
    longer part passes from the far end of the shorter one. `way` (n, 2) is how far a place goes with either change of a circle,
    `share` (n) its weight.

    Each part has at least `least` places.
    """
    count = len(off)
    if count < 2 * least:
        return -1, 0.0, 0.0
    sums = np.zeros((count + 1, 6))
    for i in range(count):
        w, x, y, z = share[i], way[i, 0], way[i, 1], off[i]
        sums[i + 1, 0] = sums[i, 0] + w * x * x
        sums[i + 1, 1] = sums[i, 1] + w * x * y
        sums[i + 1, 2] = sums[i, 2] + w * y * y
        sums[i + 1, 3] = sums[i, 3] + w * x * z
        sums[i + 1, 4] = sums[i, 4] + w * y * z
        sums[i + 1, 5] = sums[i, 5] + w * z * z
    _, _, whole = _left(sums[count])
    best, least_left, rest = -1, np.inf, np.empty(6)
    for i in range(least, count - least + 1):
        for k in range(6):
            rest[k] = sums[count, k] - sums[i, k]
        total = _left(sums[i])[2] + _left(rest)[2]
        if total < least_left:
            best, least_left = i, total
    a0, b0, _ = _left(sums[best])
    a1, b1, _ = _left(sums[count] - sums[best])
    ratio = 0.5 * (whole - least_left) * (count - 4) / max(least_left, 1e-9)
    n = 0 if best < count - best else count - 1
    return best, ratio, abs((a1 - a0) * way[n, 0] + (b1 - b0) * way[n, 1])
