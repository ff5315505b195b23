"""The compiled passes of the adjustment of points: residuals, Jacobians, 3 x 3 point blocks and the Schur complement onto frames.

With J_i the derivative of an observation's two residuals by its point (2 x 3), P_i by its frame (2 x 6), E = sum J_i' J_i = L L'
and Z_i = L^-1 J_i', the reduced system of the frames is

    S_ij = [i = j] P_i' P_i - P_i' (Z_i' Z_j) P_j,      g_i = -P_i' (r_i + Z_i' y),  y = -L^-1 sum J_i' r_i

for Cauchy's loss, whose weight is in r, J and P. All is done in the frame of the rig: bearings are turned into it, and `arm` is
the centre of the camera there. The residual is that of `bearing_residual.py`. Nothing is kept of an observation: what
back-substitution needs is formed anew. The blocks of pairs i <= j are kept.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.least_squares.schur import LEAST_PIVOT

# Sums may be reordered and multiply-adds fused; NaN and infinity keep their meaning, since they make a step be refused.
FAST = {"contract", "reassoc", "nsz", "arcp"}
NEAREST_OPPOSITE = 1e-9


class Sightings(NamedTuple):
    """n observations, those of one point together, and of a point by frame."""

    start: np.ndarray
    """First observation of each point (p + 1)."""
    frame: np.ndarray
    """Place of each observation's frame (n)."""
    bearings: np.ndarray
    """In the rig frame (n x 3)."""
    rows: np.ndarray
    """Across them in the rig frame, over standard deviations (n x 2 x 3)."""
    arm: np.ndarray
    """Centre of the camera in the rig frame (n x 3)."""
    bend: float
    """Residual at which the loss bends."""


class PointBlocks(NamedTuple):
    """What is kept of every point between the passes."""

    factors: np.ndarray
    """L by rows (p x 6)."""
    gradient: np.ndarray
    """-sum J'r (p x 3)."""
    diagonal: np.ndarray
    """Of E, undamped (p x 3)."""


