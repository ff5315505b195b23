"""The fused pass of the line engine: residuals, Jacobians, line blocks and the Schur complement onto pairs of frames.

With J_i the derivative of an observation's two residuals by its line (2 x 4), P_i by its frame (2 x 6), E = sum J_i' J_i = L L'
and Z_i = L^-1 J_i', the reduced system of the frames is

    S_ij = [i = j] P_i' P_i - P_i' (Z_i' Z_j) P_j,      g_i = -P_i' (r_i + Z_i' y),  y = -L^-1 sum J_i' r_i

so that only 2 x 2 products are formed for a pair before the rank-2 update of its 6 x 6 block. Nothing is kept of an observation:
what back-substitution needs is formed anew, which is faster than to read it from memory.

The blocks of pairs i <= j are kept.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.adjustment.kernels.line import FAST, factorise, forward, most_views, residual, robust, view


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def observe(views, place, pose, lines, r, by_line, by_frame):
    """Weighted residuals r (k x 2), J (k x 8: row after row) and P (k x 2 x 6) of the observations of one line."""
    line, low, high = views.order[place], views.start[place], views.start[place + 1]
    turn, centre, rho, phi = lines.turn[line], lines.centre[line], lines.rho[line], lines.phi[line]
    moves = 0.0 if lines.held[line] else 1.0
    d0, d1, d2 = turn[0, 0], turn[1, 0], turn[2, 0]
    e0, e1, e2 = turn[0, 1], turn[1, 1], turn[2, 1]
    f0, f1, f2 = turn[0, 2], turn[1, 2], turn[2, 2]
    length, cosine = rho * math.tan(phi), math.cos(phi)
    stretch = rho / (cosine * cosine)
    c0, c1, c2 = centre[0], centre[1], centre[2]
    for k in range(low, high):
        i, f = k - low, views.frame[k]
        x, y, z, u, v, w, o0, o1, o2 = view(pose, f, c0, c1, c2, length * e0, length * e1, length * e2, d0, d1, d2)
        r[i, 0], a0, a1, a2 = residual(views.rows, views.spread, k, 0, x, y, z)
        r[i, 1], b0, b1, b2 = residual(views.rows, views.spread, k, 1, x, y, z)
        _, weight = robust(views.kind, views.scale, r[i, 0] * r[i, 0] + r[i, 1] * r[i, 1])
        root = math.sqrt(weight)
        for a in range(2):
            r[i, a] *= root
            n0, n1, n2 = (a0 * root, a1 * root, a2 * root) if a == 0 else (b0 * root, b1 * root, b2 * root)
            # exp(delta) T moves M by w x M + v x (R d).
            by_frame[i, a, 0], by_frame[i, a, 1], by_frame[i, a, 2] = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
            by_frame[i, a, 3], by_frame[i, a, 4], by_frame[i, a, 5] = v * n2 - w * n1, w * n0 - u * n2, u * n1 - v * n0
            g0 = pose[f, 0] * n0 + pose[f, 3] * n1 + pose[f, 6] * n2
            g1 = pose[f, 1] * n0 + pose[f, 4] * n1 + pose[f, 7] * n2
            g2 = pose[f, 2] * n0 + pose[f, 5] * n1 + pose[f, 8] * n2
            h0, h1, h2 = g1 * o2 - g2 * o1, g2 * o0 - g0 * o2, g0 * o1 - g1 * o0
            along_s2 = g0 * e0 + g1 * e1 + g2 * e2
            by_line[i, 4 * a] = moves * length * (g0 * f0 + g1 * f1 + g2 * f2)
            by_line[i, 4 * a + 1] = -moves * (h0 * f0 + h1 * f1 + h2 * f2)
            by_line[i, 4 * a + 2] = moves * ((h0 * e0 + h1 * e1 + h2 * e2) - length * (g0 * d0 + g1 * d1 + g2 * d2))
            by_line[i, 4 * a + 3] = moves * stretch * along_s2


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def line_block(by_line, r, views, e, gradient):
    """E (lower triangle) and the negative gradient of one line."""
    e[:] = 0.0
    gradient[:] = 0.0
    for i in range(views):
        for a in range(2):
            for x in range(4):
                value = by_line[i, 4 * a + x]
                gradient[x] -= value * r[i, a]
                for y in range(x + 1):
                    e[x, y] += value * by_line[i, 4 * a + y]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def whitened_rows(by_line, views, factor, z):
    """Z_i (k x 8: column after column) of one line."""
    for i in range(views):
        for a in range(0, 8, 4):
            z[i, a], z[i, a + 1], z[i, a + 2], z[i, a + 3] = forward(
                factor, by_line[i, a], by_line[i, a + 1], by_line[i, a + 2], by_line[i, a + 3]
            )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_block(blocks, b, p, i, j, s00, s01, s10, s11):
    """blocks[b] += P_i' A P_j for A (2 x 2). Rows of arrays are not taken out: each would count its references."""
    a0, a1, a2, a3, a4, a5 = p[j, 0, 0], p[j, 0, 1], p[j, 0, 2], p[j, 0, 3], p[j, 0, 4], p[j, 0, 5]
    b0, b1, b2, b3, b4, b5 = p[j, 1, 0], p[j, 1, 1], p[j, 1, 2], p[j, 1, 3], p[j, 1, 4], p[j, 1, 5]
    for x in range(6):
        u = p[i, 0, x] * s00 + p[i, 1, x] * s10
        v = p[i, 0, x] * s01 + p[i, 1, x] * s11
        # All six sums before the first is stored, which might be read again for all the compiler knows.
        c0, c1, c2 = blocks[b, x, 0] + u * a0 + v * b0, blocks[b, x, 1] + u * a1 + v * b1, blocks[b, x, 2] + u * a2 + v * b2
        c3, c4, c5 = blocks[b, x, 3] + u * a3 + v * b3, blocks[b, x, 4] + u * a4 + v * b4, blocks[b, x, 5] + u * a5 + v * b5
        blocks[b, x, 0], blocks[b, x, 1], blocks[b, x, 2] = c0, c1, c2
        blocks[b, x, 3], blocks[b, x, 4], blocks[b, x, 5] = c3, c4, c5


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_pairs(pairs, frame, low, high, z, p, blocks):
    """Add P_i' ([i = j] I - Z_i' Z_j) P_j to the blocks of all pairs i <= j of one line's observations in free frames."""
    for k in range(low, high):
        i = k - low
        base = pairs.window[frame[k]] - frame[k]
        for m in range(k, high):
            j = m - low
            s00 = s01 = s10 = s11 = 0.0
            for x in range(4):
                s00 -= z[i, x] * z[j, x]
                s01 -= z[i, x] * z[j, 4 + x]
                s10 -= z[i, 4 + x] * z[j, x]
                s11 -= z[i, 4 + x] * z[j, 4 + x]
            b = pairs.block_of[base + frame[m]] - pairs.first
            if m == k:
                s00, s11 = 1.0 + s00, 1.0 + s11
            add_block(blocks, b, p, i, j, s00, s01, s10, s11)
            if m != k and frame[m] == frame[k]:
                # Two observations of the line in one photo: the block of a frame with itself takes both orders.
                add_block(blocks, b, p, j, i, s00, s10, s01, s11)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_gradient(frame, low, high, r, z, y, p, sums):
    """Add the right side, -sum P'r and the diagonal of P'P of one line's observations, with y = L^-1 times its gradient."""
    for k in range(low, high):
        i, f = k - low, frame[k]
        t0 = -r[i, 0] - (z[i, 0] * y[0] + z[i, 1] * y[1] + z[i, 2] * y[2] + z[i, 3] * y[3])
        t1 = -r[i, 1] - (z[i, 4] * y[0] + z[i, 5] * y[1] + z[i, 6] * y[2] + z[i, 7] * y[3])
        for x in range(6):
            a, b = p[i, 0, x], p[i, 1, x]
            sums.gradient[f, x] += a * t0 + b * t1
            sums.gradient[f, 6 + x] -= a * r[i, 0] + b * r[i, 1]
            sums.diagonal[f, x] += a * a + b * b


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def reduce_lines(low, high, views, pose, lines, damping, pairs, sums, solved):
    """Add the lines at the places low to high to `sums`, and fill their rows of `solved`.

    Returns the number of lines whose block is singular.
    """
    most = most_views(views, low, high)
    by_line, by_frame = np.zeros((most, 8)), np.zeros((most, 2, 6))
    r, z, e = np.empty((most, 2)), np.zeros((most, 8)), np.empty((4, 4))
    singular = 0
    for place in range(low, high):
        line, begin, end = views.order[place], views.start[place], views.start[place + 1]
        observe(views, place, pose, lines, r, by_line, by_frame)
        g, factor = solved.gradient[line], solved.factors[line]
        line_block(by_line, r, end - begin, e, g)
        for x in range(4):
            solved.diagonal[line, x] = e[x, x]
        if not factorise(e, damping, factor):
            singular += 1
            continue
        whitened_rows(by_line, end - begin, factor, z)
        seen = begin
        while seen < end and views.frame[seen] < pairs.free:
            seen += 1
        y = forward(factor, g[0], g[1], g[2], g[3])
        add_gradient(views.frame, begin, seen, r, z, y, by_frame, sums)
        add_pairs(pairs, views.frame, begin, seen, z, by_frame, sums.blocks)
    return singular
