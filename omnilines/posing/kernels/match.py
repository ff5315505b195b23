"""The compiled search for matches along epipolar half circles: descriptors are compared only of features that lie there."""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def alikeness(a, i, b, j):
    """a_i . b_j of descriptors (uint8)."""
    total = np.int32(0)
    for k in range(a.shape[1]):
        total += np.int32(a[i, k]) * np.int32(b[j, k])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def best_near(a, a_length, b, b_length, far, normal, whole, sector, bearings, start, reach, tolerance, least):
    """For each feature of one photo the best of the other near its half circle, -1 where none is as alike as `least`.

    Descriptors a (n x 128) and b (m x 128) with their lengths; `far` (n x 3) is the direction of a feature at infinity as the
    other photo sees it, `normal` that of its circle, `whole` the angle from there to the first camera, and `sector` the one
    about the direction of that camera which the half circle is in. `bearings` (m x 3) of b are in the order of rings about that
    direction and of sectors in them: `start` (rings x sectors + 1) tells where each begins, `reach` how many sectors beside its
    own a half circle comes near to in a ring.
    Returns the best row of b, how alike it is (cosine) and the second best is (`least` where there is none), and for each row of
    b the best of a under the same conditions.
    """
    n, m, sectors = len(a), len(b), start.shape[1] - 1
    best, first, second = np.full(n, -1), np.full(n, least, dtype=np.float32), np.full(n, least, dtype=np.float32)
    back, back_first = np.full(m, -1), np.full(m, least, dtype=np.float32)
    for i in range(n):
        f0, f1, f2 = far[i, 0], far[i, 1], far[i, 2]
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        s0, s1, s2 = n1 * f2 - n2 * f1, n2 * f0 - n0 * f2, n0 * f1 - n1 * f0
        for ring in range(len(reach)):
            low, high = sector[i] - reach[ring], sector[i] + reach[ring] + 1
            if high - low >= sectors:
                low, high = 0, sectors
            # Twice where the sectors go over the end.
            for turn in range(-1, 2):
                one, other = max(low + turn * sectors, 0), min(high + turn * sectors, sectors)
                if one >= other:
                    continue
                for j in range(start[ring, one], start[ring, other]):
                    u, v, w = bearings[j, 0], bearings[j, 1], bearings[j, 2]
                    if not abs(n0 * u + n1 * v + n2 * w) < tolerance:
                        continue
                    # Along the circle, from `far` at angle 0 to the first camera at `whole`.
                    angle = math.atan2(s0 * u + s1 * v + s2 * w, f0 * u + f1 * v + f2 * w)
                    if angle < -tolerance or angle > whole[i] + tolerance:
                        continue
                    alike = np.float32(alikeness(a, i, b, j) / (a_length[i] * b_length[j]))
                    if alike > first[i]:
                        second[i] = first[i]
                        best[i], first[i] = j, alike
                    elif alike > second[i]:
                        second[i] = alike
                    if alike > back_first[j]:
                        back[j], back_first[j] = i, alike
    return best, first, second, back
