"""What `degeneracy.py` and `residuals.py` sum over the observations of every track, and planes of arcs, compiled."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.triangulation.kernels.small import cross, weighted_median

RESIDUAL, CHORD, AWAY, SPREAD, ACROSS, CLEAR, TOUCHED, ALONG_MEAN, MIXED, OFF_MEAN, ALONE, PLACES = range(12)
"""Columns of the sums that a status is decided from. ALONG_MEAN, MIXED and OFF_MEAN are a a', a b and b b over all normals, each
with its precision: a along the mean normal and b off it, across the line. ALONE is the least second eigenvalue, a view, that they
have without one place of the cameras. PLACES are those that the cameras have, CLEAR those of them that are not on the line."""
ROUNDING = 1e-9
"""Least standard deviation of a bearing (rad)."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def line_moment(track, row, d0, d1, d2, m0, m1, m2):
    """m - C x d of one observation's camera."""
    s0, s1, s2 = cross(track.centre[row, 0], track.centre[row, 1], track.centre[row, 2], d0, d1, d2)
    return m0 - s0, m1 - s1, m2 - s2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def second_eigenvalue(along, mixed, off):
    """Of the matrix [along mixed; mixed off]."""
    largest = 0.5 * (along + off + math.sqrt((along - off) ** 2 + 4.0 * mixed * mixed))
    return (along * off - mixed * mixed) / largest if largest > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def normal_place(track, noise, row, d0, d1, d2, mean_normal, t):
    """p a a', p a b and p b b of the normal of one observation; its precision p is 1 where no noise is known."""
    n0, n1, n2 = track.normal[row, 0], track.normal[row, 1], track.normal[row, 2]
    precision = 1.0
    if len(noise):
        chord = variance = 0.0
        for x in range(3):
            along = track.arcs[row, 1, x] - track.arcs[row, 0, x]
            chord += along * along
        for a in range(2):
            for x in range(2):
                across = noise[row, a, 0, x] * n0 + noise[row, a, 1, x] * n1 + noise[row, a, 2, x] * n2
                variance += across * across
        # Both ends turn the normal: by the root of the sum of their variances over the chord.
        precision = chord / max(variance, ROUNDING**2)
    e0, e1, e2 = cross(d0, d1, d2, mean_normal[t, 0], mean_normal[t, 1], mean_normal[t, 2])
    a, b = n0 * mean_normal[t, 0] + n1 * mean_normal[t, 1] + n2 * mean_normal[t, 2], n0 * e0 + n1 * e1 + n2 * e2
    if b != b:
        a, b = 1.0, 0.0
    return precision * a * a, precision * a * b, precision * b * b


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def sum_row(track, row, d0, d1, d2, q0, q1, q2, t, sums):
    """Squared residual, chord and whether the arc faces away, of one observation."""
    n0, n1, n2 = track.normal[row, 0], track.normal[row, 1], track.normal[row, 2]
    square = q0 * q0 + q1 * q1 + q2 * q2
    if len(track.arcs) == 0:
        s0, s1, s2 = cross(q0, q1, q2, n0, n1, n2)
        sums[t, RESIDUAL] += (s0 * s0 + s1 * s1 + s2 * s2) / square
        return
    f0, f1, f2 = cross(d0, d1, d2, q0, q1, q2)
    middle = chord = 0.0
    for a in range(2):
        h = track.arcs[row, a, 0] * q0 + track.arcs[row, a, 1] * q1 + track.arcs[row, a, 2] * q2
        sums[t, RESIDUAL] += h * h / square
        middle += track.arcs[row, a, 0] * f0 + track.arcs[row, a, 1] * f1 + track.arcs[row, a, 2] * f2
    for x in range(3):
        along = track.arcs[row, 1, x] - track.arcs[row, 0, x]
        chord += along * along
    sums[t, CHORD] += math.sqrt(chord)
    # NaN, of a track without a line, is not behind.
    sums[t, AWAY] += 1.0 if middle <= 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def same_place(track, row, other):
    """Whether two observations are of one place."""
    apart = 0.0
    for x in range(3):
        apart += abs(track.centre[row, x] - track.centre[other, x])
    return apart == 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def first_of_place(track, begin, k):
    """Whether no observation from `begin` to k is of the place of k."""
    for j in range(begin, k):
        if same_place(track, track.rows[j], track.rows[k]):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def least_without_one(track, noise, begin, end, d0, d1, d2, mean_normal, t, sums):
    """Least second eigenvalue of the normals of a track, a normal, without all that were seen from one place."""
    least = math.inf
    for k in range(begin, end):
        one = track.rows[k]
        along, mixed, off, others = sums[t, ALONG_MEAN], sums[t, MIXED], sums[t, OFF_MEAN], 0
        for j in range(begin, end):
            row = track.rows[j]
            if not same_place(track, row, one):
                others += 1
                continue
            aa, ab, bb = normal_place(track, noise, row, d0, d1, d2, mean_normal, t)
            along, mixed, off = along - aa, mixed - ab, off - bb
        rest = second_eigenvalue(along, mixed, off) / others if others > 0 else 0.0
        least = min(least, rest)
    return least


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def sum_tracks(low, high, track, noise, direction, moment, mean_normal, sums):
    """The sums of the tracks low to high but CLEAR and TOUCHED; SPREAD and ACROSS are those of the centres from their mean."""
    for t in range(low, high):
        begin, end = track.start[t], track.start[t + 1]
        d0, d1, d2 = direction[t, 0], direction[t, 1], direction[t, 2]
        m0, m1, m2 = moment[t, 0], moment[t, 1], moment[t, 2]
        c0 = c1 = c2 = 0.0
        for k in range(begin, end):
            row = track.rows[k]
            c0, c1, c2 = c0 + track.centre[row, 0], c1 + track.centre[row, 1], c2 + track.centre[row, 2]
            q0, q1, q2 = line_moment(track, row, d0, d1, d2, m0, m1, m2)
            sum_row(track, row, d0, d1, d2, q0, q1, q2, t, sums)
            sums[t, PLACES] += 1.0 if first_of_place(track, begin, k) else 0.0
            aa, ab, bb = normal_place(track, noise, row, d0, d1, d2, mean_normal, t)
            sums[t, ALONG_MEAN] += aa
            sums[t, MIXED] += ab
            sums[t, OFF_MEAN] += bb
        views = max(end - begin, 1)
        c0, c1, c2 = c0 / views, c1 / views, c2 / views
        sums[t, ALONE] = least_without_one(track, noise, begin, end, d0, d1, d2, mean_normal, t, sums)
        for k in range(begin, end):
            row = track.rows[k]
            x, y, z = track.centre[row, 0] - c0, track.centre[row, 1] - c1, track.centre[row, 2] - c2
            height = x * mean_normal[t, 0] + y * mean_normal[t, 1] + z * mean_normal[t, 2]
            sums[t, SPREAD] += x * x + y * y + z * z
            sums[t, ACROSS] += height * height


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def sum_cameras(low, high, track, direction, moment, limit, touching, sums):
    """Places of the tracks low to high farther from the line than limit[t] times the farthest camera, and cameras on it."""
    for t in range(low, high):
        d0, d1, d2 = direction[t, 0], direction[t, 1], direction[t, 2]
        m0, m1, m2 = moment[t, 0], moment[t, 1], moment[t, 2]
        farthest = 0.0
        for turn in range(2):
            for k in range(track.start[t], track.start[t + 1]):
                q0, q1, q2 = line_moment(track, track.rows[k], d0, d1, d2, m0, m1, m2)
                distance = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
                if turn == 0:
                    farthest = distance if distance > farthest or distance != distance else farthest
                    continue
                clear = distance > limit[t] * farthest and first_of_place(track, track.start[t], k)
                sums[t, CLEAR] += 1.0 if clear else 0.0
                sums[t, TOUCHED] += 1.0 if distance <= touching * farthest else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def middle_cameras(low, high, track, direction, moment, scale, camera):
    """Median distance of the cameras of the tracks low to high from the line, and the camera nearest to that distance."""
    most = 1
    for t in range(low, high):
        most = max(most, track.start[t + 1] - track.start[t])
    distance, ordered, ones = np.empty(most), np.empty(most), np.empty(most)
    for t in range(low, high):
        d0, d1, d2 = direction[t, 0], direction[t, 1], direction[t, 2]
        m0, m1, m2 = moment[t, 0], moment[t, 1], moment[t, 2]
        begin, views = track.start[t], track.start[t + 1] - track.start[t]
        if views == 0 or d0 != d0:
            continue
        for i in range(views):
            q0, q1, q2 = line_moment(track, track.rows[begin + i], d0, d1, d2, m0, m1, m2)
            distance[i] = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
            ordered[i], ones[i] = distance[i], 1.0
        scale[t] = weighted_median(ordered, ones, views)
        nearest = 0
        for i in range(views):
            if abs(distance[i] - scale[t]) <= abs(distance[nearest] - scale[t]):
                nearest = i
        for x in range(3):
            camera[t, x] = track.centre[track.rows[begin + nearest], x]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def row_information(track, noise, row, c0, c1, c2, d0, d1, d2, m0, m1, m2, size_of_moment, by_direction, by_moment, ends):
    """[J h] of both ends (2 x 5) of one observation into `ends`; what double precision leaves of the sum of h^2.

    Camera and moment are about the centre of the line's chart. See `residuals.py`.
    """
    s0, s1, s2 = cross(c0, c1, c2, d0, d1, d2)
    q0, q1, q2 = m0 - s0, m1 - s1, m2 - s2
    size = size_of_moment + math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
    rounding = 0.0
    for a in range(2):
        b0, b1, b2 = track.arcs[row, a, 0], track.arcs[row, a, 1], track.arcs[row, a, 2]
        if len(noise):
            p = noise[row, a, 0, 0] * q0 + noise[row, a, 1, 0] * q1 + noise[row, a, 2, 0] * q2
            q = noise[row, a, 0, 1] * q0 + noise[row, a, 1, 1] * q1 + noise[row, a, 2, 1] * q2
            w = math.sqrt(p * p + q * q)
            u0 = noise[row, a, 0, 0] * p + noise[row, a, 0, 1] * q
            u1 = noise[row, a, 1, 0] * p + noise[row, a, 1, 1] * q
            u2 = noise[row, a, 2, 0] * p + noise[row, a, 2, 1] * q
        else:
            w = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
            u0, u1, u2 = q0, q1, q2
        h = (b0 * q0 + b1 * q1 + b2 * q2) / w
        share = h / w
        g0, g1, g2 = (b0 - share * u0) / w, (b1 - share * u1) / w, (b2 - share * u2) / w
        e0, e1, e2 = cross(c0, c1, c2, g0, g1, g2)
        for x in range(4):
            ends[a, x] = (
                e0 * by_direction[0, x] + e1 * by_direction[1, x] + e2 * by_direction[2, x]
                + g0 * by_moment[0, x] + g1 * by_moment[1, x] + g2 * by_moment[2, x]
            )  # fmt: skip
        ends[a, 4] = h
        rounding += (4.0 * 2.220446049250313e-16 * size / w) ** 2
    return rounding


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def add_ends(ends, total):
    """Add [J h]' [J h] of both ends."""
    for a in range(2):
        for x in range(5):
            for y in range(5):
                total[x, y] += ends[a, x] * ends[a, y]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def sum_information(low, high, track, noise, centre, direction, moment, by_direction, by_moment, total, rounding):
    """[J h]' [J h] (t x 5 x 5) of the tracks low to high about the centres of their charts; see `residuals.py`."""
    ends = np.empty((2, 5))
    for t in range(low, high):
        d0, d1, d2 = direction[t, 0], direction[t, 1], direction[t, 2]
        m0, m1, m2 = moment[t, 0], moment[t, 1], moment[t, 2]
        size = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        for k in range(track.start[t], track.start[t + 1]):
            row = track.rows[k]
            c0, c1 = track.centre[row, 0] - centre[t, 0], track.centre[row, 1] - centre[t, 1]
            c2 = track.centre[row, 2] - centre[t, 2]
            rounding[t] += row_information(
                track, noise, row, c0, c1, c2, d0, d1, d2, m0, m1, m2, size, by_direction[t], by_moment[t], ends
            )
            add_ends(ends, total[t])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def planes(low, high, bearings, rotation, by_pixel, covariance, world, normal, noise):
    """World bearings, plane normals and noise of the arcs low to high; returns how many covariances are not positive definite."""
    wrong = 0
    for n in range(low, high):
        for a in range(2):
            for x in range(3):
                world[n, a, x] = (
                    bearings[n, a, 0] * rotation[n, 0, x]
                    + bearings[n, a, 1] * rotation[n, 1, x]
                    + bearings[n, a, 2] * rotation[n, 2, x]
                )
        a0, a1, a2 = world[n, 0, 0], world[n, 0, 1], world[n, 0, 2]
        b0, b1, b2 = world[n, 1, 0], world[n, 1, 1], world[n, 1, 2]
        sign = -1.0 if a0 * b0 + a1 * b1 + a2 * b2 < 0.0 else 1.0
        n0, n1, n2 = cross(a0, a1, a2, b0 - sign * a0, b1 - sign * a1, b2 - sign * a2)
        size = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        size = size if size > 0.0 else 1.0
        normal[n, 0], normal[n, 1], normal[n, 2] = n0 / size, n1 / size, n2 / size
        for a in range(2 if len(noise) else 0):
            l00, l10, l11 = 1.0, 0.0, 1.0
            if len(covariance):
                l00 = math.sqrt(covariance[n, a, 0, 0])
                l10 = covariance[n, a, 1, 0] / l00
                l11 = math.sqrt(covariance[n, a, 1, 1] - l10 * l10)
                if not (l00 > 0.0 and l11 > 0.0 and math.isfinite(l00 + l10 + l11)):
                    wrong += 1
            for x in range(3):
                u = v = 0.0
                for y in range(3):
                    u += rotation[n, y, x] * by_pixel[n, a, y, 0]
                    v += rotation[n, y, x] * by_pixel[n, a, y, 1]
                noise[n, a, x, 0], noise[n, a, x, 1] = u * l00 + v * l10, v * l11
    return wrong
