"""Maximum likelihood, compiled: Levenberg-Marquardt of one track after another (`likelihood.py`, where what is computed stands).

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.triangulation.kernels.small import cross
from omnilines.triangulation.kernels.sums import add_ends, row_information

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-10, 1e-14, 1e8
"""Relative to the diagonal. The start is good, and damping would freeze a far line, which eigenvalues near 1e-11 determine."""
TOLERANCE = 1e-12
"""A track is done when the decrease of its cost that the linear model promises is below this share of it."""
PHI, SIZE = 12, 13
"""A chart as numbers: its centre (0 to 2), S row by row (3 to 11), and phi."""


class Work(NamedTuple):
    """Memory of one thread."""

    chart: np.ndarray
    origin: np.ndarray
    by: np.ndarray
    ends: np.ndarray
    total: np.ndarray
    then: np.ndarray
    factor: np.ndarray
    inverse: np.ndarray
    step: np.ndarray
    trial: np.ndarray
    distance: np.ndarray
    ordered: np.ndarray
    ones: np.ndarray
    own: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def memory(most):
    """For tracks of at most so many rows."""
    by, ends, total, then = np.zeros((2, 3, 4)), np.empty((2, 5)), np.empty((5, 5)), np.empty((5, 5))
    factor, inverse, step, trial = np.empty((4, 5)), np.empty((4, 4)), np.empty(4), np.empty(SIZE)
    distance, ordered, ones, own = np.empty(most), np.empty(most), np.empty(most), np.empty(most, np.int64)
    return Work(np.empty(SIZE), np.empty(3), by, ends, total, then, factor, inverse, step, trial, distance, ordered, ones, own)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def equations(track, noise, rows, origin, scale, chart, work, total):
    """[J h]' [J h] of some rows at a chart about `origin`, and what double precision leaves of the sum of h^2."""
    by = work.by
    d0, d1, d2 = chart[3], chart[6], chart[9]
    length, stretch = scale * math.tan(chart[PHI]), scale / math.cos(chart[PHI]) ** 2
    m0, m1, m2 = length * chart[4], length * chart[7], length * chart[10]
    # d d / d delta = (0, -s3, s2, 0), d m / d delta = (l s3, 0, -l s1, k s2).
    for x in range(3):
        s1, s2, s3 = chart[3 + 3 * x], chart[4 + 3 * x], chart[5 + 3 * x]
        by[0, x, 1], by[0, x, 2] = -s3, s2
        by[1, x, 0], by[1, x, 2], by[1, x, 3] = length * s3, -length * s1, stretch * s2
    total[:] = 0.0
    rounding, size = 0.0, abs(length)
    for row in rows:
        c0 = track.centre[row, 0] - origin[0] - chart[0]
        c1 = track.centre[row, 1] - origin[1] - chart[1]
        c2 = track.centre[row, 2] - origin[2] - chart[2]
        rounding += row_information(track, noise, row, c0, c1, c2, d0, d1, d2, m0, m1, m2, size, by[0], by[1], work.ends)
        add_ends(work.ends, total)
    return rounding


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def damped_step(total, damping, factor, step):
    """-(J'J + damping D)^-1 J'h into `step`, and the decrease that the linear model promises; infinite, with a step of zero,
    where the matrix is not positive definite."""
    for x in range(4):
        factor[x, 4] = 1.0 / math.sqrt(max(total[x, x], 1e-300))
    for x in range(4):
        for y in range(x + 1):
            value = total[x, y] * factor[x, 4] * factor[y, 4] + (damping if x == y else 0.0)
            for z in range(y):
                value -= factor[x, z] * factor[y, z]
            if x == y:
                if not value > 0.0:
                    step[:] = 0.0
                    return np.inf
                factor[x, x] = math.sqrt(value)
            else:
                factor[x, y] = value / factor[y, y]
    for x in range(4):
        value = -total[4, x] * factor[x, 4]
        for z in range(x):
            value -= factor[x, z] * step[z]
        step[x] = value / factor[x, x]
    for x in range(3, -1, -1):
        value = step[x]
        for z in range(x + 1, 4):
            value -= factor[z, x] * step[z]
        step[x] = value / factor[x, x]
    promised = 0.0
    for x in range(4):
        promised += step[x] * (damping * step[x] - total[4, x] * factor[x, 4])
        step[x] *= factor[x, 4]
    return promised


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def turned(s1, s2, s3, w0, w1, w2, axis):
    """One column of S exp([w]x), row of S given: s + sin(a)/a s x' + ..., by Rodrigues' formula."""
    square = w0 * w0 + w1 * w1 + w2 * w2
    angle = math.sqrt(square)
    if square < 1e-3:
        first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        first, second = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    along = s1 * w0 + s2 * w1 + s3 * w2
    if axis == 0:
        return s1 + first * (s2 * w2 - s3 * w1) + second * (along * w0 - square * s1)
    if axis == 1:
        return s2 + first * (s3 * w0 - s1 * w2) + second * (along * w1 - square * s2)
    return s3 + first * (s1 * w1 - s2 * w0) + second * (along * w2 - square * s3)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def moved(chart, step, scale, least_phi, most_phi, trial):
    """The chart after a step, its centre moved to the distance `scale` from the line where phi has left its bounds."""
    for x in range(3):
        s1, s2, s3 = chart[3 + 3 * x], chart[4 + 3 * x], chart[5 + 3 * x]
        for axis in range(3):
            trial[3 + 3 * x + axis] = turned(s1, s2, s3, step[0], step[1], step[2], axis)
    phi = chart[PHI] + step[3]
    length = scale * math.tan(phi)
    d0, d1, d2 = trial[3], trial[6], trial[9]
    m0, m1, m2 = length * trial[4], length * trial[7], length * trial[10]
    for x in range(3):
        trial[x] = chart[x]
    if phi < least_phi or phi > most_phi:
        # To the foot of the perpendicular, d x m away, and back along s3; the moment about the centre follows.
        f0, f1, f2 = cross(d0, d1, d2, m0, m1, m2)
        g0, g1, g2 = f0 - scale * trial[5], f1 - scale * trial[8], f2 - scale * trial[11]
        trial[0], trial[1], trial[2] = chart[0] + g0, chart[1] + g1, chart[2] + g2
        s0, s1, s2 = cross(g0, g1, g2, d0, d1, d2)
        m0, m1, m2 = m0 - s0, m1 - s1, m2 - s2
    distance = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    if distance > 0.0:
        along = m0 * d0 + m1 * d1 + m2 * d2
        m0, m1, m2 = m0 - along * d0, m1 - along * d1, m2 - along * d2
    else:
        m0, m1, m2 = trial[4], trial[7], trial[10]
    norm = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / norm, m1 / norm, m2 / norm
    e0, e1, e2 = cross(d0, d1, d2, m0, m1, m2)
    trial[4], trial[7], trial[10] = m0, m1, m2
    trial[5], trial[8], trial[11] = e0, e1, e2
    trial[PHI] = math.atan2(distance, scale)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def refine_rows(track, noise, rows, origin, scale, chart, least_phi, most_phi, iterations, work):
    """Move a chart about `origin` to the least cost of some rows; one that is NaN stays."""
    total, then, step, trial = work.total, work.then, work.step, work.trial
    rounding = equations(track, noise, rows, origin, scale, chart, work, total)
    if not total[4, 4] > rounding:
        return
    damping, growth = FIRST_DAMPING, 2.0
    for _ in range(iterations):
        promised = damped_step(total, damping, work.factor, step)
        moved(chart, step, scale, least_phi, most_phi, trial)
        left = equations(track, noise, rows, origin, scale, trial, work, then)
        cost, decrease = total[4, 4], total[4, 4] - then[4, 4]
        settled = promised <= TOLERANCE * cost + rounding
        # The last step is still good where rounding hides what it gains.
        if decrease > (-TOLERANCE * cost - rounding if settled else 0.0):
            # Nielsen's rule: the damping follows how well the linear model foretold the decrease.
            gain = 1.0 - (2.0 * decrease / max(promised, 1e-300) - 1.0) ** 3
            damping, growth = damping * min(max(gain, 0.1), 2.0), 2.0
            chart[:], total[:] = trial, then
            rounding = left
        else:
            damping, growth = damping * growth, 2.0 * growth
        damping = max(damping, MIN_DAMPING)
        if settled or damping >= MAX_DAMPING:
            return


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def refine_tracks(low, high, track, noise, origin, scale, charts, least_phi, most_phi, iterations):
    """Move the charts of the tracks low to high, rows of SIZE numbers about `origin`, to their least cost; NaN stays."""
    work = memory(1)
    for t in range(low, high):
        rows = track.rows[track.start[t] : track.start[t + 1]]
        refine_rows(track, noise, rows, origin[t], scale[t], charts[t], least_phi, most_phi, iterations, work)
