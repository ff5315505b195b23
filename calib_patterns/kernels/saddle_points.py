"""The pixel loops of saddle_points.py, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

SAMPLES = 32
"""Places on the circle around a saddle point."""
FIELDS = 14
"""u, v, (uu, uv, vv) over its norm, four pairs of unit directions, response."""
_MOST_STEP_PX = 1.5
_ANGLES = 2.0 * math.pi / SAMPLES * np.arange(SAMPLES)
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz", "arcp"})
@no_type_check
def responses(smooth: np.ndarray, factor: float) -> np.ndarray:
    """-det H times `factor`, H from Sobel's kernels over 4; 0 along the border."""
    height, width = smooth.shape
    found = np.zeros((height, width), np.float32)
    scale = np.float32(factor)
    two, quarter = np.float32(2.0), np.float32(0.25)
    for y in range(1, height - 1):
        a, b, c, out = smooth[y - 1], smooth[y], smooth[y + 1], found[y]
        for x in range(1, width - 1):
            left, middle, right = a[x - 1] + c[x - 1], a[x] + c[x], a[x + 1] + c[x + 1]
            uu = quarter * (left - two * middle + right) + np.float32(0.5) * (b[x - 1] - two * b[x] + b[x + 1])
            vv = quarter * (left + two * middle + right) - np.float32(0.5) * (b[x - 1] + two * b[x] + b[x + 1])
            uv = quarter * (a[x - 1] - a[x + 1] - c[x - 1] + c[x + 1])
            out[x] = scale * (uv * uv - uu * vv)
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _circle(smooth: np.ndarray, u: float, v: float, radius_px: float, level: np.ndarray) -> bool:
    """Levels on a circle, less their middle; whether they change sign just four times."""
    height, width = smooth.shape
    low, high = np.inf, -np.inf
    for k in range(SAMPLES):
        x = min(max(u + radius_px * _COS[k], 0.0), width - 1.001)
        y = min(max(v + radius_px * _SIN[k], 0.0), height - 1.001)
        column, row = int(x), int(y)
        s, t = x - column, y - row
        upper = (1.0 - s) * smooth[row, column] + s * smooth[row, column + 1]
        lower = (1.0 - s) * smooth[row + 1, column] + s * smooth[row + 1, column + 1]
        level[k] = (1.0 - t) * upper + t * lower
        low, high = min(low, level[k]), max(high, level[k])
    changes = 0
    for k in range(SAMPLES):
        level[k] -= 0.5 * (low + high)
        changes += k > 0 and (level[k] < 0) != (level[k - 1] < 0)
    return changes + ((level[0] < 0) != (level[SAMPLES - 1] < 0)) == 4


@njit(cache=True, nogil=True)
@no_type_check
def crossings(smooth: np.ndarray, response: np.ndarray, places: np.ndarray, radius_px: float) -> np.ndarray:
    """The saddle points among some peaks of the response: rows of FIELDS values.

    The peaks, moved by one Newton step to where the gradient is zero, around which a circle of `radius_px` meets its mean level
    in just four directions.
    """
    level, found, count = np.empty(SAMPLES), np.empty((len(places), FIELDS)), 0
    for y, x in places:
        a, b, c = smooth[y - 1], smooth[y], smooth[y + 1]
        left, middle, right = a[x - 1] + c[x - 1], a[x] + c[x], a[x + 1] + c[x + 1]
        uu = 0.25 * (left - 2.0 * middle + right) + 0.5 * (b[x - 1] - 2.0 * b[x] + b[x + 1])
        vv = 0.25 * (left + 2.0 * middle + right) - 0.5 * (b[x - 1] + 2.0 * b[x] + b[x + 1])
        uv = 0.25 * (a[x - 1] - a[x + 1] - c[x - 1] + c[x + 1])
        slope_u, slope_v, determinant = 0.5 * (b[x + 1] - b[x - 1]), 0.5 * (c[x] - a[x]), uu * vv - uv * uv
        step_u, step_v = (uv * slope_v - vv * slope_u) / determinant, (uv * slope_u - uu * slope_v) / determinant
        near = max(abs(step_u), abs(step_v)) < _MOST_STEP_PX
        if not near or not _circle(smooth, x + step_u, y + step_v, radius_px, level):
            continue
        row, norm = found[count], math.sqrt(uu * uu + 2.0 * uv * uv + vv * vv)
        row[0], row[1], row[2], row[3], row[4] = x + step_u, y + step_v, uu / norm, uv / norm, vv / norm
        arm = 0
        for k in range(SAMPLES):
            here, following = level[k], level[(k + 1) % SAMPLES]
            if (here < 0) != (following < 0):
                angle = 2.0 * math.pi / SAMPLES * (k + here / (here - following))
                row[5 + 2 * arm], row[6 + 2 * arm] = math.cos(angle), math.sin(angle)
                arm += 1
        row[13] = response[y, x]
        count += 1
    return found[:count]


@njit(cache=True, nogil=True)
@no_type_check
def nearest_along(
    pixels: np.ndarray, hessian: np.ndarray, edges: np.ndarray, neighbours: np.ndarray, opposite: float, cone: float
) -> np.ndarray:
    """The nearest point along each of the four directions of n points (n x 4), -1 where there is none.

    `neighbours` (n x k) are the points that are tried, the nearest first: those whose Hessians (uu, uv, vv) have a cosine below
    `opposite`, in directions whose cosine with the edge (`edges`, n x 4 x 2) is above `cone`.
    """
    found = np.full((len(pixels), 4), -1, np.int64)
    for i in range(len(pixels)):
        missing = 4
        for j in neighbours[i]:
            alike = hessian[i, 0] * hessian[j, 0] + 2.0 * hessian[i, 1] * hessian[j, 1] + hessian[i, 2] * hessian[j, 2]
            if alike >= opposite:
                continue
            du, dv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            along = cone * max(math.sqrt(du * du + dv * dv), 1e-9)
            for d in range(4):
                if found[i, d] < 0 and du * edges[i, d, 0] + dv * edges[i, d, 1] > along:
                    found[i, d] = j
                    missing -= 1
            if missing == 0:
                break
    return found
