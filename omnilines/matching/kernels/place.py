"""How many arcs agree with a camera at a place, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def agreeing(
    arc: np.ndarray,
    alike: np.ndarray,
    normal: np.ndarray,
    offset: np.ndarray,
    point: np.ndarray,
    ahead: np.ndarray,
    centres: np.ndarray,
    sine: float,
) -> np.ndarray:
    """For each centre the sum over the arcs of the best likeness of a line that a camera there sees where the arc is.

    Rows are pairs of an arc and a line, sorted by arc: the plane normal . C = offset in which the camera has to lie, to within
    `sine` of its distance from `point` of the line, and the direction `ahead` in which it sees the arc.
    """
    total = np.zeros(len(centres))
    for k in range(len(centres)):
        x, y, z = centres[k]
        best, last = 0.0, -1
        for i in range(len(arc)):
            if arc[i] != last:
                total[k] += best
                best, last = 0.0, arc[i]
            if alike[i] <= best:
                continue
            off = normal[i, 0] * x + normal[i, 1] * y + normal[i, 2] * z - offset[i]
            dx, dy, dz = point[i, 0] - x, point[i, 1] - y, point[i, 2] - z
            if off * off >= sine * sine * (dx * dx + dy * dy + dz * dz):
                continue
            if dx * ahead[i, 0] + dy * ahead[i, 1] + dz * ahead[i, 2] > 0.0:
                best = alike[i]
        total[k] += best
    return total
