"""The consensus of tracks, compiled: one track after another (`candidates.py` and `consensus.py`, where what is computed stands).

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.triangulation.kernels.likelihood import PHI, equations, memory, refine_rows
from omnilines.triangulation.kernels.small import cross, inverse_of_normal, weighted_median
from omnilines.triangulation.kernels.sums import line_moment, row_information


class ConsensusRules(NamedTuple):
    """What a consensus is decided by: see `ConsensusOptions`, and the constants of `consensus.py`."""

    variance: float
    row_limit: float
    candidate_limit: float
    clearly_wrong: float
    decisive: float
    hypotheses: int
    rounds: int
    steps: int
    free_rounds: int
    parallel: float
    least_phi: float
    most_phi: float


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def square_of_row(track, noise, row, d0, d1, d2, m0, m1, m2):
    """Sum of h^2 of both ends of an arc from a line; infinite where the arc faces away."""
    q0, q1, q2 = line_moment(track, row, d0, d1, d2, m0, m1, m2)
    f0, f1, f2 = cross(d0, d1, d2, q0, q1, q2)
    towards = total = 0.0
    for a in range(2):
        b0, b1, b2 = track.arcs[row, a, 0], track.arcs[row, a, 1], track.arcs[row, a, 2]
        towards += b0 * f0 + b1 * f1 + b2 * f2
        h = b0 * q0 + b1 * q1 + b2 * q2
        if len(noise):
            p = noise[row, a, 0, 0] * q0 + noise[row, a, 1, 0] * q1 + noise[row, a, 2, 0] * q2
            q = noise[row, a, 0, 1] * q0 + noise[row, a, 1, 1] * q1 + noise[row, a, 2, 1] * q2
            total += h * h / (p * p + q * q)
        else:
            total += h * h / (q0 * q0 + q1 * q1 + q2 * q2)
    return total if towards > 0.0 and math.isfinite(total) else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def line_of_planes(track, one, other, parallel, line):
    """The line of the planes of two rows into `line` (direction, moment); false where they are parallel."""
    a0, a1, a2 = track.normal[one, 0], track.normal[one, 1], track.normal[one, 2]
    b0, b1, b2 = track.normal[other, 0], track.normal[other, 1], track.normal[other, 2]
    # About the centre of the first camera, so that nothing is lost far from the world origin.
    o0, o1, o2 = track.centre[one, 0], track.centre[one, 1], track.centre[one, 2]
    s = b0 * (o0 - track.centre[other, 0]) + b1 * (o1 - track.centre[other, 1]) + b2 * (o2 - track.centre[other, 2])
    d0, d1, d2 = cross(a0, a1, a2, b0, b1, b2)
    sine = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    if not sine > parallel:
        return False
    d0, d1, d2 = d0 / sine, d1 / sine, d2 / sine
    m0, m1, m2 = cross(o0, o1, o2, d0, d1, d2)
    line[0], line[1], line[2] = d0, d1, d2
    line[3], line[4], line[5] = m0 - s * a0 / sine, m1 - s * a1 / sine, m2 - s * a2 / sine
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def candidate_squares(track, noise, rows, pairs, parallel, lines, square):
    """Lines of pairs of the planes of `rows`, and sum h^2 of every row from each (pairs x rows), infinite where there is none."""
    for p in range(len(pairs)):
        if not line_of_planes(track, rows[pairs[p, 0]], rows[pairs[p, 1]], parallel, lines[p]):
            square[p, : len(rows)] = np.inf
            continue
        l0, l1, l2, l3, l4, l5 = lines[p]
        for k in range(len(rows)):
            square[p, k] = square_of_row(track, noise, rows[k], l0, l1, l2, l3, l4, l5)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def largest_track(low, high, track):
    """Rows of the largest of the tracks low to high."""
    most = 1
    for t in range(low, high):
        most = max(most, track.start[t + 1] - track.start[t])
    return most


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def majority_tracks(low, high, track, noise, pairs, pair_start, parallel, out):
    """Least over the candidates of the tracks low to high of the sum h^2 that a majority of the rows stays within."""
    most = largest_track(low, high, track)
    lines, square = np.empty((len(pairs), 6)), np.empty((len(pairs), most))
    for t in range(low, high):
        rows = track.rows[track.start[t] : track.start[t + 1]]
        own = pairs[pair_start[len(rows)] : pair_start[len(rows) + 1]]
        candidate_squares(track, noise, rows, own, parallel, lines, square)
        need = max(3, len(rows) // 2 + 1)
        out[t] = np.inf
        for p in range(len(own)):
            out[t] = min(out[t], np.sort(square[p, : len(rows)])[need - 1])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def nearest_pair_tracks(low, high, track, noise, pairs, pair_start, parallel, limit, out):
    """Of the tracks low to high the line of the two planes from which all rows have the least sum of squares, each at most
    `limit`; NaN for tracks of fewer than two rows."""
    most = largest_track(low, high, track)
    lines, square = np.empty((len(pairs), 6)), np.empty((len(pairs), most))
    for t in range(low, high):
        rows = track.rows[track.start[t] : track.start[t + 1]]
        own = pairs[pair_start[len(rows)] : pair_start[len(rows) + 1]]
        candidate_squares(track, noise, rows, own, parallel, lines, square)
        least, best = np.inf, 0
        for p in range(len(own)):
            total = 0.0
            for k in range(len(rows)):
                total += min(square[p, k], limit)
            if total < least:
                least, best = total, p
        for x in range(6):
            out[t, x] = lines[best, x] if least < np.inf else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def chart_of_line(track, rows, line, chart, distance, ordered, ones):
    """The chart of a line about the cameras of `rows`, centre in the world, into `chart`; its scale."""
    d0, d1, d2, m0, m1, m2 = line
    for k in range(len(rows)):
        q0, q1, q2 = line_moment(track, rows[k], d0, d1, d2, m0, m1, m2)
        distance[k] = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
        ordered[k], ones[k] = distance[k], 1.0
    scale, nearest = weighted_median(ordered, ones, len(rows)), 0
    for k in range(len(rows)):
        if abs(distance[k] - scale) <= abs(distance[nearest] - scale):
            nearest = k
    row = rows[nearest]
    q0, q1, q2 = line_moment(track, row, d0, d1, d2, m0, m1, m2)
    # From the camera to the foot of its perpendicular, d x q; s2 is along the moment about any point beside the line there.
    t0, t1, t2 = cross(d0, d1, d2, q0, q1, q2)
    away = 1.0 - scale / distance[nearest]
    for x in range(3):
        towards = t0 if x == 0 else (t1 if x == 1 else t2)
        moment = q0 if x == 0 else (q1 if x == 1 else q2)
        chart[x] = track.centre[row, x] + away * towards
        chart[3 + 3 * x] = line[x]
        chart[4 + 3 * x] = moment / distance[nearest]
        chart[5 + 3 * x] = towards / distance[nearest]
    chart[PHI] = math.atan2(scale, scale)
    return scale


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def line_of_chart(chart, origin, scale, line):
    """Direction and moment, world frame."""
    d0, d1, d2 = chart[3], chart[6], chart[9]
    length = scale * math.tan(chart[PHI])
    s0, s1, s2 = cross(origin[0] + chart[0], origin[1] + chart[1], origin[2] + chart[2], d0, d1, d2)
    line[0], line[1], line[2] = d0, d1, d2
    line[3], line[4], line[5] = length * chart[4] + s0, length * chart[7] + s1, length * chart[10] + s2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def judge_rows(track, noise, rows, inlier, own, line, variance, work, judged):
    """s of every row (head of `consensus.py`); `own` holds the rows that are inliers."""
    chart, origin, covariance, ends = work.chart, work.origin, work.inverse, work.ends
    scale = chart_of_line(track, rows, line, chart, work.distance, work.ordered, work.ones)
    origin[:] = chart[:3]
    chart[:3] = 0.0
    equations(track, noise, own, origin, scale, chart, work, work.total)
    sound = inverse_of_normal(work.total, 4, work.factor, covariance)
    by = work.by
    d0, d1, d2 = chart[3], chart[6], chart[9]
    length = scale * math.tan(chart[PHI])
    m0, m1, m2 = length * chart[4], length * chart[7], length * chart[10]
    for k in range(len(rows)):
        row = rows[k]
        c0, c1, c2 = (
            track.centre[row, 0] - origin[0],
            track.centre[row, 1] - origin[1],
            track.centre[row, 2] - origin[2],
        )
        rounding = row_information(track, noise, row, c0, c1, c2, d0, d1, d2, m0, m1, m2, abs(length), by[0], by[1], ends)
        sign = -1.0 if inlier[k] else 1.0
        a, b, d = 1.0, 0.0, 1.0
        for x in range(4):
            for y in range(4):
                a += sign * ends[0, x] * covariance[x, y] * ends[0, y]
                b += sign * ends[0, x] * covariance[x, y] * ends[1, y]
                d += sign * ends[1, x] * covariance[x, y] * ends[1, y]
        h1, h2 = ends[0, 4], ends[1, 4]
        # A row that alone fixes a direction of the line has no residual there: 0 over 0 is 0.
        square = (d * h1 * h1 - 2.0 * b * h1 * h2 + a * h2 * h2) / max(a * d - b * b, 1e-12)
        plain = square_of_row(track, noise, row, line[0], line[1], line[2], line[3], line[4], line[5])
        usable = sound and math.isfinite(square) and plain < np.inf
        judged[k] = square / (variance + rounding) if usable else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def settle(track, noise, rows, line, inlier, rules, work, judged):
    """The line refined on its inliers and all rows judged by it, in turn until none changes or the rounds are over."""
    for turn in range(rules.rounds):
        count = 0
        for k in range(len(rows)):
            if inlier[k]:
                work.own[count] = rows[k]
                count += 1
        own = work.own[:count]
        scale = chart_of_line(track, own, line, work.chart, work.distance, work.ordered, work.ones)
        if math.isfinite(scale) and math.isfinite(work.chart[0]):
            work.origin[:] = work.chart[:3]
            work.chart[:3] = 0.0
            refine_rows(track, noise, own, work.origin, scale, work.chart, rules.least_phi, rules.most_phi, rules.steps, work)
            line_of_chart(work.chart, work.origin, scale, line)
        judge_rows(track, noise, rows, inlier, own, line, rules.variance, work, judged)
        changed = False
        for k in range(len(rows)):
            now = judged[k] <= rules.row_limit and (inlier[k] or turn < rules.free_rounds)
            changed = changed or now != inlier[k]
            inlier[k] = now
        if not changed:
            break


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def first_lines(cost, square, pairs, limit, views, hypotheses, lines, first, inlier):
    """The best candidates with their pairs; after each, pairs that both support it are out of the running."""
    for number in range(hypotheses):
        best = 0
        for p in range(len(pairs)):
            if cost[p] < cost[best]:
                best = p
        first[number] = lines[best]
        for k in range(views):
            inlier[number, k] = k == pairs[best, 0] or k == pairs[best, 1]
        for p in range(len(pairs)):
            if p == best or (square[best, pairs[p, 0]] <= limit and square[best, pairs[p, 1]] <= limit):
                cost[p] = np.inf


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def resolved(cost, inlier, judged, views, rules):
    """The hypothesis of the least truncated cost, and whether enough rows agree with it and no other contradicts it."""
    best = 0
    for number in range(rules.hypotheses):
        if cost[number] < cost[best]:
            best = number
    count = 0
    for k in range(views):
        count += inlier[best, k]
    sound = count >= max(3, views // 2 + 1)
    for number in range(rules.hypotheses):
        # Each of the two has a member that is far off the other's line.
        its, ours = False, False
        for k in range(views):
            its = its or (inlier[number, k] and judged[best, k] > rules.clearly_wrong)
            ours = ours or (inlier[best, k] and judged[number, k] > rules.clearly_wrong)
        if its and ours and cost[number] < cost[best] + rules.decisive:
            sound = False
    return best, sound


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def consensus_tracks(low, high, track, noise, pairs, pair_start, rules, out_inlier, out_square, out_solved):
    """The consensus of the tracks low to high, by row and by track."""
    most = largest_track(low, high, track)
    work, limit = memory(most), rules.candidate_limit
    lines, square, cost = np.empty((len(pairs), 6)), np.empty((len(pairs), most)), np.empty(len(pairs))
    line, truncated = np.empty((rules.hypotheses, 6)), np.empty(rules.hypotheses)
    inlier, judged = np.empty((rules.hypotheses, most), np.bool_), np.empty((rules.hypotheses, most))
    for t in range(low, high):
        rows = track.rows[track.start[t] : track.start[t + 1]]
        views = len(rows)
        own = pairs[pair_start[views] : pair_start[views + 1]]
        if not len(own):
            continue
        candidate_squares(track, noise, rows, own, rules.parallel, lines, square)
        for p in range(len(own)):
            cost[p] = 0.0
            for k in range(views):
                square[p, k] /= rules.variance
                cost[p] += min(square[p, k], limit)
        first_lines(cost, square, own, limit, views, rules.hypotheses, lines, line, inlier)
        for number in range(rules.hypotheses):
            settle(track, noise, rows, line[number], inlier[number, :views], rules, work, judged[number, :views])
            l0, l1, l2, l3, l4, l5 = line[number]
            truncated[number] = 0.0
            for k in range(views):
                plain = square_of_row(track, noise, rows[k], l0, l1, l2, l3, l4, l5) / rules.variance
                truncated[number] += min(plain, rules.row_limit) if inlier[number, k] else rules.row_limit
        best, out_solved[t] = resolved(truncated, inlier, judged, views, rules)
        for k in range(views):
            out_inlier[rows[k]], out_square[rows[k]] = inlier[best, k], judged[best, k]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def judge_tracks(low, high, track, noise, lines, variance, out_square):
    """s of every row of the tracks low to high, each line found from all rows of its track."""
    most = largest_track(low, high, track)
    work, every, judged = memory(most), np.ones(most, np.bool_), np.empty(most)
    for t in range(low, high):
        rows = track.rows[track.start[t] : track.start[t + 1]]
        if not len(rows):
            continue
        judge_rows(track, noise, rows, every[: len(rows)], rows, lines[t], variance, work, judged)
        for k in range(len(rows)):
            out_square[rows[k]] = judged[k]
