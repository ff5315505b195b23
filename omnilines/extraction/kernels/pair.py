"""Pairs of arcs that follow each other on nearly one circle, or lie beside each other; compiled.

Arcs are looked up by where they are on the sphere, so that the work goes with the number of arcs, not with its square.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.tables import PairLimits, Ranked

_LEAST_CELL, _MOST_CELL = 0.5, 1.5
"""Side of a cell, in mean spans of arcs: smaller ones hold fewer arcs, but all that lie beside an arc are found from it."""
_STRETCH = 1.5
"""How much longer a gap may be in radians than its pixels at the arc before it say."""
_MOST_OFF = 0.8
"""Of a cell's side: what lies farther off a circle is not found from it."""


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _along(frame: np.ndarray, arc: int, angle: float, ray: np.ndarray) -> None:
    """Fill `ray` with the bearing at an angle on a circle whose frame has the columns normal, first, second."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for k in range(3):
        ray[k] = cosine * frame[arc, k, 1] + sine * frame[arc, k, 2]


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _angle(frame: np.ndarray, arc: int, ray: np.ndarray) -> float:
    """Of a bearing on the circle."""
    return math.atan2(
        ray[0] * frame[arc, 0, 2] + ray[1] * frame[arc, 1, 2] + ray[2] * frame[arc, 2, 2],
        ray[0] * frame[arc, 0, 1] + ray[1] * frame[arc, 1, 1] + ray[2] * frame[arc, 2, 1],
    )


@njit(cache=True, nogil=True)
@no_type_check
def _bucket(i: int, j: int, k: int, most: int) -> int:
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & most


@njit(cache=True, nogil=True)
@no_type_check
def _table(frame: np.ndarray, low: np.ndarray, high: np.ndarray, reach: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the rows of each bucket begin, one more than buckets (a power of 2), and the arcs in them: those that pass through
    its cells between `reach` before their low and after their high end."""
    total = 0
    for arc in range(len(low)):
        total += int((high[arc] - low[arc] + 2.0 * reach[arc]) / cell) + 2
    size = 1024
    while size < 2 * total:
        size *= 2
    bucket, owner = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int32)
    starts, ray, n = np.zeros(size + 1, dtype=np.int64), np.empty(3), 0
    for arc in range(len(low)):
        span = high[arc] - low[arc] + 2.0 * reach[arc]
        parts = int(span / cell) + 1
        for part in range(parts + 1):
            _along(frame, arc, low[arc] - reach[arc] + span * part / parts, ray)
            i, j, k = math.floor(ray[0] / cell), math.floor(ray[1] / cell), math.floor(ray[2] / cell)
            bucket[n], owner[n] = _bucket(i, j, k, size - 1), arc
            starts[bucket[n] + 1] += 1
            n += 1
    for k in range(size):
        starts[k + 1] += starts[k]
    rows, filled = np.empty(total, dtype=np.int32), starts[:-1].copy()
    for n in range(total):
        rows[filled[bucket[n]]] = owner[n]
        filled[bucket[n]] += 1
    return starts, rows


