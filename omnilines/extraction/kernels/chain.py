"""Edge points linked into chains, and chains cut into great circles, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED
from omnilines.extraction.kernels.tables import Edgels, SeenChains
from omnilines.extraction.options import ChainOptions

REACH = 2
"""Pixels to either side in which an edge point looks for its neighbours."""
LEAST_COSINE_ALONG = -0.5
"""Of the angle that a piece of a circle spans: 120 degrees. Longer arcs are two."""


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _offer(k: int, other: int, along: float, across: float, costs: np.ndarray, best: np.ndarray) -> None:
    """Let an edge point take another one for its neighbour where it lies along the edge and nearer than the one it has."""
    size = abs(along)
    if size < np.float32(0.3) or across > np.float32(0.75) * size:
        return
    cost, side = size + np.float32(2.0) * across, 1 if along > 0 else 0
    if cost < costs[k, side]:
        costs[k, side], best[k, side] = cost, other


@njit(cache=True, nogil=True)
@no_type_check
def links(edgels: Edgels, cells: np.ndarray, min_cosine: float) -> np.ndarray:
    """The neighbour (n, 2) of every edge point on either side along its edge, -1 for none.

    `cells` (n, 2) are the rows and columns of the edge points' pixels, in order; `min_cosine` is that between directions of
    neighbours. Each pair is looked at once, from the point that comes first.
    """
    number, points, closed = edgels
    height, width = number.shape
    count, least = len(cells), np.float32(min_cosine)
    best, costs = np.full((count, 2), -1, dtype=np.int32), np.full((count, 2), np.float32(np.inf))
    for k in range(count):
        row, here = cells[k, 0], cells[k, 1]
        u, v, x, y = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        for i in range(row, min(row + REACH + 1, height)):
            for column in range(here + 1 if i == row else here - REACH, here + REACH + 1):
                j = column
                if j < 0 or j >= width:
                    if not closed:
                        continue
                    j %= width
                other = number[i, j]
                if other < 0 or other == k:
                    continue
                p, q = points[other, 2], points[other, 3]
                if abs(x * p + y * q) < least:
                    continue
                du, dv = points[other, 0] - u + np.float32(column - j), points[other, 1] - v
                _offer(k, other, x * dv - y * du, abs(x * du + y * dv), costs, best)
                _offer(other, k, q * du - p * dv, abs(p * du + q * dv), costs, best)
    # In place: a link that is mutual is never taken away from either of both.
    for k in range(count):
        for side in range(2):
            other = best[k, side]
            if other >= 0 and best[other, 0] != k and best[other, 1] != k:
                best[k, side] = -1
    return best


@njit(cache=True, nogil=True)
@no_type_check
def chains(link: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edge points chain by chain, and where each chain begins (one more than chains)."""
    count = len(link)
    order, used = np.empty(count, dtype=np.int32), np.zeros(count, dtype=np.bool_)
    starts = np.empty(count + 1, dtype=np.int64)
    total, made = 0, 0
    # Open ends first; what is left are closed curves.
    for closed_ones in range(2):
        for k in range(count):
            if used[k] or (closed_ones == 0 and link[k, 0] >= 0 and link[k, 1] >= 0):
                continue
            starts[made] = total
            made += 1
            before, here = -1, k
            while here >= 0 and not used[here]:
                used[here] = True
                order[total] = here
                total += 1
                ahead = link[here, 0] if link[here, 0] != before and link[here, 0] >= 0 else link[here, 1]
                if ahead == before:
                    break
                before, here = here, ahead
    starts[made] = total
    return order, starts[: made + 1].copy()


