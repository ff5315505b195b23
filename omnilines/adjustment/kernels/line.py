"""What every compiled pass over lines needs: one observation, one line's step, one robust weight (see `engine.py`).

Frames are poses: R by rows and the centre C (12). A cost is given by two rows V_a of each observation and, but for the sector
cost, their spreads B_a (symmetric, as xx, xy, xz, yy, yz, zz): r_a = V_a . M / w_a with w_a = |M| or w_a^2 = M' B_a M. Everything
else follows by the chain rule (`LineChart`). Small vectors are passed as numbers, which the compiler keeps in registers.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from omnilines.least_squares.schur import LEAST_PIVOT

# Sums may be reordered and multiply-adds fused; NaN and infinity keep their meaning, since they make a step be refused.
FAST = {"contract", "reassoc", "nsz", "arcp"}
NONE, HUBER, CAUCHY = 0, 1, 2
LOSS_KINDS = {"none": NONE, "huber": HUBER, "cauchy": CAUCHY}
PHI_MIN_RAD, PHI_MAX_RAD = math.radians(20), math.radians(70)
"""As in `LineChart`."""


class Views(NamedTuple):
    """n observations in the order of the t lines that the passes go through, of each line by frame: held frames come last."""

    order: np.ndarray
    """Line at each place (t)."""
    start: np.ndarray
    """First observation of each place (t + 1)."""
    frame: np.ndarray
    """Place of each observation's frame (n, int32)."""
    rows: np.ndarray
    """V (n x 2 x 3)."""
    spread: np.ndarray
    """B (n x 2 x 6), or of no observation for the sector cost."""
    kind: int
    """Of the loss: NONE, HUBER or CAUCHY."""
    scale: float
    """Of the loss, in the unit of the residuals."""


class LineStates(NamedTuple):
    """The charts of t lines (`LineChart`)."""

    centre: np.ndarray
    rho: np.ndarray
    turn: np.ndarray
    """S (t x 3 x 3)."""
    phi: np.ndarray
    held: np.ndarray


class Pairs(NamedTuple):
    """Where the block of two free frames i <= j lies: block_of[window[i] + j - i]."""

    free: int
    """Number of free frames; the places of held ones follow."""
    window: np.ndarray
    block_of: np.ndarray
    first: int
    """Number of the first block of sums that hold a part of them."""


class FrameSums(NamedTuple):
    """What the lines give to the reduced system of the frames."""

    blocks: np.ndarray
    """S (blocks x 6 x 6)."""
    gradient: np.ndarray
    """The right side of S, and after it -sum P'r, the frames' own part (frames x 12)."""
    diagonal: np.ndarray
    """Of sum P'P (frames x 6)."""


class LineBlocks(NamedTuple):
    """What is kept of every line between the passes."""

    factors: np.ndarray
    """L by rows (t x 10)."""
    gradient: np.ndarray
    """-sum J'r (t x 4)."""
    diagonal: np.ndarray
    """Of E without damping (t x 4)."""


class LineSearch(NamedTuple):
    """How far each of t lines is, where all frames are held and every line is a problem of its own."""

    cost: np.ndarray
    damping: np.ndarray
    growth: np.ndarray
    """By which the damping is multiplied next, should a step be refused."""
    end: np.ndarray
    """MOVING, or how it ended (int8)."""


