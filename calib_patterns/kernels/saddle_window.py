"""Where the fits of saddle.py start, and the pixels that they use, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

PARAMETERS = 11
"""u, v, two edge angles, two log blurs, gain, a, l_u, l_v, b."""
MAX_HALF_WINDOW_PX = 10
ROW_LENGTH = 448
"""Room for the pixels of the largest window, a multiple of 16."""
U, V, GREY, FIRST_FREE_ROW = 0, 1, 2, 3
"""Rows of the buffer that `window` fills: pixels, counted from the middle of the window, and grey levels."""
FEW_PIXELS = 2 * PARAMETERS
"""A window of fewer pixels than this is widened to the 5 x 5 around the corner."""
LEAST_SQUARE_PX = 0.5
"""Where squares are narrower than this, nothing is fitted."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def starts(
    corners: np.ndarray, first: np.ndarray, second: np.ndarray, blur_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """What fits start from, for n corners with derivatives (n x 2 x 2) as `saddle.fit_corners` states.

    Returns the parameters (n x 11), from the directions of the edges (tangents +x and -y, normals +y and +x) and `blur_px`
    (n x 2, of both edges) or less where squares are small; the signed curvatures (n x 2, 1/px) of both edges, positive towards
    the normals (-t_v, t_u) of these tangents; the matrices (n x 2 x 2) that take pixels to squares; by how many pixels (n) a step
    of one square moves the least, the smaller singular value; and half the width of the largest box (px) around a square and its
    neighbours.
    """
    count, widest = len(corners), 0.0
    parameters, curvature = np.zeros((count, PARAMETERS)), np.empty((count, 2))
    into_squares, narrowest = np.empty((count, 2, 2)), np.empty(count)
    for i in range(count):
        a, b, c, d = first[i, 0, 0], first[i, 0, 1], first[i, 1, 0], first[i, 1, 1]
        determinant, total = abs(a * d - b * c), a * a + b * b + c * c + d * d
        larger = math.sqrt(0.5 * (total + math.sqrt(max(total * total - 4.0 * determinant * determinant, 0.0))))
        narrowest[i] = determinant / max(larger, 1e-300)
        if not narrowest[i] > LEAST_SQUARE_PX:
            a, b, c, d = 1.0, 0.0, 0.0, 1.0
        widest = max(widest, max(abs(a) + abs(b), abs(c) + abs(d)))
        p = parameters[i]
        p[0], p[1], p[2], p[3] = corners[i, 0], corners[i, 1], math.atan2(c, a), math.atan2(-d, -b)
        for k in range(2):
            p[4 + k] = math.log(min(max(0.2 * narrowest[i], 0.5), blur_px[i, k]))
        curvature[i, 0] = (a * second[i, 1, 0] - c * second[i, 0, 0]) / (a * a + c * c) ** 1.5
        curvature[i, 1] = -(b * second[i, 1, 1] - d * second[i, 0, 1]) / (b * b + d * d) ** 1.5
        per = 1.0 / (a * d - b * c)
        into_squares[i, 0, 0], into_squares[i, 0, 1] = d * per, -b * per
        into_squares[i, 1, 0], into_squares[i, 1, 1] = -c * per, a * per
    return parameters, curvature, into_squares, narrowest, widest


@njit(inline="always")
@no_type_check
def _within(du, dv, s_u, s_v, t_u, t_v, reach, farthest):
    return abs(s_u * du + s_v * dv) < reach and abs(t_u * du + t_v * dv) < reach and du * du + dv * dv < farthest


@njit(cache=True, nogil=True)
@no_type_check
def window(
    image: np.ndarray,
    corner: np.ndarray,
    into_squares: np.ndarray,
    plain: np.ndarray,
    half: int,
    stride: int,
    reach: float,
    rows: np.ndarray,
) -> int:
    """The pixels of a corner's window, one in `stride` of each row and column: within `reach` squares of it, within `half` px,
    and in what is of one colour."""
    height, width = image.shape
    # A corner far outside, or nowhere, as a camera of wild coefficients may say.
    if not (-half - 0.5 <= corner[0] < width + half and -half - 0.5 <= corner[1] < height + half):
        return 0
    row, column, farthest = round(corner[1]), round(corner[0]), (half + 0.5) ** 2
    s_u, s_v, t_u, t_v = into_squares[0, 0], into_squares[0, 1], into_squares[1, 0], into_squares[1, 1]
    all_plain = min(min(plain[0, 0], plain[0, 1]), min(plain[1, 0], plain[1, 1])) >= reach
    count, few = 0, False
    for _ in range(2):
        near, count = 0, 0
        for y in range(row - half, row + half + 1, stride):
            dv = y - corner[1]
            first, last = column - half, column + half
            last -= (last - first) % stride
            if not few:
                # What is inside of a row has no gaps.
                while first <= last and not _within(first - corner[0], dv, s_u, s_v, t_u, t_v, reach, farthest):
                    first += stride
                while first < last and not _within(last - corner[0], dv, s_u, s_v, t_u, t_v, reach, farthest):
                    last -= stride
                near += (last - first) // stride + 1
            while first < 0:
                first += stride
            while last >= width:
                last -= stride
            if y < 0 or y >= height or first > last:
                continue
            if all_plain and not few:
                for x in range(first, last + 1, stride):
                    rows[U * ROW_LENGTH + count], rows[V * ROW_LENGTH + count] = x - column, y - row
                    rows[GREY * ROW_LENGTH + count] = image[y, x]
                    count += 1
                continue
            for x in range(first, last + 1, stride):
                du = x - corner[0]
                inside = _within(du, dv, s_u, s_v, t_u, t_v, reach, farthest) or (few and max(abs(du), abs(dv)) < 2.51)
                s, t = abs(s_u * du + s_v * dv), t_u * du + t_v * dv
                if inside and min(s, abs(t)) < plain[int(t > 0), int(s_u * du + s_v * dv > 0)]:
                    rows[U * ROW_LENGTH + count], rows[V * ROW_LENGTH + count] = x - column, y - row
                    rows[GREY * ROW_LENGTH + count] = image[y, x]
                    count += 1
        if few or near >= FEW_PIXELS:
            break
        few = True
    return count