@njit(cache=True, nogil=True)
@no_type_check
def near_pairs(table: Ranked, limits: PairLimits) -> tuple[np.ndarray, np.ndarray, int]:
    """Pairs (k, 2) of arcs, the one of higher rank first, and (k, 4) the angles of the ends of the second on the first one's
    circle, the gap between both in radians, negative where they overlap, and whether the second follows the first one's high end;
    and how many pairs were looked at.

    Their normals, or one and the opposite of the other, are at most `near_rad` apart; the ends of the second lie at most `beside`
    (of the first) off the first one's circle; together they span less than `longest_rad`. The gap is below both limits and half
    of both lengths; or the second lies beside the first over more than half of its length.
    """
    # The one of highest rank first: of each cell's arcs those before an arc are all that it is compared with.
    order = np.argsort(-table.rank, kind="mergesort")
    frame, low, high = table.frame[order], table.low[order], table.high[order]
    length_px, beside = table.rank[order], table.beside[order]
    near, most_gap_px, most_gap, longest = limits
    arcs, count, room, looked = len(low), 0, 1024, 0
    pairs, values = np.empty((room, 2), dtype=np.int64), np.empty((room, 4))
    least_cosine, ppr, reach, total = 1.0 - 0.5 * near * near, np.empty(arcs), np.empty(arcs), 0.0
    ends, normal, off = np.empty((arcs, 2, 3)), np.empty((arcs, 3)), np.empty(2)
    for arc in range(arcs):
        span = max(high[arc] - low[arc], 1e-9)
        ppr[arc] = length_px[arc] / span
        gap = min(min(most_gap_px, length_px[arc]) / max(ppr[arc], 1e-9), most_gap)
        # The middle of the other one lies half its span beyond the gap, and it is the shorter one.
        reach[arc] = _STRETCH * (gap + 0.5 * span) if most_gap_px > 0.0 else 0.0
        total += span
        normal[arc] = frame[arc, :, 0]
        _along(frame, arc, low[arc], ends[arc, 0])
        _along(frame, arc, high[arc], ends[arc, 1])
    mean = total / max(arcs, 1)
    cell = min(max(_LEAST_CELL * mean, np.max(beside) / _MOST_OFF), _MOST_CELL * mean)
    starts, rows = _table(frame, low, high, reach, cell)
    most, seen, ray = len(starts) - 2, np.full(arcs, -1, dtype=np.int32), np.empty(3)
    for b in range(arcs):
        _along(frame, b, 0.5 * (low[b] + high[b]), ray)
        i, j, k = math.floor(ray[0] / cell), math.floor(ray[1] / cell), math.floor(ray[2] / cell)
        for neighbour in range(27):
            key = _bucket(i + neighbour // 9 - 1, j + neighbour // 3 % 3 - 1, k + neighbour % 3 - 1, most)
            for row in range(starts[key], starts[key + 1]):
                a = rows[row]
                if a >= b:
                    break
                if seen[a] == b:
                    continue
                seen[a] = b
                looked += 1
                cosine = normal[a, 0] * normal[b, 0] + normal[a, 1] * normal[b, 1] + normal[a, 2] * normal[b, 2]
                if abs(cosine) < least_cosine:
                    continue
                for side in range(2):
                    x, y, z = ends[b, side]
                    off[side] = abs(x * normal[a, 0] + y * normal[a, 1] + z * normal[a, 2])
                if max(off[0], off[1]) > min(beside[a], _MOST_OFF * cell):
                    continue
                one, two = _angle(frame, a, ends[b, 0]), _angle(frame, a, ends[b, 1])
                first, last = min(one, two), max(one, two)
                # An arc that straddles the far side of a's circle has its ends on both sides of pi.
                if last - first >= math.pi or max(last, high[a]) - min(first, low[a]) >= longest:
                    continue
                ahead, behind = first - high[a], low[a] - last
                gap = max(ahead, behind)
                most_px = min(most_gap_px, 0.5 * (length_px[a] + length_px[b]))
                follows = gap < most_gap and gap * min(ppr[a], ppr[b]) < most_px
                overlaps = min(last, high[a]) - max(first, low[a]) > 0.5 * max(last - first, 1e-9)
                if not (overlaps or (follows and most_gap_px > 0.0)):
                    continue
                if count == room:
                    room *= 2
                    more_pairs, more_values = np.empty((room, 2), dtype=np.int64), np.empty((room, 4))
                    more_pairs[:count], more_values[:count] = pairs, values
                    pairs, values = more_pairs, more_values
                pairs[count, 0], pairs[count, 1] = order[a], order[b]
                values[count, 0], values[count, 1], values[count, 2] = first, last, gap
                values[count, 3] = 1.0 if ahead >= behind else 0.0
                count += 1
    return pairs[:count].copy(), values[:count].copy(), looked
