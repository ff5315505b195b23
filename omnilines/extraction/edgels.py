"""Edge points (edgels) of a photo: where its colour changes most, to a fraction of a pixel, and their bearings.

The derivatives are those of the photo smoothed by a Gaussian. A colour photo is taken as it is, not made grey: an edge between
two colours of equal brightness counts like any other.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, UInt

from camera_models import CameraModel
from omnilines.extraction.edgel_kernel import colour_gradient, ridge_points

SMOOTHING_PX = 0.6
"""Standard deviation of the Gaussian before differences are taken."""
LEAST_SIGMAS = 4.0
"""Strength of an edge point over the standard deviation of a derivative in the noise."""
LEAST_STRENGTH = 1.2
"""Grey levels (of 255) per pixel: a step of 4 in a sharp photo."""
_BAND_ROWS = 256
_MARGIN = 8
_NOISE_ROWS = 64
_POINTS = 400_000
"""Bearings worked out at a time."""


@dataclass(frozen=True)
class Edgels:
    """Edge points, row by row."""

    number: Int32[np.ndarray, "h w"]
    """Index of the edge point of each pixel, or -1."""
    cells: Int32[np.ndarray, "n 2"]
    """Row and column of the pixel of each."""
    points: Float32[np.ndarray, "n 4"]
    """(u, v) and the unit direction across the edge, either of two."""
    bearings: Float[np.ndarray, "n 3"]
    acrosses: Float[np.ndarray, "n 3"]
    """Change of the bearing with a pixel along the direction across the edge."""

    def __len__(self) -> int:
        return len(self.cells)

    def keep(self, rows: Bool[np.ndarray, " n"]) -> "Edgels":
        """Some of the edge points."""
        size = (self.number.shape[1], self.number.shape[0])
        return _numbered(size, self.cells[rows], self.points[rows], self.bearings[rows], self.acrosses[rows])


def grey_unit(image: UInt[np.ndarray, "h w *channels"]) -> float:
    """Grey level of an image of 8 or 16 bits that stands for one of 255."""
    return 1.0 if image.dtype == np.uint8 else 257.0


def noise_level(image: UInt[np.ndarray, "h w *channels"], allowed: Bool[np.ndarray, "h w"]) -> float:
    """Standard deviation of the noise in a channel, in grey levels of 255: the median of what a mask blind to planes leaves
    (J. Immerkaer 1996, Fast noise variance estimation), over bands of rows spread over the image."""
    height = image.shape[0]
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
    kept = []
    for top in np.unique(np.linspace(0, max(height - _NOISE_ROWS, 0), 8).astype(int)):
        band = slice(int(top), int(top) + _NOISE_ROWS)
        left = np.abs(cv2.filter2D(image[band].astype(np.float32), -1, kernel))
        kept.append(left[allowed[band]].ravel()[::3])
    values = np.concatenate(kept)
    return float(np.median(values)) / 0.6745 / grey_unit(image) if len(values) else 0.0


def _derivatives(band: Float32[np.ndarray, "h w c"]) -> tuple[Float32[np.ndarray, "h w c"], Float32[np.ndarray, "h w c"]]:
    """Along u and v, per pixel (Scharr's masks on the smoothed image)."""
    smooth = cv2.GaussianBlur(band, (0, 0), SMOOTHING_PX, borderType=cv2.BORDER_REFLECT_101)
    by = [cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1))]
    return by[0].reshape(band.shape), by[1].reshape(band.shape)


def derivative_sigma() -> float:
    """Standard deviation of a derivative in white noise of 1."""
    impulse = np.zeros((21, 21, 1), dtype=np.float32)
    impulse[10, 10] = 1.0
    return float(np.sqrt(np.square(_derivatives(impulse)[0].astype(np.float64)).sum()))


def find_edgels(image: UInt[np.ndarray, "h w *channels"], model: CameraModel, allowed: Bool[np.ndarray, "h w"]) -> Edgels:
    """The edge points of the pixels allowed that the camera model sees, found in bands of rows one after another.

    Where the model is PERIODIC the image goes on around its seam.
    """
    height, width = image.shape[:2]
    unit = grey_unit(image)
    threshold = max(LEAST_STRENGTH, LEAST_SIGMAS * derivative_sigma() * noise_level(image, allowed))
    side = _MARGIN if model.PERIODIC else 0
    cells, points = [], []
    for top in range(0, height, _BAND_ROWS):
        low, high = max(top - _MARGIN, 0), min(top + _BAND_ROWS + _MARGIN, height)
        band = _around(image[low:high], side).astype(np.float32) / np.float32(unit)
        by_u, by_v = _derivatives(band.reshape(*band.shape[:2], -1))
        strength, direction = np.empty(band.shape[:2], np.float32), np.empty((*band.shape[:2], 2), np.float32)
        colour_gradient(by_u, by_v, strength, direction)
        last = min(_BAND_ROWS, height - top) + top - low
        cell, point = ridge_points(strength, direction, _around(allowed[low:high], side), threshold, top - low, last)
        cell += np.array([low, -side], dtype=np.int32)
        point[:, :2] += np.array([-side, low], dtype=np.float32)
        own = (cell[:, 1] >= 0) & (cell[:, 1] < width)
        cells.append(cell[own])
        points.append(point[own])
    return _seen(model, np.concatenate(cells), np.concatenate(points))


def _around(rows: np.ndarray, side: int) -> np.ndarray:
    return np.concatenate([rows[:, -side:], rows, rows[:, :side]], 1) if side else rows


def _seen(model: CameraModel, cells: Int32[np.ndarray, "n 2"], points: Float32[np.ndarray, "n 4"]) -> Edgels:
    bearings, acrosses = np.empty((len(cells), 3)), np.empty((len(cells), 3))
    seen = np.zeros(len(cells), dtype=bool)
    for start in range(0, len(cells), _POINTS):
        part = slice(start, start + _POINTS)
        place, across = points[part, :2].astype(np.float64), points[part, 2:].astype(np.float64)
        with torch.no_grad():
            rays, valid = model.unproject(np.stack([place - 0.5 * across, place + 0.5 * across]))
        middle = rays.sum(0)
        bearings[part] = middle / np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-12)
        acrosses[part] = rays[1] - rays[0]
        seen[part] = valid.all(0) & (np.linalg.norm(acrosses[part], axis=-1) > 0)
    return _numbered(model.image_size, cells[seen], points[seen], bearings[seen], acrosses[seen])


def _numbered(
    size: tuple[int, int],
    cells: Int32[np.ndarray, "n 2"],
    points: Float32[np.ndarray, "n 4"],
    bearings: Float[np.ndarray, "n 3"],
    acrosses: Float[np.ndarray, "n 3"],
) -> Edgels:
    number = np.full(size[::-1], -1, dtype=np.int32)
    number[cells[:, 0], cells[:, 1]] = np.arange(len(cells), dtype=np.int32)
    return Edgels(number, cells, points, bearings, acrosses)
