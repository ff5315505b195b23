"""Where an arc bends: two edges that nearly go on in each other, fitted as one; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.circle import OFF, SHARE, X, Y


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _left(sums: np.ndarray, begin: int, end: int) -> tuple[float, float, float]:
    """Of the sums (w xx, w xy, w yy, w xz, w yz, w zz) from place to place the circle (a, b) and the weighted squares that it
    leaves."""
    xx, xy, yy = sums[end, 0] - sums[begin, 0], sums[end, 1] - sums[begin, 1], sums[end, 2] - sums[begin, 2]
    xz, yz, zz = sums[end, 3] - sums[begin, 3], sums[end, 4] - sums[begin, 4], sums[end, 5] - sums[begin, 5]
    determinant = xx * yy - xy * xy
    if determinant <= 1e-12 * xx * yy:
        return 0.0, 0.0, zz
    over = 1.0 / determinant
    a, b = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    return a, b, max(zz - a * xz - b * yz, 0.0)


@njit(cache=True, nogil=True)
@no_type_check
def bend_of(room: np.ndarray, count: int, least: int, sums: np.ndarray) -> tuple[int, float, float]:
    """The place of an edge in the room of `circle.py` before which two circles instead of one leave least of the squares, -1
    where there is none; the ratio F of what is gained to what is left, for a correlation of 1; and how far (px) the circle of
    the longer part passes from the far end of the shorter one.

    Each part has at least `least` places. `sums` (more than count, 6) is room for those up to each place.
    """
    if count < 2 * least:
        return -1, 0.0, 0.0
    sums[0] = 0.0
    for i in range(count):
        w, x, y, z = room[SHARE, i], room[X, i], room[Y, i], room[OFF, i]
        sums[i + 1, 0] = sums[i, 0] + w * x * x
        sums[i + 1, 1] = sums[i, 1] + w * x * y
        sums[i + 1, 2] = sums[i, 2] + w * y * y
        sums[i + 1, 3] = sums[i, 3] + w * x * z
        sums[i + 1, 4] = sums[i, 4] + w * y * z
        sums[i + 1, 5] = sums[i, 5] + w * z * z
    _, _, whole = _left(sums, 0, count)
    best, least_left = -1, np.inf
    for i in range(least, count - least + 1):
        total = _left(sums, 0, i)[2] + _left(sums, i, count)[2]
        if total < least_left:
            best, least_left = i, total
    a0, b0, _ = _left(sums, 0, best)
    a1, b1, _ = _left(sums, best, count)
    ratio = 0.5 * (whole - least_left) * (count - 4) / max(least_left, 1e-9)
    n = 0 if best < count - best else count - 1
    return best, ratio, abs((a1 - a0) * room[X, n] + (b1 - b0) * room[Y, n])
