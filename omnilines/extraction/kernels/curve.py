"""Points a pixel apart along arcs, read off curves through a few nodes of each; compiled.

The nodes of arc n are rows node_starts[n] to node_starts[n + 1] of a table, at equal steps of the angle.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.tables import Curves


@njit(cache=True, nogil=True)
@no_type_check
def rays_beside(frame: np.ndarray, owner: np.ndarray, angle: np.ndarray, step: float) -> np.ndarray:
    """Bearings (5, m, 3): at angles on the circles `owner`, half a step behind and ahead, and half a step away from the
    normal and towards it, for frames (n, 3, 3) with the columns normal, first, second."""
    rays = np.empty((5, len(owner), 3))
    for m in range(len(owner)):
        for row, moved in ((0, 0.0), (1, -0.5 * step), (2, 0.5 * step)):
            cosine, sine = math.cos(angle[m] + moved), math.sin(angle[m] + moved)
            for k in range(3):
                rays[row, m, k] = cosine * frame[owner[m], k, 1] + sine * frame[owner[m], k, 2]
        for k in range(3):
            rays[3, m, k] = rays[0, m, k] - 0.5 * step * frame[owner[m], k, 0]
            rays[4, m, k] = rays[0, m, k] + 0.5 * step * frame[owner[m], k, 0]
    return rays


@njit(cache=True, nogil=True)
@no_type_check
def unwrapped(table: np.ndarray, node_starts: np.ndarray, width: float) -> None:
    """Let the columns of pixels go on across the seam of an image of this width, in place."""
    for arc in range(len(node_starts) - 1):
        for k in range(node_starts[arc] + 1, node_starts[arc + 1]):
            table[k, 0] -= width * round((table[k, 0] - table[k - 1, 0]) / width)


@njit(cache=True, nogil=True)
@no_type_check
def slopes(table: np.ndarray, node_starts: np.ndarray, interval: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Derivatives of the table (m, 6) times the interval between nodes (n): pixel, change along and change across.

    That of the pixel is the change along; the others are differences of five nodes with `weights` (5, 5) for the derivative at
    each of them.
    """
    slope = np.zeros_like(table)
    for arc in range(len(node_starts) - 1):
        begin, end = node_starts[arc], node_starts[arc + 1]
        for k in range(begin, end):
            low = min(max(k - 2, begin), end - 5)
            for c in range(2, 6):
                for m in range(5):
                    slope[k, c] += weights[k - low, m] * table[low + m, c]
            for c in range(2):
                slope[k, c] = table[k, 2 + c] * interval[arc]
    return slope


@njit(cache=True, nogil=True)
@no_type_check
def smooth_intervals(
    table: np.ndarray, valid: np.ndarray, node_starts: np.ndarray, most_px: float, most_share: float, safety: float
) -> np.ndarray:
    """Whether the cubics from each node (m) to the next of its arc are good.

    The error of Hermite's cubic is at most h^4 f'''' / 384; fourth differences of the nodes around measure h^4 f''''. It may be
    `most_px` for the pixel, and `most_share` of its length for the change along, of the rate for that across.
    """
    good, error = np.zeros(len(table), dtype=np.bool_), np.zeros((len(table), 3))
    for arc in range(len(node_starts) - 1):
        begin, end = node_starts[arc], node_starts[arc + 1]
        for k in range(begin + 2, end - 2):
            for c in range(6):
                outer, inner = table[k - 2, c] + table[k + 2, c], table[k - 1, c] + table[k + 1, c]
                fourth = abs(outer - 4.0 * inner + 6.0 * table[k, c])
                error[k, c // 2] = max(error[k, c // 2], safety / 384.0 * fourth)
        for k in range(begin, end - 1):
            fine, along, rate = True, np.inf, np.inf
            for m in range(k, k + 2):
                length = math.hypot(table[m, 2], table[m, 3])
                turned = abs(table[m, 2] * table[m, 5] - table[m, 3] * table[m, 4])
                along, rate = min(along, length), min(rate, turned / max(length, 1e-12))
                fine = fine and valid[m]
            for m in range(min(max(k - 1, begin + 2), end - 3), max(min(k + 3, end - 2), begin + 3)):
                fine = fine and error[m, 0] < most_px and error[m, 1] < most_share * along
                fine = fine and error[m, 2] < most_share * rate
            good[k] = fine
    return good


@njit(cache=True, nogil=True)
@no_type_check
def leave_out_far(
    good: np.ndarray, angle: np.ndarray, node_starts: np.ndarray, first: np.ndarray, second: np.ndarray, least: float
) -> None:
    """Mark as not good where an arc goes farther from the axis than an angle whose cosine is `least`, between nodes too.

    The cosine along arc n is first[n] cos t + second[n] sin t: smallest at an end, or -hypot(first, second) where that is.
    """
    for arc in range(len(node_starts) - 1):
        size, farthest = math.hypot(first[arc], second[arc]), math.atan2(-second[arc], -first[arc])
        if -size > least:
            continue
        for k in range(node_starts[arc], node_starts[arc + 1] - 1):
            low, high = angle[k] - farthest, angle[k + 1] - farthest
            if max(math.cos(low), math.cos(high)) * size > -least or math.floor(low / math.tau) < math.floor(high / math.tau):
                good[k] = False


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _hermite(s: float, k: int, c: int, table: np.ndarray, slope: np.ndarray) -> float:
    """Column c at the share s of the way from node k to the next."""
    low, high, t = table[k, c], table[k + 1, c], 1.0 - s
    return low + s * s * (3.0 - 2.0 * s) * (high - low) + s * t * t * slope[k, c] - s * s * t * slope[k + 1, c]


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED, **BORROWED)
@no_type_check
def _all_columns(s: float, k: int, table: np.ndarray, slope: np.ndarray, value: np.ndarray) -> None:
    """As `_hermite`, of all columns."""
    t = 1.0 - s
    high, out, back = s * s * (3.0 - 2.0 * s), s * t * t, -s * s * t
    for c in range(6):
        value[c] = (1.0 - high) * table[k, c] + high * table[k + 1, c] + out * slope[k, c] + back * slope[k + 1, c]


