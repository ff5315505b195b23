"""Profiles of colour across arcs: where the edge lies on each, how far it goes, and the circle through all; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

REORDERED = {"reassoc", "contract", "arcp", "nsz"}
"""What the compiler may do to sums, so that it can use vector instructions; NaN and infinity keep their meaning."""
OFFSETS_PX = np.arange(-6, 7) * 0.5
"""Of a profile, across the arc."""
TAPER_PX, WIDE_TAPER_PX = 1.0, 1.8
"""Standard deviations of the weights of a profile."""
BLURS_PX = np.array([0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 1.9, 2.4])
"""Standard deviations of the blurred steps that a profile is compared with."""
ALONG_PX = 3.0
"""Standard deviation of the average along an arc of the difference between its sides."""


def step_filters(taper_px: float) -> tuple[np.ndarray, np.ndarray]:
    """For each blur: the row (b, k) that turns a profile of a unit step into its shift (px) and the matrix (b, k, k) to what a
    level, a step and a shift cannot explain, weighted."""
    weight = np.exp(-0.25 * (OFFSETS_PX / taper_px) ** 2)
    rows, left = [], []
    for blur in BLURS_PX:
        step = np.array([0.5 * math.erf(x / (blur * math.sqrt(2.0))) for x in OFFSETS_PX])
        slope = np.exp(-0.5 * (OFFSETS_PX / blur) ** 2) / (blur * math.sqrt(2.0 * math.pi))
        design = np.stack([np.ones_like(step), step, -slope], -1) * weight[:, None]
        inverse = np.linalg.pinv(design)
        rows.append(inverse[2] * weight)
        left.append((np.eye(len(weight)) - design @ inverse) * weight)
    return np.stack(rows), np.stack(left)


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def profiles(
    image: np.ndarray, unit: float, pixel: np.ndarray, across: np.ndarray, offsets: np.ndarray, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels of 255 (m, k, c) at offsets across samples, bilinear, and whether all of them lie in the image (m)."""
    height, width, channels = image.shape
    count, size = len(pixel), len(offsets)
    grey, inside = np.zeros((count, size, channels), dtype=np.float32), np.ones(count, dtype=np.bool_)
    for n in range(count):
        for k in range(size):
            u, v = pixel[n, 0] + offsets[k] * across[n, 0], pixel[n, 1] + offsets[k] * across[n, 1]
            if not (v >= 0.0 and v < height - 1 and (closed or (u >= 0.0 and u < width - 1))):
                inside[n] = False
                continue
            j, i = math.floor(u), math.floor(v)
            s, t = u - j, v - i
            right = j + 1
            if closed:
                j, right = j % width, right % width
            for c in range(channels):
                above = (1.0 - s) * image[i, j, c] + s * image[i, right, c]
                below = (1.0 - s) * image[i + 1, j, c] + s * image[i + 1, right, c]
                grey[n, k, c] = ((1.0 - t) * above + t * below) / unit
    return grey, inside


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def supported(
    number: np.ndarray,
    points: np.ndarray,
    pixel: np.ndarray,
    across: np.ndarray,
    within_px: float,
    least_cosine: float,
    closed: bool,
) -> np.ndarray:
    """Whether an edge point with nearly the arc's direction lies beside each sample."""
    height, width = number.shape
    result = np.zeros(len(pixel), dtype=np.bool_)
    for n in range(len(pixel)):
        x, y = across[n, 0], across[n, 1]
        for k in range(5):
            offset = 0.5 * ((k + 1) // 2) * (1 - 2 * (k % 2))
            j, i = round(pixel[n, 0] + offset * x), round(pixel[n, 1] + offset * y)
            if closed:
                j = j % width
            if i < 0 or i >= height or j < 0 or j >= width:
                continue
            edgel = number[i, j]
            if edgel < 0 or abs(points[edgel, 2] * x + points[edgel, 3] * y) < least_cosine:
                continue
            du, dv = points[edgel, 0] - pixel[n, 0], points[edgel, 1] - pixel[n, 1]
            if closed:
                du -= width * round(du / width)
            if abs(du * x + dv * y) <= within_px:
                result[n] = True
                break
    return result


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def side_differences(grey: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Colour of the side of positive offsets minus that of the other (m, c), from 0.75 to 2.5 px."""
    count, size, channels = grey.shape
    result = np.zeros((count, channels), dtype=np.float32)
    used = 0
    for k in range(size):
        if 0.75 <= offsets[k] <= 2.5:
            used += 1
    for n in range(count):
        for k in range(size):
            if 0.75 <= abs(offsets[k]) <= 2.5:
                sign = 1.0 if offsets[k] > 0 else -1.0
                for c in range(channels):
                    result[n, c] += sign * grey[n, k, c] / used
    return result


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def smoothed(difference: np.ndarray, usable: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The differences averaged along each arc over usable samples (Gaussian of ALONG_PX)."""
    reach = int(2.5 * ALONG_PX)
    weight = np.exp(-0.5 * (np.arange(reach + 1) / ALONG_PX) ** 2)
    channels = difference.shape[1]
    result = np.zeros_like(difference)
    for arc in range(len(starts) - 1):
        for n in range(starts[arc], starts[arc + 1]):
            total = 1e-9
            for m in range(max(n - reach, starts[arc]), min(n + reach + 1, starts[arc + 1])):
                if usable[m]:
                    w = weight[abs(m - n)]
                    total += w
                    for c in range(channels):
                        result[n, c] += w * difference[m, c]
            for c in range(channels):
                result[n, c] /= total
    return result


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def shifts(
    grey: np.ndarray, difference: np.ndarray, usable: np.ndarray, starts: np.ndarray, rows: np.ndarray, left: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the edge lies on each profile (m, px along `across`), the square of its contrast (m), and the blur of each arc.

    Each profile is projected on the difference between its sides and divided by it, so that it is a unit step; the blur that
    explains the mean profile of the arc best decides how a shift is read from one.
    """
    count, size, channels = grey.shape
    shift, strength = np.zeros(count), np.zeros(count)
    blur = np.zeros(len(starts) - 1)
    step = np.empty((count, size))
    mean = np.empty(size)
    for arc in range(len(starts) - 1):
        mean[:] = 0.0
        total = 0.0
        for n in range(starts[arc], starts[arc + 1]):
            square = 1e-6
            for c in range(channels):
                square += difference[n, c] * difference[n, c]
            strength[n] = square
            for k in range(size):
                value = 0.0
                for c in range(channels):
                    value += grey[n, k, c] * difference[n, c]
                step[n, k] = value / square
            if usable[n]:
                total += square
                for k in range(size):
                    mean[k] += square * step[n, k]
        if total == 0.0:
            continue
        best, least = 0, np.inf
        for b in range(len(rows)):
            misfit = 0.0
            for k in range(size):
                value = 0.0
                for m in range(size):
                    value += left[b, k, m] * mean[m]
                misfit += value * value
            if misfit < least:
                best, least = b, misfit
        blur[arc] = best
        for n in range(starts[arc], starts[arc + 1]):
            for k in range(size):
                shift[n] += rows[best, k] * step[n, k]
    return shift, strength, blur


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def sharp_profiles(
    image: np.ndarray, unit: float, pixel: np.ndarray, across: np.ndarray, offsets: np.ndarray, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """As `profiles`, by cubic convolution (R. Keys 1981): bilinear interpolation would blur by how far a point lies from the
    pixels' centres, and edges a pixel apart are told from each other by what blur is expected."""
    height, width, channels = image.shape
    count, size = len(pixel), len(offsets)
    grey, inside = np.zeros((count, size, channels), dtype=np.float32), np.ones(count, dtype=np.bool_)
    wu, wv, columns = np.empty(4), np.empty(4), np.empty(4, dtype=np.int64)
    for n in range(count):
        for k in range(size):
            u, v = pixel[n, 0] + offsets[k] * across[n, 0], pixel[n, 1] + offsets[k] * across[n, 1]
            if not (v >= 1.0 and v < height - 2 and (closed or (u >= 1.0 and u < width - 2))):
                inside[n] = False
                continue
            j, i = math.floor(u), math.floor(v)
            _keys(u - j, wu)
            _keys(v - i, wv)
            for q in range(4):
                columns[q] = (j - 1 + q) % width if closed else j - 1 + q
            for c in range(channels):
                total = 0.0
                for p in range(4):
                    row = 0.0
                    for q in range(4):
                        row += wu[q] * image[i - 1 + p, columns[q], c]
                    total += wv[p] * row
                grey[n, k, c] = total / unit
    return grey, inside


@njit(cache=True, nogil=True, fastmath=REORDERED)
@no_type_check
def _keys(t: float, weight: np.ndarray) -> None:
    """Weights of four neighbours at -1, 0, 1, 2 for a place t in [0, 1)."""
    s = 1.0 - t
    weight[0] = -0.5 * t * s * s
    weight[3] = -0.5 * s * t * t
    weight[1] = s * (1.0 + t - 1.5 * t * t)
    weight[2] = t * (1.0 + s - 1.5 * s * s)