class FrameSums(NamedTuple):
    """What the points give to the reduced system of the frames."""

    blocks: np.ndarray
    """S (blocks x 6 x 6)."""
    gradient: np.ndarray
    """The right side of S, and after it -sum P'r, the frames' own part (frames x 12)."""
    own: np.ndarray
    """Sum P'P, its upper triangle (frames x 6 x 6)."""


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def residual(seen, k, pose, x, y, z):
    """r of one observation of the point (x, y, z), and what its derivatives need: the point in the rig, its direction, its
    distance, and 1 + b . v."""
    f = seen.frame[k]
    a0 = pose[f, 0] * x + pose[f, 1] * y + pose[f, 2] * z + pose[f, 9]
    a1 = pose[f, 3] * x + pose[f, 4] * y + pose[f, 5] * z + pose[f, 10]
    a2 = pose[f, 6] * x + pose[f, 7] * y + pose[f, 8] * z + pose[f, 11]
    v0, v1, v2 = a0 - seen.arm[k, 0], a1 - seen.arm[k, 1], a2 - seen.arm[k, 2]
    length = max(math.sqrt(v0 * v0 + v1 * v1 + v2 * v2), 1e-300)
    v0, v1, v2 = v0 / length, v1 / length, v2 / length
    beyond = 1.0 + (seen.bearings[k, 0] * v0 + seen.bearings[k, 1] * v1 + seen.bearings[k, 2] * v2)
    beyond = max(beyond, NEAREST_OPPOSITE)
    r0 = 2.0 * (seen.rows[k, 0, 0] * v0 + seen.rows[k, 0, 1] * v1 + seen.rows[k, 0, 2] * v2) / beyond
    r1 = 2.0 * (seen.rows[k, 1, 0] * v0 + seen.rows[k, 1, 1] * v1 + seen.rows[k, 1, 2] * v2) / beyond
    return r0, r1, a0, a1, a2, v0, v1, v2, length, beyond


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def observe(seen, point, pose, at, r, by_point, by_frame):
    """Weighted residuals r (k x 2), J (k x 2 x 3) and P (k x 2 x 6) of the observations of one point."""
    low = seen.start[point]
    for k in range(low, seen.start[point + 1]):
        i, f = k - low, seen.frame[k]
        r0, r1, a0, a1, a2, v0, v1, v2, length, beyond = residual(seen, k, pose, at[point, 0], at[point, 1], at[point, 2])
        root = math.sqrt(1.0 / (1.0 + (r0 * r0 + r1 * r1) / (seen.bend * seen.bend)))
        for a in range(2):
            value = r0 if a == 0 else r1
            g0 = (2.0 * seen.rows[k, a, 0] - value * seen.bearings[k, 0]) / beyond
            g1 = (2.0 * seen.rows[k, a, 1] - value * seen.bearings[k, 1]) / beyond
            g2 = (2.0 * seen.rows[k, a, 2] - value * seen.bearings[k, 2]) / beyond
            along = g0 * v0 + g1 * v1 + g2 * v2
            unit = root / length
            g0, g1, g2 = (g0 - along * v0) * unit, (g1 - along * v1) * unit, (g2 - along * v2) * unit
            r[i, a] = value * root
            # exp(delta) T moves X by w x X + v.
            by_frame[i, a, 0], by_frame[i, a, 1], by_frame[i, a, 2] = a1 * g2 - a2 * g1, a2 * g0 - a0 * g2, a0 * g1 - a1 * g0
            by_frame[i, a, 3], by_frame[i, a, 4], by_frame[i, a, 5] = g0, g1, g2
            by_point[i, a, 0] = pose[f, 0] * g0 + pose[f, 3] * g1 + pose[f, 6] * g2
            by_point[i, a, 1] = pose[f, 1] * g0 + pose[f, 4] * g1 + pose[f, 7] * g2
            by_point[i, a, 2] = pose[f, 2] * g0 + pose[f, 5] * g1 + pose[f, 8] * g2


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def factorise(by_point, r, count, damping, factor, gradient, diagonal):
    """L, -sum J'r and the diagonal of E of one point; whether E, its diagonal (1 + damping) times as large, is definite."""
    e00 = e10 = e11 = e20 = e21 = e22 = 0.0
    gradient[:] = 0.0
    for i in range(count):
        for a in range(2):
            x, y, z = by_point[i, a, 0], by_point[i, a, 1], by_point[i, a, 2]
            e00, e10, e11 = e00 + x * x, e10 + y * x, e11 + y * y
            e20, e21, e22 = e20 + z * x, e21 + z * y, e22 + z * z
            gradient[0] -= x * r[i, a]
            gradient[1] -= y * r[i, a]
            gradient[2] -= z * r[i, a]
    diagonal[0], diagonal[1], diagonal[2] = e00, e11, e22
    e00, e11, e22 = e00 * (1.0 + damping), e11 * (1.0 + damping), e22 * (1.0 + damping)
    if not e00 > 0.0:
        return False
    l00 = math.sqrt(e00)
    l10, l20 = e10 / l00, e20 / l00
    rest = e11 - l10 * l10
    if not rest > LEAST_PIVOT * e11:
        return False
    l11 = math.sqrt(rest)
    l21 = (e21 - l20 * l10) / l11
    rest = e22 - l20 * l20 - l21 * l21
    if not rest > LEAST_PIVOT * e22:
        return False
    factor[0], factor[1], factor[2], factor[3], factor[4], factor[5] = l00, l10, l11, l20, l21, math.sqrt(rest)
    return True


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def forward(factor, x, y, z):
    """L^-1 (x, y, z)."""
    x = x / factor[0]
    y = (y - factor[1] * x) / factor[2]
    return x, y, (z - factor[3] * x - factor[4] * y) / factor[5]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_block(blocks, b, p, i, j, s00, s01, s10, s11):
    """blocks[b] += P_i' A P_j for A (2 x 2)."""
    for x in range(6):
        u = p[i, 0, x] * s00 + p[i, 1, x] * s10
        v = p[i, 0, x] * s01 + p[i, 1, x] * s11
        for y in range(6):
            blocks[b, x, y] += u * p[j, 0, y] + v * p[j, 1, y]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_pairs(window, block_of, frame, low, high, z, p, blocks):
    """Add P_i' ([i = j] I - Z_i' Z_j) P_j to the blocks of all pairs i <= j of one point's observations."""
    for k in range(low, high):
        i = k - low
        base = window[frame[k]] - frame[k]
        for m in range(k, high):
            j = m - low
            s00 = -(z[i, 0, 0] * z[j, 0, 0] + z[i, 0, 1] * z[j, 0, 1] + z[i, 0, 2] * z[j, 0, 2])
            s01 = -(z[i, 0, 0] * z[j, 1, 0] + z[i, 0, 1] * z[j, 1, 1] + z[i, 0, 2] * z[j, 1, 2])
            s10 = -(z[i, 1, 0] * z[j, 0, 0] + z[i, 1, 1] * z[j, 0, 1] + z[i, 1, 2] * z[j, 0, 2])
            s11 = -(z[i, 1, 0] * z[j, 1, 0] + z[i, 1, 1] * z[j, 1, 1] + z[i, 1, 2] * z[j, 1, 2])
            b = block_of[base + frame[m]]
            if m == k:
                s00, s11 = 1.0 + s00, 1.0 + s11
            add_block(blocks, b, p, i, j, s00, s01, s10, s11)
            if m != k and frame[m] == frame[k]:
                # Two cameras of a frame see the point: the block of a frame with itself takes both orders.
                add_block(blocks, b, p, j, i, s00, s10, s01, s11)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def add_gradient(frame, low, high, r, z, y0, y1, y2, p, sums):
    """Add the right side, -sum P'r and P'P of one point's observations, with y = L^-1 times its gradient."""
    for k in range(low, high):
        i, f = k - low, frame[k]
        t0 = -r[i, 0] - (z[i, 0, 0] * y0 + z[i, 0, 1] * y1 + z[i, 0, 2] * y2)
        t1 = -r[i, 1] - (z[i, 1, 0] * y0 + z[i, 1, 1] * y1 + z[i, 1, 2] * y2)
        for x in range(6):
            a, b = p[i, 0, x], p[i, 1, x]
            sums.gradient[f, x] += a * t0 + b * t1
            sums.gradient[f, 6 + x] -= a * r[i, 0] + b * r[i, 1]
            for y in range(x, 6):
                sums.own[f, x, y] += a * p[i, 0, y] + b * p[i, 1, y]