MOVING, CONVERGED, STALLED, SINGULAR = 0, 1, 2, 3


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def view(pose, f, c0, c1, c2, m0, m1, m2, d0, d1, d2):
    """M = R (m_c + (c - C) x d) and R d in the frame f, and c - C; a pose is R by rows and the centre C."""
    o0, o1, o2 = c0 - pose[f, 9], c1 - pose[f, 10], c2 - pose[f, 11]
    q0, q1, q2 = m0 + o1 * d2 - o2 * d1, m1 + o2 * d0 - o0 * d2, m2 + o0 * d1 - o1 * d0
    return (
        pose[f, 0] * q0 + pose[f, 1] * q1 + pose[f, 2] * q2,
        pose[f, 3] * q0 + pose[f, 4] * q1 + pose[f, 5] * q2,
        pose[f, 6] * q0 + pose[f, 7] * q1 + pose[f, 8] * q2,
        pose[f, 0] * d0 + pose[f, 1] * d1 + pose[f, 2] * d2,
        pose[f, 3] * d0 + pose[f, 4] * d1 + pose[f, 5] * d2,
        pose[f, 6] * d0 + pose[f, 7] * d1 + pose[f, 8] * d2,
        o0,
        o1,
        o2,
    )


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def residual(rows, spread, k, a, x, y, z):
    """r_a of observation k and d r_a / d M, M = (x, y, z)."""
    v0, v1, v2 = rows[k, a, 0], rows[k, a, 1], rows[k, a, 2]
    if len(spread) == 0:
        s0, s1, s2 = x, y, z
    else:
        s0 = spread[k, a, 0] * x + spread[k, a, 1] * y + spread[k, a, 2] * z
        s1 = spread[k, a, 1] * x + spread[k, a, 3] * y + spread[k, a, 4] * z
        s2 = spread[k, a, 2] * x + spread[k, a, 4] * y + spread[k, a, 5] * z
    square = x * s0 + y * s1 + z * s2
    inverse = 1.0 / math.sqrt(square)
    r = (v0 * x + v1 * y + v2 * z) * inverse
    share = r / square
    return r, v0 * inverse - share * s0, v1 * inverse - share * s1, v2 * inverse - share * s2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def robust(kind, scale, square):
    """Loss of a squared residual norm and its derivative (`losses.py`)."""
    if kind == NONE:
        return square, 1.0
    s = square / (scale * scale)
    if kind == HUBER:
        if s <= 1.0:
            return square, 1.0
        root = math.sqrt(s)
        return (2.0 * root - 1.0) * scale * scale, 1.0 / root
    return math.log1p(s) * scale * scale, 1.0 / (1.0 + s)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def line_cost(views, place, pose, centre, rho, turn, phi):
    """Sum of the loss over the observations of one line."""
    length = rho * math.tan(phi)
    d0, d1, d2 = turn[0, 0], turn[1, 0], turn[2, 0]
    m0, m1, m2 = length * turn[0, 1], length * turn[1, 1], length * turn[2, 1]
    total = 0.0
    for k in range(views.start[place], views.start[place + 1]):
        x, y, z, _, _, _, _, _, _ = view(pose, views.frame[k], centre[0], centre[1], centre[2], m0, m1, m2, d0, d1, d2)
        r0, _, _, _ = residual(views.rows, views.spread, k, 0, x, y, z)
        r1, _, _, _ = residual(views.rows, views.spread, k, 1, x, y, z)
        value, _ = robust(views.kind, views.scale, r0 * r0 + r1 * r1)
        total += value
    return total


