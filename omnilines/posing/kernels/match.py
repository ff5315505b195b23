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


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy", forceinline=True)
@no_type_check
def offsets(normal, i, bearings, off):
    """|n_i . b| of all bearings (3 x m), into `off` (m)."""
    x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
    for j in range(bearings.shape[1]):
        off[j] = abs(x * bearings[0, j] + y * bearings[1, j] + z * bearings[2, j])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def best_near(a, a_length, b, b_length, far, normal, whole, bearings, tolerance, least):
    """For each feature of one photo the best of the other near its half circle, -1 where none is as alike as `least`.

    Descriptors a (n x 128) and b (m x 128) with their lengths; `far` (n x 3) is the direction of a feature at infinity as the
    other photo sees it, `normal` that of its circle, `whole` the angle from there to the first camera; `bearings` (3 x m).
    Returns the best row of b, how alike it is (cosine) and the second best is (`least` where there is none), and for each row of
    b the best of a under the same conditions.
    """
    n, m = len(a), len(b)
    best, first, second = np.full(n, -1), np.full(n, least, dtype=np.float32), np.full(n, least, dtype=np.float32)
    back, back_first = np.full(m, -1), np.full(m, least, dtype=np.float32)
    off = np.empty(m, dtype=np.float32)
    for i in range(n):
        offsets(normal, i, bearings, off)
        f0, f1, f2 = far[i, 0], far[i, 1], far[i, 2]
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        s0, s1, s2 = n1 * f2 - n2 * f1, n2 * f0 - n0 * f2, n0 * f1 - n1 * f0
        for j in range(m):
            if not off[j] < tolerance:
                continue
            # Along the circle, from `far` at angle 0 to the first camera at `whole`.
            u, v, w = bearings[0, j], bearings[1, j], bearings[2, j]
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
