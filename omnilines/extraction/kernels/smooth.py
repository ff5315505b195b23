"""Chains of edge points cut into smooth curves, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED

MOST_TERMS = 7
ROUNDS = 3
"""Fits of one curve, with weights by the residuals of the one before."""
FLAT_SAG = 0.05
"""Over the chord: flatter curves are functions over their chord, others around a circle."""
OPEN_CHORD = 0.6
"""Over the length: curves that close more are halved; that of half a circle is 0.64."""
LEAST_POINTS = 12
INNER = 0.7
"""Of the half length, within which the curvature of a fitted curve means something."""
PLACES = 9
HUBER = 2.0
LEAST_SCALE_PX = 0.02


class SmoothLimits(NamedTuple):
    """What a smooth curve is; lengths in pixels."""

    min_length_px: float
    size_px: float
    """Half the diagonal of the image."""
    max_curvature: float
    max_scatter_px: float
    block: int
    """Edge points whose mean residual is judged."""
    block_sigmas: float
    block_floor_px: float
    corner_points: int
    max_turn_rad: float


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _terms(length: float, size: float) -> int:
    """Of the polynomial across a curve: lines of the world seen by a lens need the more the longer they are."""
    if length < 0.25 * size:
        return 3
    if length < 0.5 * size:
        return 4
    return 5 if length < size else MOST_TERMS


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _mean3(points: np.ndarray, order: np.ndarray, at: int) -> tuple[float, float]:
    a, b, c = order[at - 1], order[at], order[at + 1]
    return (points[a, 0] + points[b, 0] + points[c, 0]) / 3.0, (points[a, 1] + points[b, 1] + points[c, 1]) / 3.0


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _unroll(points: np.ndarray, order: np.ndarray, a: int, b: int, along: np.ndarray, across: np.ndarray) -> float:
    """Coordinates of points along and across a first guess of the curve, along it from -1 to 1; its signed curvature (towards
    the negative side across), NaN where it closes. `along` is left in pixels times half[0]."""
    u0, v0 = _mean3(points, order, a + 1)
    u1, v1 = _mean3(points, order, (a + b) // 2)
    u2, v2 = _mean3(points, order, b - 2)
    du, dv = u2 - u0, v2 - v0
    chord = math.sqrt(du * du + dv * dv)
    du, dv = du / chord, dv / chord
    sag = -(u1 - u0) * dv + (v1 - v0) * du
    if abs(sag) < FLAT_SAG * chord:
        mu, mv = 0.5 * (u0 + u2), 0.5 * (v0 + v2)
        for k in range(a, b):
            x, y = points[order[k], 0] - mu, points[order[k], 1] - mv
            along[k], across[k] = x * du + y * dv, -x * dv + y * du
        return 0.0
    # The circle through the three: the middle of the chord at distance h = r - |sag| from its centre, about.
    p = (u1 - u0) * du + (v1 - v0) * dv
    # In the chord's frame, from its first end: |(c/2, h)| = |(p - c/2, sag - h)|.
    h = (p * p + sag * sag - p * chord) / (2.0 * sag)
    radius = math.sqrt(0.25 * chord * chord + h * h)
    cu, cv = u0 + 0.5 * chord * du - h * dv, v0 + 0.5 * chord * dv + h * du
    mu, mv = (u1 - cu) / radius, (v1 - cv) / radius
    for k in range(a, b):
        x, y = points[order[k], 0] - cu, points[order[k], 1] - cv
        along[k] = radius * math.atan2(mu * y - mv * x, mu * x + mv * y)
        across[k] = math.sqrt(x * x + y * y) - radius
    return 1.0 / radius


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _solve(matrix: np.ndarray, right: np.ndarray, terms: int) -> None:
    """Cholesky in place; the solution in `right`."""
    for i in range(terms):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = math.sqrt(max(total, 1e-12))
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(terms):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(terms - 1, -1, -1):
        for k in range(i + 1, terms):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


@njit(cache=True, nogil=True)
@no_type_check
def _fit(along: np.ndarray, across: np.ndarray, terms: int, residual: np.ndarray, coefficients: np.ndarray) -> float:
    """Residuals of the robust polynomial across over along (-1 to 1), and their robust standard deviation."""
    count = len(along)
    matrix, power, sizes = np.empty((MOST_TERMS, MOST_TERMS)), np.empty(MOST_TERMS), np.empty(count)
    scale = np.inf
    for _ in range(ROUNDS):
        matrix[:] = 0.0
        coefficients[:] = 0.0
        for k in range(count):
            weight = 1.0
            if scale < np.inf and abs(residual[k]) > HUBER * scale:
                weight = HUBER * scale / abs(residual[k])
            power[0] = 1.0
            for i in range(1, terms):
                power[i] = power[i - 1] * along[k]
            for i in range(terms):
                coefficients[i] += weight * power[i] * across[k]
                for j in range(i + 1):
                    matrix[i, j] += weight * power[i] * power[j]
        _solve(matrix, coefficients, terms)
        for k in range(count):
            value = coefficients[terms - 1]
            for i in range(terms - 2, -1, -1):
                value = value * along[k] + coefficients[i]
            residual[k] = across[k] - value
            sizes[k] = abs(residual[k])
        scale = max(1.4826 * np.median(sizes) * math.sqrt(count / (count - terms)), LEAST_SCALE_PX)
    return scale


@njit(cache=True, nogil=True, **BORROWED)
@no_type_check
def _sharpest(coefficients: np.ndarray, terms: int, half: float, bend: float) -> tuple[float, float]:
    """The largest curvature of a fitted curve, 1/px, and where (-1 to 1) it is."""
    largest, where = 0.0, 0.0
    for p in range(PLACES):
        t = INNER * (2.0 * p / (PLACES - 1) - 1.0)
        second, power = 0.0, 1.0
        for i in range(2, terms):
            second += i * (i - 1) * coefficients[i] * power
            power *= t
        value = abs(bend - second / (half * half))
        if value > largest:
            largest, where = value, t
    return largest, where


@njit(cache=True, nogil=True)
@no_type_check
def _corners(points: np.ndarray, order: np.ndarray, a: int, b: int, limits: SmoothLimits, cuts: np.ndarray) -> int:
    """Where the chain [a, b) turns by more than a smooth curve does: positions, ascending, in `cuts`, with both ends."""
    reach, count = limits.corner_points, 1
    cuts[0] = a
    best, at = 0.0, -1
    for k in range(a + reach, b - reach):
        i, j, m = order[k - reach], order[k], order[k + reach]
        x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        z, w = points[m, 0] - points[j, 0], points[m, 1] - points[j, 1]
        turn = abs(math.atan2(x * w - y * z, x * z + y * w))
        if turn > limits.max_turn_rad and turn > best:
            best, at = turn, k
        if at >= 0 and (turn <= limits.max_turn_rad or k - at > reach):
            cuts[count] = at
            count += 1
            best, at = 0.0, -1
    cuts[count] = b
    return count + 1


@njit(cache=True, nogil=True)
@no_type_check
def _worst_block(residual: np.ndarray, scale: float, limits: SmoothLimits) -> int:
    """The middle of the run of points whose mean residual is largest, where that is more than noise; else -1."""
    size, worst, at, total = limits.block, 0.0, -1, 0.0
    for k in range(len(residual)):
        total += residual[k]
        if k >= size:
            total -= residual[k - size]
        if k >= size - 1 and abs(total) > worst:
            worst, at = abs(total), k - size // 2
    limit = max(limits.block_sigmas * scale / math.sqrt(size), limits.block_floor_px)
    return at if worst / size > limit else -1


@njit(cache=True, nogil=True)
@no_type_check
def smooth_pieces(
    points: np.ndarray, order: np.ndarray, starts: np.ndarray, limits: SmoothLimits
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces [begin, end) (m, 2) of `order` that are smooth curves, the residual of each point of `order` across its curve, and
    the robust standard deviation of those of each piece.

    Chains are cut at corners; then where a curve leaves its points by more than noise, where it is bent more than
    `max_curvature`, and in the middle where it nearly closes. What is shorter than `min_length_px` is dropped.
    """
    longest = 0
    for chain in range(len(starts) - 1):
        longest = max(longest, starts[chain + 1] - starts[chain])
    along, across, residuals = np.zeros(len(order)), np.zeros(len(order)), np.full(len(order), np.nan)
    coefficients, cuts = np.zeros(MOST_TERMS), np.empty(longest + 2, dtype=np.int64)
    room, made = 1024, 0
    pieces, scatter = np.empty((room, 2), dtype=np.int64), np.empty(room)
    stack = np.empty((4 * 64 + 2 * longest, 2), dtype=np.int64)
    for chain in range(len(starts) - 1):
        if starts[chain + 1] - starts[chain] < LEAST_POINTS:
            continue
        count = _corners(points, order, starts[chain], starts[chain + 1], limits, cuts)
        depth = 0
        for c in range(count - 1):
            stack[depth, 0], stack[depth, 1] = cuts[c], cuts[c + 1]
            depth += 1
        while depth:
            depth -= 1
            a, b = stack[depth]
            if b - a < LEAST_POINTS:
                continue
            length = 0.0
            for k in range(a + 1, b):
                i, j = order[k - 1], order[k]
                length += math.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
            if length < limits.min_length_px:
                continue
            first, last = order[a + 1], order[b - 2]
            chord = math.hypot(points[last, 0] - points[first, 0], points[last, 1] - points[first, 1])
            at = -1
            if chord < OPEN_CHORD * length:
                at = (a + b) // 2
            else:
                bend = _unroll(points, order, a, b, along, across)
                low, high = np.min(along[a:b]), np.max(along[a:b])
                half = 0.5 * (high - low)
                for k in range(a, b):
                    along[k] = (along[k] - low) / half - 1.0
                terms, residual = _terms(length, limits.size_px), residuals[a:b]
                scale = _fit(along[a:b], across[a:b], terms, residual, coefficients)
                at = _worst_block(residual, scale, limits)
                if at >= 0:
                    at += a
                else:
                    curvature, where = _sharpest(coefficients, terms, half, bend)
                    if curvature > limits.max_curvature:
                        at = a + int((b - a) * 0.5 * (1.0 + where))
                    elif scale > limits.max_scatter_px:
                        residual[:] = np.nan
                        continue
            if at >= 0:
                residuals[a:b] = np.nan
                at = min(max(at, a + 1), b - 1)
                stack[depth, 0], stack[depth, 1] = a, at
                stack[depth + 1, 0], stack[depth + 1, 1] = at, b
                depth += 2
                continue
            if made == room:
                room *= 2
                more, wider = np.empty((room, 2), dtype=np.int64), np.empty(room)
                more[:made], wider[:made] = pieces, scatter
                pieces, scatter = more, wider
            pieces[made, 0], pieces[made, 1], scatter[made] = a, b, scale
            made += 1
    return pieces[:made].copy(), residuals, scatter[:made].copy()
