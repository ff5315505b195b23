"""Where an arc bends: two edges that nearly go on in each other, fitted as one; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.circle_kernel import own_samples


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
def bends(
    starts: np.ndarray,
    found: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    shift: np.ndarray,
    strength: np.ndarray,
    usable: np.ndarray,
    most_shift_px: float,
    least: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each arc the sample before which two circles instead of one leave least of the squares of the shifts, -1 where there
    is none; the ratio F of what is gained to what is left, for a correlation of 1; and how far (px) the circle of the longer
    part passes from the far end of the shorter one.

    Each part has at least `least` samples.
    """
    arcs = len(starts) - 1
    place, ratio, off = np.full(arcs, -1, dtype=np.int64), np.zeros(arcs), np.zeros(arcs)
    for arc in range(arcs):
        begin, end = max(found[arc, 0], starts[arc]), found[arc, 1] + 1
        if found[arc, 0] < 0 or end - begin < 2 * least:
            continue
        chosen = own_samples(begin, end, shift, usable, most_shift_px)
        count = len(chosen)
        if count < 2 * least:
            continue
        middle = np.median(strength[chosen])
        sums = np.zeros((count + 1, 6))
        for i in range(count):
            n = chosen[i]
            w = strength[n] / (strength[n] + middle)
            x, y, z = -rate[n] * math.cos(angle[n]), -rate[n] * math.sin(angle[n]), shift[n]
            sums[i + 1, 0] = sums[i, 0] + w * x * x
            sums[i + 1, 1] = sums[i, 1] + w * x * y
            sums[i + 1, 2] = sums[i, 2] + w * y * y
            sums[i + 1, 3] = sums[i, 3] + w * x * z
            sums[i + 1, 4] = sums[i, 4] + w * y * z
            sums[i + 1, 5] = sums[i, 5] + w * z * z
        _, _, whole = _left(sums[count])
        best, least_left = -1, np.inf
        for i in range(least, count - least + 1):
            _, _, before = _left(sums[i])
            _, _, after = _left(sums[count] - sums[i])
            if before + after < least_left:
                best, least_left = i, before + after
        a0, b0, _ = _left(sums[best])
        a1, b1, _ = _left(sums[count] - sums[best])
        place[arc] = chosen[best]
        ratio[arc] = 0.5 * (whole - least_left) * (count - 4) / max(least_left, 1e-9)
        n = chosen[0] if best < count - best else chosen[count - 1]
        off[arc] = abs(rate[n] * ((a1 - a0) * math.cos(angle[n]) + (b1 - b0) * math.sin(angle[n])))
    return place, ratio, off