@njit(cache=True, nogil=True)
@no_type_check
def chain_ends(points: np.ndarray, order: np.ndarray, starts: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the edge points of chains of `least` or more: the places (m, 2, 2) half a pixel before and behind each across its edge,
    and the number of its chain (m)."""
    total = 0
    for chain in range(len(starts) - 1):
        if starts[chain + 1] - starts[chain] >= least:
            total += starts[chain + 1] - starts[chain]
    places, number, m = np.empty((total, 2, 2)), np.empty(total, dtype=np.int64), 0
    for chain in range(len(starts) - 1):
        if starts[chain + 1] - starts[chain] < least:
            continue
        for n in range(starts[chain], starts[chain + 1]):
            k = order[n]
            for c in range(2):
                place, half = np.float64(points[k, c]), 0.5 * np.float64(points[k, 2 + c])
                places[m, 0, c], places[m, 1, c] = place - half, place + half
            number[m] = chain
            m += 1
    return places, number


@njit(cache=True, nogil=True)
@no_type_check
def cut_chains(bearing: np.ndarray, seen: np.ndarray, chain: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where chains begin, and one more, the bearings (n, 3) of their points and the changes across, of the bearings (m, 2, 3) at
    `chain_ends` and whether the camera sees these; a chain is cut where it does not."""
    count, pieces, before, cut = 0, 0, -1, False
    starts = np.empty(len(chain) + 1, dtype=np.int64)
    bearings, acrosses = np.empty((len(chain), 3)), np.empty((len(chain), 3))
    for m in range(len(chain)):
        length, pace = 0.0, 0.0
        for c in range(3):
            bearings[count, c] = bearing[m, 0, c] + bearing[m, 1, c]
            acrosses[count, c] = bearing[m, 1, c] - bearing[m, 0, c]
            length += bearings[count, c] ** 2
            pace += acrosses[count, c] ** 2
        if not (seen[m, 0] and seen[m, 1] and pace > 0.0):
            cut = True
            continue
        length = max(math.sqrt(length), 1e-12)
        for c in range(3):
            bearings[count, c] /= length
        if cut or chain[m] != before:
            starts[pieces] = count
            pieces += 1
        before, cut = chain[m], False
        count += 1
    starts[pieces] = count
    return starts[: pieces + 1].copy(), bearings[:count].copy(), acrosses[:count].copy()


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _begin_frame(a: np.ndarray, b: np.ndarray, frame: np.ndarray) -> bool:
    """Fill the frame (rows n, e1, e2) with the unit normal of bearings a and b, a, and n x a; false where they are parallel."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return False
    x, y, z = x / length, y / length, z / length
    frame[0, 0], frame[0, 1], frame[0, 2] = x, y, z
    frame[1, 0], frame[1, 1], frame[1, 2] = a[0], a[1], a[2]
    frame[2, 0], frame[2, 1], frame[2, 2] = y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0]
    return True


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _distance_px(k: int, bearings: np.ndarray, acrosses: np.ndarray, normal: np.ndarray) -> float:
    """Of edge point k from a circle along its gradient: 0 = (bearing + distance across) . normal. Infinite where the gradient
    nearly runs along the circle."""
    x, y, z = acrosses[k, 0], acrosses[k, 1], acrosses[k, 2]
    by_px = x * normal[0] + y * normal[1] + z * normal[2]
    if 4.0 * by_px * by_px < x * x + y * y + z * z:
        return np.inf
    return (bearings[k, 0] * normal[0] + bearings[k, 1] * normal[1] + bearings[k, 2] * normal[2]) / by_px


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _add(sums: np.ndarray, frame: np.ndarray, k: int, bearings: np.ndarray, acrosses: np.ndarray) -> None:
    """Of the least squares over a, b of (bearing . (n + a e1 + b e2) / pace)^2, with frame = (n, e1, e2), edge point k."""
    weight = 1.0 / (acrosses[k, 0] ** 2 + acrosses[k, 1] ** 2 + acrosses[k, 2] ** 2)
    u, v, w = bearings[k, 0], bearings[k, 1], bearings[k, 2]
    r = frame[0, 0] * u + frame[0, 1] * v + frame[0, 2] * w
    x = frame[1, 0] * u + frame[1, 1] * v + frame[1, 2] * w
    y = frame[2, 0] * u + frame[2, 1] * v + frame[2, 2] * w
    sums[0] += x * x * weight
    sums[1] += x * y * weight
    sums[2] += y * y * weight
    sums[3] += x * r * weight
    sums[4] += y * r * weight


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _solve(sums: np.ndarray, frame: np.ndarray, normal: np.ndarray) -> None:
    """Their solution, as a unit normal."""
    determinant = sums[0] * sums[2] - sums[1] * sums[1]
    a = (-sums[3] * sums[2] + sums[4] * sums[1]) / determinant
    b = (-sums[4] * sums[0] + sums[3] * sums[1]) / determinant
    for c in range(3):
        normal[c] = frame[0, c] + a * frame[1, c] + b * frame[2, c]
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for c in range(3):
        normal[c] /= length


@njit(cache=True, nogil=True)
@no_type_check
def circles(seen: SeenChains, within_px: float, options: ChainOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals (m, 3) of great circles along pieces of chains, the first and last bearing of each (m, 2, 3), and the information
    (m, 3, 3) on the normal.

    A piece begins with `min_points` edge points on one circle and grows, fitted anew with each, until more than `max_missed`
    in a row are farther than `within_px` from it.
    """
    starts, bearings, acrosses = seen
    least, sigma_px = options.min_points, options.sigma_px
    room = 1024
    normals, ends, information = np.empty((room, 3)), np.empty((room, 2, 3)), np.empty((room, 3, 3))
    count = 0
    frame, sums, normal = np.empty((3, 3)), np.empty(5), np.empty(3)
    for chain in range(len(starts) - 1):
        begin, stop = starts[chain], starts[chain + 1]
        while begin + least <= stop:
            if not _begin_frame(bearings[begin], bearings[begin + least - 1], frame):
                begin += 1
                continue
            sums[:] = 0.0
            for k in range(begin, begin + least):
                _add(sums, frame, k, bearings, acrosses)
            _solve(sums, frame, normal)
            worst = 0.0
            for k in range(begin, begin + least):
                worst = max(worst, abs(_distance_px(k, bearings, acrosses, normal)))
            if worst > 0.8 * within_px:
                begin += 1
                continue
            end, missed = begin + least - 1, 0
            for k in range(begin + least, stop):
                if (
                    frame[1, 0] * bearings[k, 0] + frame[1, 1] * bearings[k, 1] + frame[1, 2] * bearings[k, 2]
                    < LEAST_COSINE_ALONG
                ):
                    break
                if abs(_distance_px(k, bearings, acrosses, normal)) <= within_px:
                    _add(sums, frame, k, bearings, acrosses)
                    _solve(sums, frame, normal)
                    end, missed = k, 0
                else:
                    missed += 1
                    if missed > options.max_missed:
                        break
            if count == room:
                room *= 2
                normals, ends, information = _grown(normals, room), _grown(ends, room), _grown(information, room)
            normals[count] = normal
            ends[count, 0], ends[count, 1] = frame[1], bearings[end]
            information[count] = 0.0
            for k in range(begin, end + 1):
                weight = 1.0 / ((acrosses[k, 0] ** 2 + acrosses[k, 1] ** 2 + acrosses[k, 2] ** 2) * sigma_px * sigma_px)
                for p in range(3):
                    for q in range(3):
                        information[count, p, q] += weight * bearings[k, p] * bearings[k, q]
            count += 1
            begin = end + 1
    return normals[:count].copy(), ends[:count].copy(), information[:count].copy()


@njit(cache=True, nogil=True)
@no_type_check
def _grown(array: np.ndarray, room: int) -> np.ndarray:
    more = np.empty((room, *array.shape[1:]))
    more[: len(array)] = array
    return more
