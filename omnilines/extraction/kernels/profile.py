"""Profiles of colour across arcs: where the edge lies on each, how far it goes, and the circle through all; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.tables import Edgels, Picture, Samples
from omnilines.extraction.options import SupportOptions

OFFSETS_PX = np.arange(-6, 7) * 0.5
"""Of a profile, across the arc."""
SIZE = len(OFFSETS_PX)
BLURS_PX = np.array([0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 1.9, 2.4])
"""Standard deviations of the blurred steps that a profile is compared with."""


_KEYS = np.array([[0.0, 1.0, 0.0, 0.0], [-0.5, 0.0, 0.5, 0.0], [1.0, -2.5, 2.0, -0.5], [-0.5, 1.5, -1.5, 0.5]], dtype=np.float32)
"""Powers of the share t of the way from the second of four pixels to the third: what each pixel is weighted with."""
_LANES = 16
"""Values of a row of pixels that are read at once: four pixels of up to four channels."""


def step_filters(taper_px: float) -> np.ndarray:
    """For each blur (b, 4, k), weights of a profile having a standard deviation of `taper_px`: the row that turns a profile of a
    unit step into its shift (px), and three rows whose inner products with a profile, squared, add up to what a level, a step and
    a shift explain of its weighted squares."""
    weight, filters = np.exp(-0.25 * (OFFSETS_PX / taper_px) ** 2), []
    for blur in BLURS_PX:
        step = np.array([0.5 * math.erf(x / (blur * math.sqrt(2.0))) for x in OFFSETS_PX])
        slope = np.exp(-0.5 * (OFFSETS_PX / blur) ** 2) / (blur * math.sqrt(2.0 * math.pi))
        design = np.stack([np.ones_like(step), step, -slope], -1) * weight[:, None]
        explained = np.linalg.qr(design)[0].T * weight
        filters.append(np.concatenate([(np.linalg.pinv(design)[2] * weight)[None], explained]))
    return np.stack(filters).astype(np.float32)


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def profiles(picture: Picture, pixel: np.ndarray, across: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels of 255 (m, c, k) at offsets across samples, bilinear, and whether all of them lie in the image (m)."""
    count = len(pixel)
    grey = np.empty((count, picture.image.shape[2], len(offsets)), dtype=np.float32)
    inside = np.ones(count, dtype=np.bool_)
    read_profiles(picture, pixel, across, offsets, grey, inside)
    return grey, inside


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def read_profiles(
    picture: Picture, pixel: np.ndarray, across: np.ndarray, offsets: np.ndarray, grey: np.ndarray, inside: np.ndarray
) -> None:
    """As `profiles`, into `grey` and `inside`."""
    image, unit, closed = picture
    height, width, channels = image.shape
    count, size = len(pixel), len(offsets)
    flat = image.reshape(-1)
    # The pixels above, their right neighbours, and the shares of these four and of those below: all 0 outside.
    first, right = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
    share = np.zeros((4, size), dtype=np.float32)
    down, over = np.uintp(width * channels), 1.0 / unit
    for n in range(count):
        inside[n] = True
        for k in range(size):
            u, v = pixel[n, 0] + offsets[k] * across[n, 0], pixel[n, 1] + offsets[k] * across[n, 1]
            if not (v >= 0.0 and v < height - 1 and (closed or (u >= 0.0 and u < width - 1))):
                inside[n] = False
                first[k], right[k] = 0, 0
                share[:, k] = 0.0
                continue
            j, i = math.floor(u), math.floor(v)
            s, t = u - j, v - i
            beside = j + 1
            if closed:
                j, beside = j % width, beside % width
            first[k], right[k] = (i * width + j) * channels, (i * width + beside) * channels
            above, below = (1.0 - t) * over, t * over
            share[0, k], share[1, k] = (1.0 - s) * above, s * above
            share[2, k], share[3, k] = (1.0 - s) * below, s * below
        for c in range(channels):
            for k in range(size):
                # Indices without a sign: no wrapping round has to be looked for.
                a, b = np.uintp(first[k] + c), np.uintp(right[k] + c)
                grey[n, c, k] = share[0, k] * flat[a] + share[1, k] * flat[b]
                grey[n, c, k] += share[2, k] * flat[a + down] + share[3, k] * flat[b + down]


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def supported(edgels: Edgels, pixel: np.ndarray, across: np.ndarray, options: SupportOptions) -> np.ndarray:
    """Whether an edge point with nearly the arc's direction lies beside each sample."""
    number, points, closed = edgels
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
            if edgel < 0 or abs(points[edgel, 2] * x + points[edgel, 3] * y) < options.min_cosine:
                continue
            du, dv = points[edgel, 0] - pixel[n, 0], points[edgel, 1] - pixel[n, 1]
            if closed:
                du -= width * round(du / width)
            if abs(du * x + dv * y) <= options.within_px:
                result[n] = True
                break
    return result


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def side_differences(grey: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Colour of the side of positive offsets minus that of the other (m, c), of profiles (m, c, k), with `side_weights` (k)."""
    count, channels = grey.shape[:2]
    result = np.empty((count, channels), dtype=np.float32)
    for n in range(count):
        for c in range(channels):
            total = np.float32(0.0)
            for k in range(SIZE):
                total += weight[k] * grey[n, c, k]
            result[n, c] = total
    return result


def side_weights() -> np.ndarray:
    """Of the values at OFFSETS_PX: from 0.75 to 2.5 px on either side."""
    beside = (np.abs(OFFSETS_PX) >= 0.75) & (np.abs(OFFSETS_PX) <= 2.5)
    return (np.sign(OFFSETS_PX) * beside / np.sum(beside & (OFFSETS_PX > 0))).astype(np.float32)


def along_weights(along_px: float) -> np.ndarray:
    """Of the average along an arc, a Gaussian of this standard deviation."""
    reach = int(2.5 * along_px)
    return np.exp(-0.5 * (np.arange(-reach, reach + 1) / along_px) ** 2).astype(np.float32)


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def smoothed(difference: np.ndarray, usable: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The differences (m, c) averaged along an arc over usable samples, with `along_weights`."""
    length, channels = difference.shape
    reach = len(weight) // 2
    result = np.empty_like(difference)
    # What is usable and its weight, one row each, with `reach` zeros to either side; and the sums.
    padded = np.zeros((channels + 1, length + 2 * reach), dtype=np.float32)
    sums, total = np.empty(length, dtype=np.float32), np.empty(length, dtype=np.float32)
    for n in range(length):
        if usable[n]:
            padded[channels, reach + n] = 1.0
            for c in range(channels):
                padded[c, reach + n] = difference[n, c]
    for row in range(channels, -1, -1):
        sums[:] = 0.0
        for m in range(len(weight)):
            for n in range(length):
                sums[n] += weight[m] * padded[row, n + m]
        if row == channels:
            for n in range(length):
                total[n] = np.float32(1.0) / (sums[n] + np.float32(1e-9))
        else:
            for n in range(length):
                result[n, row] = sums[n] * total[n]
    return result


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def projected(grey: np.ndarray, difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Profiles (m, c, k) times the difference (m, c) between their sides, summed over channels (m, k), and the squares of the
    differences (m): the former over the latter are unit steps."""
    count, channels = grey.shape[:2]
    step, strength = np.zeros((count, SIZE), dtype=np.float32), np.empty(count)
    for n in range(count):
        square = 1e-6
        for c in range(channels):
            share = difference[n, c]
            square += share * share
            for k in range(SIZE):
                step[n, k] += share * grey[n, c, k]
        strength[n] = square
    return step, strength


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def best_blur(step: np.ndarray, usable: np.ndarray, filters: np.ndarray) -> int:
    """Which of the `step_filters` explains the mean of what `projected` says of an arc best."""
    mean = np.zeros(SIZE, dtype=np.float32)
    for n in range(len(step)):
        if usable[n]:
            for k in range(SIZE):
                mean[k] += step[n, k]
    best, most = 0, -np.inf
    for b in range(len(filters)):
        explained = 0.0
        for m in range(1, filters.shape[1]):
            inner = 0.0
            for k in range(SIZE):
                inner += filters[b, m, k] * mean[k]
            explained += inner * inner
        if explained > most:
            best, most = b, explained
    return best


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def shifts(step: np.ndarray, strength: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Where the edge lies on each profile of an arc (m, px along `across`), of what `projected` says and a filter's row (k)."""
    shift = np.empty(len(step))
    for n in range(len(step)):
        total = np.float32(0.0)
        for k in range(SIZE):
            total += row[k] * step[n, k]
        shift[n] = total / strength[n]
    return shift


@njit(cache=True, nogil=True, error_model="numpy", **REORDERED)
@no_type_check
def mean_profiles(
    picture: Picture, at: Samples, starts: np.ndarray, wanted: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels of 255 (n, c, k) at offsets across samples, averaged over those from starts[n] to starts[n + 1]; and whether
    all of them are valid and lie in the image (n); what does not counts as 0. Those not `wanted` (n) are not read: 0 and false.

    By cubic convolution (R. Keys 1981): bilinear interpolation would blur by how far a point lies from the pixels' centres, and
    edges a pixel apart are told from each other by what blur is expected.
    """
    image, unit, closed = picture
    pixel, across, valid = at.pixel, at.across, at.valid
    height, width, channels = image.shape
    pieces, size, flat, row = len(starts) - 1, len(offsets), image.reshape(-1), width * channels
    grey, inside = np.zeros((pieces, channels, size), dtype=np.float32), np.ones(pieces, dtype=np.bool_)
    # Of each lane, value q * channels + c of a row, the weight is a cubic of the share of the way to the next pixel.
    cubic = _keys(channels)
    sums = np.empty((size, cubic.shape[1]), dtype=np.float32)
    last, down = len(flat) - 3 * row - _LANES if 4 * channels <= _LANES else -1, np.uintp(row)
    for piece in range(pieces):
        inside[piece] = wanted[piece]
        if not wanted[piece]:
            continue
        sums[:] = 0.0
        for n in range(starts[piece], starts[piece + 1]):
            inside[piece] = inside[piece] and valid[n]
            for k in range(size):
                u, v = pixel[n, 0] + offsets[k] * across[n, 0], pixel[n, 1] + offsets[k] * across[n, 1]
                if not (v >= 1.0 and v < height - 2 and (closed or (u >= 1.0 and u < width - 2))):
                    inside[piece] = False
                    continue
                j, i = math.floor(u), math.floor(v)
                s, t = np.float32(u - j), v - i
                w0, w1 = np.float32(t * (0.5 * t * (2.0 - t) - 0.5)), np.float32(t * t * (1.5 * t - 2.5) + 1.0)
                w2, w3 = np.float32(t * (t * (2.0 - 1.5 * t) + 0.5)), np.float32(0.5 * t * t * (t - 1.0))
                first = (i - 1) * row + (j - 1) * channels
                if j < 1 or j >= width - 2 or first > last:
                    _add_apart(image, i, j, s, (w0, w1, w2, w3), cubic, sums[k])
                    continue
                # Indices without a sign: no wrapping round has to be looked for.
                a = np.uintp(first)
                b, c, d = a + down, a + down + down, a + down + down + down
                for m in range(_LANES):
                    e = np.uintp(m)
                    value = w0 * flat[a + e] + w1 * flat[b + e] + w2 * flat[c + e] + w3 * flat[d + e]
                    sums[k, m] += value * (cubic[0, m] + s * (cubic[1, m] + s * (cubic[2, m] + s * cubic[3, m])))
        share = np.float32(1.0 / (unit * (starts[piece + 1] - starts[piece])))
        for k in range(size):
            for m in range(4 * channels):
                grey[piece, m % channels, k] += share * sums[k, m]
    return grey, inside


@njit(cache=True, nogil=True)
@no_type_check
def _keys(channels: int) -> np.ndarray:
    """Coefficients (4, lanes) of the cubics that weight four pixels in a row, value by value."""
    cubic = np.zeros((4, max(_LANES, 4 * channels)), dtype=np.float32)
    for m in range(4 * channels):
        cubic[:, m] = _KEYS[:, m // channels]
    return cubic


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _add_apart(image: np.ndarray, i: int, j: int, s: float, w: tuple, cubic: np.ndarray, total: np.ndarray) -> None:
    """Add the weighted pixels around a place to the lanes of `total` one by one: at a seam, and at the end of the image."""
    width, channels = image.shape[1:]
    for m in range(4 * channels):
        column, c = (j - 1 + m // channels) % width, m % channels
        value = w[0] * image[i - 1, column, c] + w[1] * image[i, column, c]
        value += w[2] * image[i + 1, column, c] + w[3] * image[i + 2, column, c]
        total[m] += value * (cubic[0, m] + s * (cubic[1, m] + s * (cubic[2, m] + s * cubic[3, m])))


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def piece_means(grey: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Profiles (m, c, k) averaged over those from starts[n] to starts[n + 1]."""
    mean = np.zeros((len(starts) - 1, *grey.shape[1:]))
    for piece in range(len(starts) - 1):
        share = 1.0 / (starts[piece + 1] - starts[piece])
        for n in range(starts[piece], starts[piece + 1]):
            for c in range(grey.shape[1]):
                for k in range(grey.shape[2]):
                    mean[piece, c, k] += share * grey[n, c, k]
    return mean