@njit(cache=True, nogil=True)
@no_type_check
def most_seen(seen, low, high):
    """The most observations of one point."""
    most = 0
    for point in range(low, high):
        most = max(most, seen.start[point + 1] - seen.start[point])
    return most


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def reduce_points(low, high, seen, pose, at, damping, window, block_of, sums, solved):
    """Add the points low to high to `sums` and fill their rows of `solved`; returns how many have a singular block."""
    most = most_seen(seen, low, high)
    r, by_point, by_frame, z = np.empty((most, 2)), np.empty((most, 2, 3)), np.empty((most, 2, 6)), np.empty((most, 2, 3))
    singular = 0
    for point in range(low, high):
        begin, end = seen.start[point], seen.start[point + 1]
        observe(seen, point, pose, at, r, by_point, by_frame)
        factor, g = solved.factors[point], solved.gradient[point]
        if not factorise(by_point, r, end - begin, damping, factor, g, solved.diagonal[point]):
            singular += 1
            continue
        for i in range(end - begin):
            for a in range(2):
                z[i, a, 0], z[i, a, 1], z[i, a, 2] = forward(factor, by_point[i, a, 0], by_point[i, a, 1], by_point[i, a, 2])
        y0, y1, y2 = forward(factor, g[0], g[1], g[2])
        add_gradient(seen.frame, begin, end, r, z, y0, y1, y2, by_frame, sums)
        add_pairs(window, block_of, seen.frame, begin, end, z, by_frame, sums.blocks)
    return singular


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def follow_frames(low, high, seen, pose, moved_pose, step, at, damping, solved, moved):
    """Points low to high after the frames' step, into `moved`: (cost there, decrease promised of the points' own steps)."""
    most = most_seen(seen, low, high)
    r, by_point, by_frame = np.empty((most, 2)), np.empty((most, 2, 3)), np.empty((most, 2, 6))
    promised = cost = 0.0
    for point in range(low, high):
        begin, end = seen.start[point], seen.start[point + 1]
        observe(seen, point, pose, at, r, by_point, by_frame)
        g, factor, diagonal = solved.gradient[point], solved.factors[point], solved.diagonal[point]
        x, y, z = g[0], g[1], g[2]
        for i in range(end - begin):
            f = seen.frame[begin + i]
            for a in range(2):
                pull = 0.0
                for c in range(6):
                    pull += by_frame[i, a, c] * step[f, c]
                x, y, z = x - by_point[i, a, 0] * pull, y - by_point[i, a, 1] * pull, z - by_point[i, a, 2] * pull
        x, y, z = forward(factor, x, y, z)
        z = z / factor[5]
        y = (y - factor[4] * z) / factor[2]
        x = (x - factor[1] * y - factor[3] * z) / factor[0]
        promised += x * (g[0] + damping * diagonal[0] * x)
        promised += y * (g[1] + damping * diagonal[1] * y)
        promised += z * (g[2] + damping * diagonal[2] * z)
        moved[point, 0], moved[point, 1], moved[point, 2] = at[point, 0] + x, at[point, 1] + y, at[point, 2] + z
        cost += cost_of_point(seen, point, moved_pose, moved)
    return cost, promised


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def cost_of_point(seen, point, pose, at):
    """Loss of the observations of one point."""
    cost, square = 0.0, seen.bend * seen.bend
    for k in range(seen.start[point], seen.start[point + 1]):
        found = residual(seen, k, pose, at[point, 0], at[point, 1], at[point, 2])
        cost += square * math.log1p((found[0] * found[0] + found[1] * found[1]) / square)
    return cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def cost_of_points(low, high, seen, pose, at):
    """Loss of the observations of the points low to high."""
    cost = 0.0
    for point in range(low, high):
        cost += cost_of_point(seen, point, pose, at)
    return cost


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def residual_norms(seen, pose, at, norm):
    """|r| of every observation, into `norm` (n)."""
    for point in range(len(at)):
        for k in range(seen.start[point], seen.start[point + 1]):
            found = residual(seen, k, pose, at[point, 0], at[point, 1], at[point, 2])
            norm[k] = math.sqrt(found[0] * found[0] + found[1] * found[1])