@njit(cache=True, nogil=True)
@no_type_check
def lengths_along(curves: Curves, parts: int) -> np.ndarray:
    """Lengths (n, parts + 1) in pixels from the begin of each arc, at equal steps of the angle."""
    node_starts, table, slope = curves.starts, curves.table, curves.slope
    run = np.zeros((len(node_starts) - 1, parts + 1))
    for arc in range(len(run)):
        begin, count = node_starts[arc], node_starts[arc + 1] - node_starts[arc] - 1
        u, v = table[begin, 0], table[begin, 1]
        for part in range(1, parts + 1):
            k = min(part * count // parts, count - 1)
            s = part * count / parts - k
            x, y = _hermite(s, begin + k, 0, table, slope), _hermite(s, begin + k, 1, table, slope)
            run[arc, part] = run[arc, part - 1] + max(math.hypot(x - u, y - v), 1e-6)
            u, v = x, y
    return run


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED)
@no_type_check
def read_curves(
    curves: Curves, run: np.ndarray, starts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples of arcs at equal steps of the length `run`, those of arc n from starts[n] on: owner, angle, pixel, unit vector
    across, rate, and whether the cubics are good there (the pixel and what follows mean nothing otherwise)."""
    node_starts, angle, table, slope, good = curves
    count, parts = starts[-1], run.shape[1] - 1
    owner, place = np.empty(count, dtype=np.int64), np.empty(count)
    pixel, across = np.empty((count, 2)), np.empty((count, 2))
    rate, smooth, value = np.empty(count), np.empty(count, dtype=np.bool_), np.empty(6)
    for arc in range(len(starts) - 1):
        begin, nodes = node_starts[arc], node_starts[arc + 1] - node_starts[arc] - 1
        low, span = angle[begin], angle[begin + nodes] - angle[begin]
        spacing, part = run[arc, -1] / (starts[arc + 1] - starts[arc]), 0
        over = 1.0 / (run[arc, 1] - run[arc, 0])
        for n in range(starts[arc], starts[arc + 1]):
            at = (n - starts[arc] + 0.5) * spacing
            while part < parts - 1 and run[arc, part + 1] < at:
                part += 1
                over = 1.0 / (run[arc, part + 1] - run[arc, part])
            share = (part + (at - run[arc, part]) * over) / parts
            step = min(int(share * nodes), nodes - 1)
            s, k = share * nodes - step, begin + step
            owner[n], place[n], smooth[n] = arc, low + share * span, good[k]
            _all_columns(s, k, table, slope, value)
            x, y = -value[3], value[2]
            length = max(math.sqrt(x * x + y * y), 1e-12)
            by = (x * value[4] + y * value[5]) / length
            sign = -1.0 if by < 0.0 else 1.0
            pixel[n, 0], pixel[n, 1] = value[0], value[1]
            across[n, 0], across[n, 1], rate[n] = sign * x / length, sign * y / length, sign * by
    return owner, place, pixel, across, rate, smooth
