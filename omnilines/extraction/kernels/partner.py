"""Ends of smooth curves that go on in each other, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

OVERLAP_PX = 3.0
"""By which two curves that go on in each other may run side by side."""
ASIDE_PX = 1.5


class PartnerLimits(NamedTuple):
    """When two ends may be those of a gap in one curve."""

    max_gap_share: float
    """Of the shorter curve."""
    max_curvature: float
    noise_rad: float
    """Of the direction of an end."""


@njit(cache=True, nogil=True)
@no_type_check
def partners(place: np.ndarray, way: np.ndarray, length: np.ndarray, light: np.ndarray, limits: PartnerLimits) -> np.ndarray:
    """The end (2 n) that each end goes on in, each other's nearest, else -1; those of curve c are 2 c and 2 c + 1.

    `place` (2 n, 2), `way` (2 n, 2) unit vectors outwards, `length` (n) of the curves, `light` (2 n): 1 where the brighter side
    is left of the way out, else -1.
    """
    count = len(place)
    order = np.argsort(place[:, 0])
    least, best = np.full(count, np.inf), np.full(count, -1, dtype=np.int64)
    for first in range(count):
        i = order[first]
        reach = limits.max_gap_share * length[i // 2]
        for second in range(first + 1, count):
            j = order[second]
            du = place[j, 0] - place[i, 0]
            if du > reach:
                break
            most = min(reach, limits.max_gap_share * length[j // 2])
            dv = place[j, 1] - place[i, 1]
            gap = math.hypot(du, dv)
            # Seen along the way out of one, the other's brighter side is on the same side.
            if gap > most or i // 2 == j // 2 or light[i] == light[j]:
                continue
            bend = limits.max_curvature * gap
            turn = abs(math.atan2(way[i, 0] * way[j, 1] - way[i, 1] * way[j, 0], -way[i, 0] * way[j, 0] - way[i, 1] * way[j, 1]))
            if turn > bend + 2.0 * limits.noise_rad:
                continue
            aside = ASIDE_PX + gap * (bend + limits.noise_rad)
            if abs(way[i, 0] * dv - way[i, 1] * du) > aside or abs(way[j, 0] * dv - way[j, 1] * du) > aside:
                continue
            if way[i, 0] * du + way[i, 1] * dv < -OVERLAP_PX or -way[j, 0] * du - way[j, 1] * dv < -OVERLAP_PX:
                continue
            if gap < least[i]:
                least[i], best[i] = gap, j
            if gap < least[j]:
                least[j], best[j] = gap, i
    mutual = np.full(count, -1, dtype=np.int64)
    for i in range(count):
        if best[i] >= 0 and best[best[i]] == i:
            mutual[i] = best[i]
    return mutual
