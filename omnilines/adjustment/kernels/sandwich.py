"""The line engine's passes for a cost that does not weigh arcs by their noise: H^-1 K H^-1 (see `weighting.py`).

With C_i the covariance of an arc's two residuals and Z_i, P_i as in `schur_kernel.py`, Q = sum Z_i C_i Z_i' and T_i = Z_i C_i
- Q Z_i, the right side of the reduced system has the covariance

    K_ij = P_i' ([i = j] C_i - C_i Z_i' Z_j - Z_i' Z_j C_j + Z_i' Q Z_j) P_j,

and, with X = S^-1 K S^-1 of the frames, a line's own is

    L'^-1 (Q + sum_ij Z_i P_i X_ij P_j' Z_j' - sum_ij (T_i P_i S^-1_ij P_j' Z_j' + its transpose)) L^-1.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.adjustment.kernels.covariance import conjugate, spread_of_pairs
from omnilines.adjustment.kernels.line import FAST, backward, most_views
from omnilines.adjustment.kernels.schur import add_block, observe, whitened_rows


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def scattered(scatter, low, high, z, y, q):
    """Q (4 x 4) of one line, and Y_i = Z_i C_i (k x 8: column after column)."""
    q[:] = 0.0
    for k in range(low, high):
        i = k - low
        for x in range(4):
            y[i, x] = z[i, x] * scatter[k, 0, 0] + z[i, 4 + x] * scatter[k, 1, 0]
            y[i, 4 + x] = z[i, x] * scatter[k, 0, 1] + z[i, 4 + x] * scatter[k, 1, 1]
        for x in range(4):
            for c in range(4):
                q[x, c] += y[i, x] * z[i, c] + y[i, 4 + x] * z[i, 4 + c]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def unshared(views, z, y, q, t):
    """T_i = Y_i - Q Z_i (k x 8) of one line."""
    for i in range(views):
        for a in range(0, 8, 4):
            for x in range(4):
                value = y[i, a + x]
                for c in range(4):
                    value -= q[x, c] * z[i, a + c]
                t[i, a + x] = value


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_scatter(pairs, frame, scatter, low, high, z, y, t, p, blocks):
    """Add K_ij of all pairs i <= j of one line's observations in free frames; the inner 2 x 2 is -Z_i' T_j - Y_i' Z_j."""
    for k in range(low, high):
        i = k - low
        base = pairs.window[frame[k]] - frame[k]
        for m in range(k, high):
            j = m - low
            s00 = s01 = s10 = s11 = 0.0
            for x in range(4):
                s00 -= z[i, x] * t[j, x] + y[i, x] * z[j, x]
                s01 -= z[i, x] * t[j, 4 + x] + y[i, x] * z[j, 4 + x]
                s10 -= z[i, 4 + x] * t[j, x] + y[i, 4 + x] * z[j, x]
                s11 -= z[i, 4 + x] * t[j, 4 + x] + y[i, 4 + x] * z[j, 4 + x]
            b = pairs.block_of[base + frame[m]] - pairs.first
            if m == k:
                s00, s01 = s00 + scatter[k, 0, 0], s01 + scatter[k, 0, 1]
                s10, s11 = s10 + scatter[k, 1, 0], s11 + scatter[k, 1, 1]
            add_block(blocks, b, p, i, j, s00, s01, s10, s11)
            if m != k and frame[m] == frame[k]:
                # Two observations of the line in one photo: the block of a frame with itself takes both orders.
                add_block(blocks, b, p, j, i, s00, s10, s01, s11)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def scatter_lines(low, high, views, scatter, pose, lines, pairs, solved, blocks, inner):
    """Add K of the lines at the places low to high to `blocks`, and fill their Q (t x 4 x 4)."""
    most = most_views(views, low, high)
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z, y, t = np.empty((most, 2)), np.zeros((most, 8)), np.zeros((most, 8)), np.zeros((most, 8))
    for place in range(low, high):
        line, begin, end = views.order[place], views.start[place], views.start[place + 1]
        observe(views, place, pose, lines, r, by_line, by_frame)
        whitened_rows(by_line, end - begin, solved.factors[line], z)
        scattered(scatter, begin, end, z, y, inner[line])
        unshared(end - begin, z, y, inner[line], t)
        seen = begin
        while seen < end and views.frame[seen] < pairs.free:
            seen += 1
        add_scatter(pairs, views.frame, scatter, begin, seen, z, y, t, by_frame, blocks)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def take_shared(pairs, frame, low, high, t, z, p, inverse, e):
    """e -= sum (T_i P_i S^-1_ij P_j' Z_j' + its transpose) over all observations of one line in free frames."""
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
                            share += p[i, a, x] * inverse[c, x, y] * p[j, b, y]
                    for x in range(4):
                        for y in range(4):
                            value = t[i, 4 * a + x] * share * z[j, 4 * b + y]
                            if m != k:
                                value += z[i, 4 * a + x] * share * t[j, 4 * b + y]
                            e[x, y] -= value
                            e[y, x] -= value


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def line_sandwiches(low, high, views, scatter, pose, lines, pairs, covariance, inverse, solved, inner, result):
    """Fill `result` (t x 4 x 4) of the lines at the places low to high; NaN where the observations say nothing of a line."""
    most = most_views(views, low, high)
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z, y, t = np.empty((most, 2)), np.zeros((most, 8)), np.zeros((most, 8)), np.zeros((most, 8))
    e = np.empty((4, 4))
    for place in range(low, high):
        line, begin, end = views.order[place], views.start[place], views.start[place + 1]
        known = solved.diagonal[line]
        if not (known[0] > 0.0 or known[1] > 0.0 or known[2] > 0.0 or known[3] > 0.0):
            result[line] = np.nan
            continue
        observe(views, place, pose, lines, r, by_line, by_frame)
        whitened_rows(by_line, end - begin, solved.factors[line], z)
        scattered(scatter, begin, end, z, y, e)
        unshared(end - begin, z, y, inner[line], t)
        seen = begin
        while seen < end and views.frame[seen] < pairs.free:
            seen += 1
        spread_of_pairs(pairs, views.frame, begin, seen, z, by_frame, covariance, e)
        take_shared(pairs, views.frame, begin, seen, t, z, by_frame, inverse, e)
        conjugate(solved.factors[line], e, result[line])


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def shared_gains(places, views, scatter, pose, lines, free, solved, inner, result):
    """Add L'^-1 sum T_i P_i of the lines at some places to `result` (places x 4 x 6 frames)."""
    most = most_views(views, 0, len(views.order))
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z, y, t = np.empty((most, 2)), np.zeros((most, 8)), np.zeros((most, 8)), np.zeros((most, 8))
    q = np.empty((4, 4))
    for c in range(len(places)):
        begin, end = views.start[places[c]], views.start[places[c] + 1]
        line = views.order[places[c]]
        observe(views, places[c], pose, lines, r, by_line, by_frame)
        whitened_rows(by_line, end - begin, solved.factors[line], z)
        scattered(scatter, begin, end, z, y, q)
        unshared(end - begin, z, y, inner[line], t)
        for k in range(begin, end):
            i, f = k - begin, views.frame[k]
            if f >= free:
                break
            for a in range(2):
                gain = backward(solved.factors[line], t[i, 4 * a], t[i, 4 * a + 1], t[i, 4 * a + 2], t[i, 4 * a + 3])
                for g in range(4):
                    for x in range(6):
                        result[c, g, 6 * f + x] += gain[g] * by_frame[i, a, x]