@njit(cache=True, nogil=True)
@no_type_check
def most_views(views, low, high):
    """Observations of the line with most of them, of the places low to high."""
    most = 1
    for place in range(low, high):
        most = max(most, views.start[place + 1] - views.start[place])
    return most


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def exponential(w0, w1, w2, out):
    """exp([w]x) into out (3 x 3), by series below 0.03 rad as in `camera_models.pose`."""
    a2 = w0 * w0 + w1 * w1 + w2 * w2
    if a2 < 1e-3:
        first = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0))
        second = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0 * (1.0 - a2 / 56.0))
    else:
        a = math.sqrt(a2)
        first = math.sin(a) / a
        half = math.sin(0.5 * a) / a
        second = 2.0 * half * half
    out[0, 0] = 1.0 - second * (w1 * w1 + w2 * w2)
    out[1, 1] = 1.0 - second * (w0 * w0 + w2 * w2)
    out[2, 2] = 1.0 - second * (w0 * w0 + w1 * w1)
    out[0, 1], out[1, 0] = second * w0 * w1 - first * w2, second * w0 * w1 + first * w2
    out[0, 2], out[2, 0] = second * w0 * w2 + first * w1, second * w0 * w2 - first * w1
    out[1, 2], out[2, 1] = second * w1 * w2 - first * w0, second * w1 * w2 + first * w0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def retract(centre, rho, turn, phi, step, new_centre, new_turn, turned):
    """`LineChart.retract` and `recentred` of one line: fills its new centre and S (3 x 3), returns its new phi."""
    exponential(step[0], step[1], step[2], turned)
    for x in range(3):
        for y in range(3):
            new_turn[x, y] = turn[x, 0] * turned[0, y] + turn[x, 1] * turned[1, y] + turn[x, 2] * turned[2, y]
    phi += step[3]
    length = rho * math.tan(phi)
    d0, d1, d2 = new_turn[0, 0], new_turn[1, 0], new_turn[2, 0]
    m0, m1, m2 = length * new_turn[0, 1], length * new_turn[1, 1], length * new_turn[2, 1]
    new_centre[0], new_centre[1], new_centre[2] = centre[0], centre[1], centre[2]
    if phi < PHI_MIN_RAD or phi > PHI_MAX_RAD:
        # From the centre the line is at d x m; the new centre lies at the distance rho from it, against s3.
        o0 = d1 * m2 - d2 * m1 - rho * new_turn[0, 2]
        o1 = d2 * m0 - d0 * m2 - rho * new_turn[1, 2]
        o2 = d0 * m1 - d1 * m0 - rho * new_turn[2, 2]
        new_centre[0] += o0
        new_centre[1] += o1
        new_centre[2] += o2
        m0, m1, m2 = m0 - o1 * d2 + o2 * d1, m1 - o2 * d0 + o0 * d2, m2 - o0 * d1 + o1 * d0
    distance = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    if distance == 0.0:
        # The line passes through its centre: any s2 across it will do.
        m0, m1, m2 = new_turn[0, 2], new_turn[1, 2], new_turn[2, 2]
    along = m0 * d0 + m1 * d1 + m2 * d2
    m0, m1, m2 = m0 - along * d0, m1 - along * d1, m2 - along * d2
    size = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / size, m1 / size, m2 / size
    new_turn[0, 1], new_turn[1, 1], new_turn[2, 1] = m0, m1, m2
    new_turn[0, 2], new_turn[1, 2], new_turn[2, 2] = d1 * m2 - d2 * m1, d2 * m0 - d0 * m2, d0 * m1 - d1 * m0
    return math.atan2(distance, rho)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def factorise(e, damping, factor):
    """Cholesky factor, by rows of its lower triangle (10), of e (4 x 4, lower triangle used) with Marquardt's damping.

    A block that is nothing but zeros counts as the identity. Returns False where the block is singular.
    """
    if e[0, 0] == 0.0 and e[1, 1] == 0.0 and e[2, 2] == 0.0 and e[3, 3] == 0.0:
        factor[:] = 0.0
        factor[0], factor[2], factor[5], factor[9] = 1.0, 1.0, 1.0, 1.0
        return True
    sound = True
    for x in range(4):
        at_x = x * (x + 1) // 2
        for y in range(x + 1):
            at_y = y * (y + 1) // 2
            value = e[x, y]
            if x == y:
                value += damping * e[x, x]
            for k in range(y):
                value -= factor[at_x + k] * factor[at_y + k]
            if x != y:
                factor[at_x + y] = value / factor[at_y + y]
            elif value > LEAST_PIVOT * (1.0 + damping) * e[x, x]:
                factor[at_x + x] = math.sqrt(value)
            else:
                sound = False
                factor[at_x + x] = np.nan
    return sound


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def forward(factor, b0, b1, b2, b3):
    """L^-1 b."""
    y0 = b0 / factor[0]
    y1 = (b1 - factor[1] * y0) / factor[2]
    y2 = (b2 - factor[3] * y0 - factor[4] * y1) / factor[5]
    return y0, y1, y2, (b3 - factor[6] * y0 - factor[7] * y1 - factor[8] * y2) / factor[9]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", forceinline=True)
@no_type_check
def backward(factor, y0, y1, y2, y3):
    """L'^-1 y."""
    x3 = y3 / factor[9]
    x2 = (y2 - factor[8] * x3) / factor[5]
    x1 = (y1 - factor[7] * x3 - factor[4] * x2) / factor[2]
    return (y0 - factor[6] * x3 - factor[3] * x2 - factor[1] * x1) / factor[0], x1, x2, x3
