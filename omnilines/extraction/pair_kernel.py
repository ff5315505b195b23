"""Pairs of arcs with nearly one circle, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def _angle(row: int, frame: np.ndarray, x: float, y: float, z: float) -> float:
    """Of a bearing on a circle whose frame has the columns normal, first, second."""
    return math.atan2(
        x * frame[row, 0, 2] + y * frame[row, 1, 2] + z * frame[row, 2, 2],
        x * frame[row, 0, 1] + y * frame[row, 1, 1] + z * frame[row, 2, 1],
    )


@njit(cache=True, nogil=True)
@no_type_check
def _ends(a: int, b: int, frame: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """Angles of the ends of arc b on a's circle, in order."""
    found = np.empty(2)
    for side in range(2):
        angle = low[b] if side == 0 else high[b]
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y, z = (
            cosine * frame[b, 0, 1] + sine * frame[b, 0, 2],
            cosine * frame[b, 1, 1] + sine * frame[b, 1, 2],
            cosine * frame[b, 2, 1] + sine * frame[b, 2, 2],
        )
        found[side] = _angle(a, frame, x, y, z)
    return min(found[0], found[1]), max(found[0], found[1])


@njit(cache=True, nogil=True)
@no_type_check
def near_pairs(
    frame: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    length: np.ndarray,
    order: np.ndarray,
    near: float,
    most_gap: float,
    longest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (k, 2) of arcs whose normals, or one and the opposite of the other, are at most `near` apart, the longer arc first;
    and (k, 4) the angles of the ends of the second on the first one's circle, the gap between them in radians, negative where
    they overlap, and whether the second follows the first one's high end. `order` sorts the normals' third components by size.

    Pairs with a gap of `most_gap` or more, and those that together span `longest` or more, are left out.
    """
    count, room = 0, 1024
    pairs, values = np.empty((room, 2), dtype=np.int64), np.empty((room, 4))
    least_cosine = 1.0 - 0.5 * near * near
    for i in range(len(order)):
        p = order[i]
        for j in range(i + 1, len(order)):
            q = order[j]
            if abs(frame[q, 2, 0]) - abs(frame[p, 2, 0]) > near:
                break
            cosine = frame[p, 0, 0] * frame[q, 0, 0] + frame[p, 1, 0] * frame[q, 1, 0] + frame[p, 2, 0] * frame[q, 2, 0]
            if abs(cosine) < least_cosine:
                continue
            a, b = min(p, q), max(p, q)
            if length[a] < length[b]:
                a, b = b, a
            first, last = _ends(a, b, frame, low, high)
            # An arc that straddles the far side of a's circle has its ends on both sides of pi.
            if last - first >= math.pi or max(last, high[a]) - min(first, low[a]) >= longest:
                continue
            ahead, behind = first - high[a], low[a] - last
            if max(ahead, behind) >= most_gap:
                continue
            if count == room:
                room *= 2
                more_pairs, more_values = np.empty((room, 2), dtype=np.int64), np.empty((room, 4))
                more_pairs[:count], more_values[:count] = pairs, values
                pairs, values = more_pairs, more_values
            pairs[count, 0], pairs[count, 1] = a, b
            values[count, 0], values[count, 1], values[count, 2] = first, last, max(ahead, behind)
            values[count, 3] = 1.0 if ahead >= behind else 0.0
            count += 1
    return pairs[:count].copy(), values[:count].copy()
