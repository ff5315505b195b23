"""The line engine's other passes: the step of every line, with the cost that it leads to.

After the frames' step d the lines follow, E dl = g - sum J_i' (P_i d): a directional derivative of each observation, which needs
neither Jacobian formed. With all frames held a line depends on no other, and one pass does everything.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.adjustment.line_kernel import (
    FAST,
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
from omnilines.adjustment.schur_kernel import line_block, observe


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def move_line(line, right, factor, gradient, diagonal, damping, lines, moved, step, turned):
    """Solve for one line's step and take it into `moved`; returns the decrease that the linear model promises of it."""
    y0, y1, y2, y3 = forward(factor, right[0], right[1], right[2], right[3])
    step[0], step[1], step[2], step[3] = backward(factor, y0, y1, y2, y3)
    if lines.held[line]:
        step[:] = 0.0
    promised = 0.0
    for x in range(4):
        promised += step[x] * (gradient[x] + damping * diagonal[x] * step[x])
    moved.phi[line] = retract(
        lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line], step, moved.centre[line], moved.turn[line], turned
    )
    return promised


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def follow_frames(low, high, views, pose, moved_pose, step, lines, damping, solved, moved):
    """Lines at the places low to high after the frames' step: (cost there, decrease promised of the lines' own steps)."""
    right, own, turned = np.empty(4), np.empty(4), np.empty((3, 3))
    cost = promised = 0.0
    for place in range(low, high):
        line = views.order[place]
        for x in range(4):
            right[x] = solved.gradient[line, x]
        if not lines.held[line]:
            pull(views, place, pose, step, lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line], right)
        promised += move_line(
            line, right, solved.factors[line], solved.gradient[line], solved.diagonal[line], damping, lines, moved, own, turned
        )
        cost += line_cost(views, place, moved_pose, moved.centre[line], lines.rho[line], moved.turn[line], moved.phi[line])
    return cost, promised


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def step_lines(low, high, views, pose, lines, damping, moved):
    """Lines at the places low to high, all frames held: (cost after the step, decrease promised, number of singular blocks)."""
    most = most_views(views, low, high)
    by_line, by_frame, r = np.zeros((most, 8)), np.zeros((most, 2, 6)), np.empty((most, 2))
    e, factor, gradient, diagonal = np.empty((4, 4)), np.empty(10), np.empty(4), np.empty(4)
    own, turned = np.empty(4), np.empty((3, 3))
    cost = promised = 0.0
    singular = 0
    for place in range(low, high):
        line = views.order[place]
        observe(views, place, pose, lines, r, by_line, by_frame)
        line_block(by_line, r, views.start[place + 1] - views.start[place], e, gradient)
        for x in range(4):
            diagonal[x] = e[x, x]
        if not factorise(e, damping, factor):
            singular += 1
            continue
        promised += move_line(line, gradient, factor, gradient, diagonal, damping, lines, moved, own, turned)
        cost += line_cost(views, place, pose, moved.centre[line], lines.rho[line], moved.turn[line], moved.phi[line])
    return cost, promised, singular


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
@no_type_check
def cost_of_lines(low, high, views, pose, lines):
    """Loss of all observations of the lines at the places low to high."""
    total = 0.0
    for place in range(low, high):
        line = views.order[place]
        total += line_cost(views, place, pose, lines.centre[line], lines.rho[line], lines.turn[line], lines.phi[line])
    return total
