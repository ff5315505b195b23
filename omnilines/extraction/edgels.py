"""Edge points (edgels) of a photo: where its colour changes most, to a fraction of a pixel, and their bearings.

The derivatives are those of the photo smoothed by a Gaussian. A colour photo is taken as it is, not made grey: an edge between
two colours of equal brightness counts like any other.
"""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, UInt

from camera_models import CameraModel
from omnilines.extraction.bearings import bearings_at
from omnilines.extraction.kernels.chain import chain_ends, cut_chains
from omnilines.extraction.kernels.edgel import gradient_products, ridge_points, second_differences, strengths
from omnilines.extraction.kernels.tables import Edgels, SeenChains
from omnilines.extraction.options import EdgeOptions

_BAND_ROWS = 256
_MARGIN = 3
_NOISE_ROWS = 64


def grey_unit(image: UInt[np.ndarray, "h w *channels"]) -> float:
    """Grey level of an image of 8 or 16 bits that stands for one of 255."""
    return 1.0 if image.dtype == np.uint8 else 257.0


def noise_level(image: UInt[np.ndarray, "h w *channels"], allowed: Bool[np.ndarray, "h w"]) -> float:
    """Standard deviation of the noise in a channel, in grey levels of 255: the median of what a mask blind to planes leaves
    (J. Immerkaer 1996, Fast noise variance estimation), in the first channel, over bands of rows spread over the image."""
    height, width = image.shape[:2]
    tops = np.unique(np.linspace(0, max(height - _NOISE_ROWS, 0), 8).astype(int))
    counts = np.zeros(16 * np.iinfo(image.dtype).max + 1, dtype=np.int64)
    second_differences(image.reshape(height, width, -1), allowed, tops, _NOISE_ROWS, counts)
    below = np.cumsum(counts)
    if below[-1] == 0:
        return 0.0
    middle = np.searchsorted(below, [(below[-1] + 1) // 2, below[-1] // 2 + 1])
    # The mask leaves noise six times as large as it is.
    return float(middle.mean()) / 6.0 / 0.6745 / grey_unit(image)


def _smoothing(smoothing_px: float) -> Float32[np.ndarray, " k"]:
    """Weights of a Gaussian out to four standard deviations."""
    return cv2.getGaussianKernel(2 * math.ceil(4.0 * smoothing_px) + 1, smoothing_px, cv2.CV_32F)[:, 0]


def derivative_sigma(smoothing_px: float) -> float:
    """Standard deviation of a derivative in white noise of 1."""
    weight = _smoothing(smoothing_px)
    impulse = np.zeros((2 * len(weight) + 3, 2 * len(weight) + 3, 1), dtype=np.uint8)
    impulse[len(weight) + 1, len(weight) + 1] = 1
    return float(np.sqrt(gradient_products(impulse, False, 0, len(impulse), weight)[0].sum(dtype=np.float64)))


def find_points(
    image: UInt[np.ndarray, "h w *channels"], closed: bool, allowed: Bool[np.ndarray, "h w"], noise: float, options: EdgeOptions
) -> tuple[Int32[np.ndarray, "n 2"], Float32[np.ndarray, "n 4"]]:
    """`cells` and `points` of the edge points at the pixels allowed, found in bands of rows one after another.

    `noise` is the standard deviation of the grey levels of 255; `closed`: the image goes on around its seam.
    """
    height, width = image.shape[:2]
    image = image.reshape(height, width, -1)
    threshold = max(options.min_slope_grey, options.min_sigmas * derivative_sigma(options.smoothing_px) * noise)
    weight = _smoothing(options.smoothing_px)
    # Of the image's own grey levels.
    unit = grey_unit(image)
    cells, points = [], []
    for top in range(0, height, _BAND_ROWS):
        low, high = max(top - _MARGIN, 0), min(top + _BAND_ROWS + _MARGIN, height)
        tensor = gradient_products(image, closed, low, high, weight)
        side = _MARGIN if closed else 0
        tensor = _around(tensor, side)
        strength = np.empty(tensor.shape[1:], dtype=np.float32)
        strengths(tensor, strength)
        last = min(_BAND_ROWS, height - top) + top - low
        cell, point = ridge_points(
            strength, tensor, _around(allowed[low:high], side), threshold * unit, first=top - low, last=last
        )
        cell += np.array([low, -side], dtype=np.int32)
        point[:, :2] += np.array([-side, low], dtype=np.float32)
        if closed:
            own = (cell[:, 1] >= 0) & (cell[:, 1] < width)
            cell, point = cell[own], point[own]
        cells.append(cell)
        points.append(point)
    return np.concatenate(cells), np.concatenate(points)


def _around(rows: np.ndarray, side: int) -> np.ndarray:
    return np.concatenate([rows[..., -side:], rows, rows[..., :side]], -1) if side else rows


def numbered(size: tuple[int, int], closed: bool, cells: Int32[np.ndarray, "n 2"], points: Float32[np.ndarray, "n 4"]) -> Edgels:
    """Edge points in an image of this width and height."""
    number = np.full(size[::-1], -1, dtype=np.int32)
    number[cells[:, 0], cells[:, 1]] = np.arange(len(cells), dtype=np.int32)
    return Edgels(number, points, closed)


def seen_chains(
    model: CameraModel,
    points: Float32[np.ndarray, "n 4"],
    order: Int32[np.ndarray, " n"],
    starts: Int[np.ndarray, " k1"],
    least: int,
) -> SeenChains:
    """Bearings of the edge points of chains of `least` or more; `order` has the points chain by chain, from `starts` on. Where
    the camera does not see a point, its chain is cut."""
    places, chain = chain_ends(points, order, starts, least)
    bearings, seen = bearings_at(model, places.reshape(-1, 2))
    return SeenChains(*cut_chains(bearings.reshape(-1, 2, 3), seen.reshape(-1, 2), chain))
