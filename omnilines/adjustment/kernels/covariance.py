"""The line engine's last passes: the covariance of every line, and how some lines follow the frames.

With Z_i = L^-1 J_i' and C_ij the covariance of two frames, a line's own is

    L'^-1 (I + sum_ij Z_i (P_i C_ij P_j') Z_j') L^-1

and its step follows the frames' by the gain -E^-1 sum J_i' P_i = -L'^-1 sum Z_i P_i.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.adjustment.kernels.line import FAST, backward, most_views
from omnilines.adjustment.kernels.schur import observe, whitened_rows


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def spread_of_pairs(pairs, frame, low, high, z, p, covariance, e):
    """e += sum Z_i (P_i C_ij P_j') Z_j' over all observations of one line in free frames."""
    for k in range(low, high):
        i = k - low
        base = pairs.window[frame[k]] - frame[k]
        for m in range(k, high):
            j, c = m - low, pairs.block_of[base + frame[m]]
            for a in range(2):
                for b in range(2):
                    share = 0.0
                    for x in range(6):
                        for y in range(6):
                            share += p[i, a, x] * covariance[c, x, y] * p[j, b, y]
                    for x in range(4):
                        for y in range(4):
                            value = z[i, 4 * a + x] * share * z[j, 4 * b + y]
                            e[x, y] += value
                            if m != k:
                                e[y, x] += value


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def conjugate(factor, e, result):
    """L'^-1 e L^-1 of a symmetric e (4 x 4)."""
    columns = np.empty((4, 4))
    for x in range(4):
        columns[x, 0], columns[x, 1], columns[x, 2], columns[x, 3] = backward(factor, e[0, x], e[1, x], e[2, x], e[3, x])
    for x in range(4):
        result[x, 0], result[x, 1], result[x, 2], result[x, 3] = backward(
            factor, columns[0, x], columns[1, x], columns[2, x], columns[3, x]
        )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def line_covariances(low, high, views, pose, lines, pairs, covariance, solved, result):
    """Fill `result` (t x 4 x 4) of the lines at the places low to high; NaN where the observations say nothing of a line."""
    most = most_views(views, low, high)
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z, e = np.empty((most, 2)), np.zeros((most, 8)), np.empty((4, 4))
    for place in range(low, high):
        line, begin, end = views.order[place], views.start[place], views.start[place + 1]
        known = solved.diagonal[line]
        if not (known[0] > 0.0 or known[1] > 0.0 or known[2] > 0.0 or known[3] > 0.0):
            result[line] = np.nan
            continue
        observe(views, place, pose, lines, r, by_line, by_frame)
        whitened_rows(by_line, end - begin, solved.factors[line], z)
        e[:] = 0.0
        for x in range(4):
            e[x, x] = 1.0
        seen = begin
        while seen < end and views.frame[seen] < pairs.free:
            seen += 1
        spread_of_pairs(pairs, views.frame, begin, seen, z, by_frame, covariance, e)
        conjugate(solved.factors[line], e, result[line])


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def line_gains(places, views, pose, lines, free, solved, result):
    """Add L'^-1 sum Z_i P_i of the lines at some places to `result` (places x 4 x 6 frames)."""
    most = most_views(views, 0, len(views.order))
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z = np.empty((most, 2)), np.zeros((most, 8))
    for c in range(len(places)):
        begin, end = views.start[places[c]], views.start[places[c] + 1]
        factor = solved.factors[views.order[places[c]]]
        observe(views, places[c], pose, lines, r, by_line, by_frame)
        whitened_rows(by_line, end - begin, factor, z)
        for k in range(begin, end):
            i, f = k - begin, views.frame[k]
            if f >= free:
                break
            for a in range(2):
                gain = backward(factor, z[i, 4 * a], z[i, 4 * a + 1], z[i, 4 * a + 2], z[i, 4 * a + 3])
                for g in range(4):
                    for x in range(6):
                        result[c, g, 6 * f + x] += gain[g] * by_frame[i, a, x]
