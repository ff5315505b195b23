"""The line engine's other passes: the step of every line, with the cost that it leads to.

After the frames' step d the lines follow, E dl = g - sum J_i' (P_i d): a directional derivative of each observation, which needs
neither Jacobian formed. With all frames held a line depends on no other, and each goes its own way to its minimum.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.adjustment.kernels.line import (
    CAUCHY,
    CONVERGED,
    FAST,
    MOVING,
    SINGULAR,
    STALLED,
    backward,
    factorise,
    forward,
    line_cost,
    most_views,
    residual,
    retract,
    robust,
    view,
)
from omnilines.adjustment.kernels.schur import line_block, observe

MOST_DAMPING = 1e16
"""Beyond it a step moves nothing."""


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def pull(views, place, pose, step, centre, rho, turn, phi, right):
    """Take sum J_i' (P_i d) of the observations of one line from `right` (4), d the step of every frame (frames x 6)."""
    d0, d1, d2 = turn[0, 0], turn[1, 0], turn[2, 0]
    length, cosine = rho * math.tan(phi), math.cos(phi)
    m0, m1, m2 = length * turn[0, 1], length * turn[1, 1], length * turn[2, 1]
    g0 = g1 = g2 = h0 = h1 = h2 = 0.0
    for k in range(views.start[place], views.start[place + 1]):
        f = views.frame[k]
        x, y, z, u, v, w, o0, o1, o2 = view(pose, f, centre[0], centre[1], centre[2], m0, m1, m2, d0, d1, d2)
        r0, a0, a1, a2 = residual(views.rows, views.spread, k, 0, x, y, z)
        r1, b0, b1, b2 = residual(views.rows, views.spread, k, 1, x, y, z)
        _, weight = robust(views.kind, views.scale, r0 * r0 + r1 * r1)
        # The motion w x M + v x (R d) of M, the change of both residuals with it, and back through them.
        p0 = step[f, 1] * z - step[f, 2] * y + step[f, 4] * w - step[f, 5] * v
        p1 = step[f, 2] * x - step[f, 0] * z + step[f, 5] * u - step[f, 3] * w
        p2 = step[f, 0] * y - step[f, 1] * x + step[f, 3] * v - step[f, 4] * u
        s0 = weight * (a0 * p0 + a1 * p1 + a2 * p2)
        s1 = weight * (b0 * p0 + b1 * p1 + b2 * p2)
        n0, n1, n2 = a0 * s0 + b0 * s1, a1 * s0 + b1 * s1, a2 * s0 + b2 * s1
        q0 = pose[f, 0] * n0 + pose[f, 3] * n1 + pose[f, 6] * n2
        q1 = pose[f, 1] * n0 + pose[f, 4] * n1 + pose[f, 7] * n2
        q2 = pose[f, 2] * n0 + pose[f, 5] * n1 + pose[f, 8] * n2
        g0, g1, g2 = g0 + q0, g1 + q1, g2 + q2
        h0, h1, h2 = h0 + q1 * o2 - q2 * o1, h1 + q2 * o0 - q0 * o2, h2 + q0 * o1 - q1 * o0
    right[0] -= length * (g0 * turn[0, 2] + g1 * turn[1, 2] + g2 * turn[2, 2])
    right[1] += h0 * turn[0, 2] + h1 * turn[1, 2] + h2 * turn[2, 2]
    right[2] -= h0 * turn[0, 1] + h1 * turn[1, 1] + h2 * turn[2, 1] - length * (g0 * d0 + g1 * d1 + g2 * d2)
    right[3] -= rho / (cosine * cosine) * (g0 * turn[0, 1] + g1 * turn[1, 1] + g2 * turn[2, 1])


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def move_line(line, right, factor, gradient, diagonal, damping, lines, new_centre, new_turn, step, turned):
    """Solve for one line's step and take it; returns the decrease that the linear model promises of it, and the new phi."""
    y0, y1, y2, y3 = forward(factor, right[0], right[1], right[2], right[3])
    step[0], step[1], step[2], step[3] = backward(factor, y0, y1, y2, y3)
    if lines.held[line]:
        step[:] = 0.0
    promised = 0.0
    for x in range(4):
        promised += step[x] * (gradient[x] + damping * diagonal[x] * step[x])
    phi = retract(lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line], step, new_centre, new_turn, turned)
    return promised, phi


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def follow_frames(low, high, views, pose, moved_pose, step, lines, damping, solved, moved, cost):
    """Lines at the places low to high after the frames' step, with the `cost` (t) of each there.

    Returns the decrease promised of the lines' own steps.
    """
    right, own, turned = np.empty(4), np.empty(4), np.empty((3, 3))
    promised = 0.0
    for place in range(low, high):
        line = views.order[place]
        for x in range(4):
            right[x] = solved.gradient[line, x]
        if not lines.held[line]:
            pull(views, place, pose, step, lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line], right)
        decrease, moved.phi[line] = move_line(
            line,
            right,
            solved.factors[line],
            solved.gradient[line],
            solved.diagonal[line],
            damping,
            lines,
            moved.centre[line],
            moved.turn[line],
            own,
            turned,
        )
        promised += decrease
        cost[line] = line_cost(views, place, moved_pose, moved.centre[line], lines.rho[line], moved.turn[line], moved.phi[line])
    return promised


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def step_lines(low, high, views, pose, lines, search, least):
    """One step of every line at the places low to high that still moves, all frames held; changes `lines` and `search`.

    Each has its own damping, refuses what does not lower its own cost, and has converged once its linear model promises no
    more than `least`. The rules are those of `levenberg_marquardt.minimise`. Returns how many lines moved.
    """
    most = most_views(views, low, high)
    by_line, by_frame, r = np.zeros((most, 8)), np.zeros((most, 2, 6)), np.empty((most, 2))
    e, curved, factor, gradient, diagonal = np.empty((4, 4)), np.empty((4, 4)), np.empty(10), np.empty(4), np.empty(4)
    own, turned, new_centre, new_turn = np.empty(4), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    moved = 0
    for place in range(low, high):
        line = views.order[place]
        if search.end[line] != MOVING:
            continue
        observe(views, place, pose, lines, r, by_line, by_frame)
        count = views.start[place + 1] - views.start[place]
        line_block(by_line, r, count, e, gradient)
        curved[:] = e
        take_loss_curvature(views, count, by_line, r, curved)
        damping = search.damping[line]
        # Away from the minimum the curvature of the loss may outweigh that of the residuals.
        if factorise(curved, damping, factor):
            e[:] = curved
        elif not factorise(e, damping, factor):
            refuse(search, line, max(damping, 1e-12))
            if search.damping[line] > MOST_DAMPING:
                search.end[line] = SINGULAR
            continue
        for x in range(4):
            diagonal[x] = e[x, x]
        promised, phi = move_line(line, gradient, factor, gradient, diagonal, damping, lines, new_centre, new_turn, own, turned)
        if promised <= least:
            search.end[line] = CONVERGED
        cost = line_cost(views, place, pose, new_centre, lines.rho[line], new_turn, phi)
        if cost < search.cost[line]:
            ratio = (search.cost[line] - cost) / promised
            search.damping[line] = max(damping * max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-15)
            search.growth[line], search.cost[line] = 2.0, cost
            lines.centre[line], lines.turn[line], lines.phi[line] = new_centre, new_turn, phi
            moved += 1
            continue
        refuse(search, line, damping)
        if search.damping[line] > MOST_DAMPING and search.end[line] == MOVING:
            search.end[line] = STALLED
    return moved


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def take_loss_curvature(views, count, by_line, r, e):
    """Take from E the curvature of the loss, -2 L'' (J'r)(J'r)' of each observation, from rows weighted by the root of L'.

    Without it convergence is slow where a line has as many doubtful observations as good ones. That of Huber's loss jumps, and
    steps that rely on it circle.
    """
    if views.kind != CAUCHY:
        return
    share = 2.0 / (views.scale * views.scale)
    for i in range(count):
        for x in range(4):
            g = by_line[i, x] * r[i, 0] + by_line[i, 4 + x] * r[i, 1]
            for y in range(x + 1):
                e[x, y] -= share * g * (by_line[i, y] * r[i, 0] + by_line[i, 4 + y] * r[i, 1])


@njit(cache=True, nogil=True)
@no_type_check
def refuse(search, line, damping):
    """More damping for the next step of a line."""
    search.damping[line] = damping * search.growth[line]
    search.growth[line] *= 2.0


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def cost_of_lines(low, high, views, pose, lines, cost):
    """Loss of the observations of each line at the places low to high, into `cost` (t)."""
    for place in range(low, high):
        line = views.order[place]
        cost[line] = line_cost(views, place, pose, lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line])
