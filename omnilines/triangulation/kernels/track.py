"""The default triangulation, compiled: frame and dual-space line of one track after another (`frames.py`, `dual.py`).

What is computed, and why, stands there; here the same steps follow each other while a track's few numbers are at hand.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.triangulation.kernels.small import cross, orthogonalise, triangle, weighted_median


class TrackRows(NamedTuple):
    """Observations by track: those of track t are rows[start[t]:start[t + 1]]."""

    start: np.ndarray
    rows: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    arcs: np.ndarray
    """(n x 2 x 3), of no observation where they are not known."""


class TrackResults(NamedTuple):
    """One row a track; the first six make up `TrackFrames`."""

    direction: np.ndarray
    point: np.ndarray
    angle: np.ndarray
    focus: np.ndarray
    unit: np.ndarray
    away: np.ndarray
    mean_normal: np.ndarray
    line_direction: np.ndarray
    line_moment: np.ndarray
    unsolved: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def preliminary(track, t, a, v, length, out):
    """Principal axes of the normals (columns of v), the point nearest to the mean camera and the plane angle."""
    low, high = track.start[t], track.start[t + 1]
    views = high - low
    c0 = c1 = c2 = 0.0
    for k in range(low, high):
        row = track.rows[k]
        c0, c1, c2 = c0 + track.centre[row, 0], c1 + track.centre[row, 1], c2 + track.centre[row, 2]
        for x in range(3):
            a[k - low, x] = track.normal[row, x]
    c0, c1, c2 = c0 / views, c1 / views, c2 / views
    orthogonalise(a, views, 3, v, length)
    out.angle[t] = 2.0 * math.asin(min(length[1] / math.sqrt(views), math.sqrt(0.5)))
    p0 = p1 = 0.0
    for k in range(low, high):
        row, i = track.rows[k], k - low
        s = -(
            track.normal[row, 0] * (track.centre[row, 0] - c0)
            + track.normal[row, 1] * (track.centre[row, 1] - c1)
            + track.normal[row, 2] * (track.centre[row, 2] - c2)
        )
        p0 += a[i, 0] * s
        p1 += a[i, 1] * s
    p0, p1 = p0 / (length[0] * length[0]), p1 / (length[1] * length[1])
    for x in range(3):
        mean = c0 if x == 0 else (c1 if x == 1 else c2)
        out.direction[t, x], out.mean_normal[t, x] = v[x, 2], v[x, 0]
        out.point[t, x] = mean - p0 * v[x, 0] - p1 * v[x, 1]
        out.away[t, x] = mean - out.point[t, x]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def widest_gap(track, t, v, trace, ones, out):
    """The middle of the widest gap between the planes, on the side of the cameras: `out.away` holds the way to their mean."""
    low, high = track.start[t], track.start[t + 1]
    views = high - low
    for k in range(low, high):
        row = track.rows[k]
        x = track.normal[row, 0] * v[0, 0] + track.normal[row, 1] * v[1, 0] + track.normal[row, 2] * v[2, 0]
        y = track.normal[row, 0] * v[0, 1] + track.normal[row, 1] * v[1, 1] + track.normal[row, 2] * v[2, 1]
        angle = math.atan2(x, -y)
        trace[k - low] = angle + math.pi if angle < 0.0 else (angle - math.pi if angle >= math.pi else angle)
        ones[k - low] = 1.0
    weighted_median(trace, ones, views)
    best, middle = -1.0, 0.0
    for i in range(views):
        after = trace[i + 1] if i + 1 < views else trace[0] + math.pi
        if after - trace[i] > best:
            best, middle = after - trace[i], 0.5 * (trace[i] + after)
    cosine, sine, side = math.cos(middle), math.sin(middle), 0.0
    for x in range(3):
        side += (cosine * v[x, 0] + sine * v[x, 1]) * out.away[t, x]
    sign = -1.0 if side < 0.0 else 1.0
    for x in range(3):
        out.away[t, x] = sign * (cosine * v[x, 0] + sine * v[x, 1])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def seen_position(c0, c1, c2, m0, m1, m2, d0, d1, d2, b0, b1, b2):
    """`PlueckerLines.position_seen`: position, whether it is in front, and leverage; the moment is that about the centre."""
    f0, f1, f2 = cross(d0, d1, d2, m0, m1, m2)
    towards = b0 * f0 + b1 * f1 + b2 * f2
    if not towards > 0.0:
        return 0.0, False, 1.0
    square = m0 * m0 + m1 * m1 + m2 * m2
    offset = square * (b0 * d0 + b1 * d1 + b2 * d2) / towards
    return c0 * d0 + c1 * d1 + c2 * d2 + offset, True, (square + offset * offset) / max(math.sqrt(square), 1e-300)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def focus_and_unit(track, t, shortest, work, out):
    """Middle and half the length of the segment that the arcs show on the preliminary line; without arcs the distance."""
    first, first_weight, second, second_weight = work
    d0, d1, d2 = out.direction[t, 0], out.direction[t, 1], out.direction[t, 2]
    p0, p1, p2 = out.point[t, 0], out.point[t, 1], out.point[t, 2]
    low, high = track.start[t], track.start[t + 1]
    for k in range(low, high):
        row = track.rows[k]
        m0, m1, m2 = cross(p0 - track.centre[row, 0], p1 - track.centre[row, 1], p2 - track.centre[row, 2], d0, d1, d2)
        first[k - low], first_weight[k - low] = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2), 1.0
    out.unit[t] = weighted_median(first, first_weight, high - low)
    out.focus[t, 0], out.focus[t, 1], out.focus[t, 2] = p0, p1, p2
    if len(track.arcs) == 0:
        return
    used = 0
    for k in range(low, high):
        r = track.rows[k]
        # Positions are measured from the point, so that nothing is lost far from the origin.
        c0, c1, c2 = track.centre[r, 0] - p0, track.centre[r, 1] - p1, track.centre[r, 2] - p2
        m0, m1, m2 = cross(-c0, -c1, -c2, d0, d1, d2)
        a, a_in_front, a_leverage = seen_position(
            c0, c1, c2, m0, m1, m2, d0, d1, d2, track.arcs[r, 0, 0], track.arcs[r, 0, 1], track.arcs[r, 0, 2]
        )
        b, b_in_front, b_leverage = seen_position(
            c0, c1, c2, m0, m1, m2, d0, d1, d2, track.arcs[r, 1, 0], track.arcs[r, 1, 1], track.arcs[r, 1, 2]
        )
        if not (a_in_front and b_in_front and math.isfinite(a) and math.isfinite(b)):
            continue
        if a > b:
            a, b, a_leverage, b_leverage = b, a, b_leverage, a_leverage
        first[used], first_weight[used] = a, 1.0 / max(a_leverage, 1e-300)
        second[used], second_weight[used] = b, 1.0 / max(b_leverage, 1e-300)
        used += 1
    if used == 0:
        return
    begin, end = weighted_median(first, first_weight, used), weighted_median(second, second_weight, used)
    middle, half = 0.5 * (begin + end), 0.5 * abs(end - begin)
    out.focus[t, 0], out.focus[t, 1], out.focus[t, 2] = p0 + middle * d0, p1 + middle * d1, p2 + middle * d2
    out.unit[t] = max(half, shortest * out.unit[t])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def dual_line(track, t, null_space, a, v, length, out):
    """The line of the smallest singular value of the rows [ [n]x  -s I ] about the origin focus + unit away."""
    low, high = track.start[t], track.start[t + 1]
    unit = out.unit[t]
    o0 = out.focus[t, 0] + unit * out.away[t, 0]
    o1 = out.focus[t, 1] + unit * out.away[t, 1]
    o2 = out.focus[t, 2] + unit * out.away[t, 2]
    rows = 3 * (high - low)
    for k in range(low, high):
        r, i = track.rows[k], 3 * (k - low)
        n0, n1, n2 = track.normal[r, 0], track.normal[r, 1], track.normal[r, 2]
        s = -(n0 * (track.centre[r, 0] - o0) + n1 * (track.centre[r, 1] - o1) + n2 * (track.centre[r, 2] - o2)) / unit
        for x in range(3):
            for y in range(3):
                a[i + x, y] = 0.0
                a[i + x, 3 + y] = -s if x == y else 0.0
        a[i, 1], a[i, 2], a[i + 1, 0], a[i + 1, 2], a[i + 2, 0], a[i + 2, 1] = -n2, n1, n2, -n0, -n1, n0
    triangle(a, rows, 6)
    orthogonalise(a, min(rows, 6), 6, v, length)
    out.unsolved[t] = length[4] <= null_space * length[0]
    m0, m1, m2, d0, d1, d2 = v[0, 5], v[1, 5], v[2, 5], v[3, 5], v[4, 5], v[5, 5]
    size = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2, m0, m1, m2 = d0 / size, d1 / size, d2 / size, m0 / size, m1 / size, m2 / size
    along = m0 * d0 + m1 * d1 + m2 * d2
    s0, s1, s2 = cross(o0, o1, o2, d0, d1, d2)
    out.line_direction[t, 0], out.line_direction[t, 1], out.line_direction[t, 2] = d0, d1, d2
    out.line_moment[t, 0] = unit * (m0 - along * d0) + s0
    out.line_moment[t, 1] = unit * (m1 - along * d1) + s1
    out.line_moment[t, 2] = unit * (m2 - along * d2) + s2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_tracks(low, high, track, smallest_angle, shortest, null_space, out):
    """Frames and lines of the tracks low to high; rows of `out` stay NaN for tracks that are not solvable."""
    most = 2
    for t in range(low, high):
        most = max(most, track.start[t + 1] - track.start[t])
    a, v, length = np.empty((most, 3)), np.empty((3, 3)), np.empty(3)
    rows, right, singular = np.empty((3 * most, 6)), np.empty((6, 6)), np.empty(6)
    work = (np.empty(most), np.empty(most), np.empty(most), np.empty(most))
    for t in range(low, high):
        if track.start[t + 1] - track.start[t] < 2:
            continue
        preliminary(track, t, a, v, length, out)
        if not out.angle[t] > smallest_angle:
            for x in range(3):
                out.direction[t, x] = out.point[t, x] = out.away[t, x] = np.nan
            continue
        widest_gap(track, t, v, work[0], work[1], out)
        focus_and_unit(track, t, shortest, work, out)
        if out.unit[t] > 0.0 and math.isfinite(out.unit[t]) and math.isfinite(out.focus[t, 0] + out.away[t, 0]):
            dual_line(track, t, null_space, rows, right, singular, out)
