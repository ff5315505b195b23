"""The rays of a camera's pixels, from those of the pixel corners, and cones around tiles of them."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calib_patterns.rendering import pixel_grid
from camera_models import CameraModel
from omnilines.scenes.viewpoint import Cones

_TILES_ACROSS = 300
"""Tiles along the longer side of an image that are enough for most of them to show few faces; they are 1, 2 or 4 px."""


@dataclass(frozen=True)
class PixelRays:
    """Unit rays (camera frame) of the (h + 1) x (w + 1) corners of all pixels, and which pixels see anything.

    A pixel sees when all its corners have a bearing within the image circle. Inside a pixel the ray is taken as bilinear in the
    position: the error, second order in one over the focal length in pixels, is below a thousandth of a pixel.
    """

    corners: Float[np.ndarray, "h1 w1 3"]
    seen: Bool[np.ndarray, "h w"]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image."""
        return self.seen.shape

    def of_pixels(
        self, row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Ray at the centre of pixels, and its change per pixel to the right and down."""
        a, b = self.corners[row, column], self.corners[row, column + 1]
        c, d = self.corners[row + 1, column], self.corners[row + 1, column + 1]
        return 0.25 * (a + b + c + d), 0.5 * (b - a + d - c), 0.5 * (c - a + d - b)


def pixel_rays(model: CameraModel, largest_angle_rad: float) -> PixelRays:
    """Rays of a camera whose image circle ends at that angle from the bearing of its centre pixel."""
    width, height = model.image_size
    corners = pixel_grid(range(height + 1), width + 1) - 0.5
    with torch.no_grad():
        rays, valid = model.unproject(corners)
        axis, _ = model.unproject(model.centre_px.detach().numpy())
    # The distance of two unit vectors an angle apart is 2 sin(angle / 2), which is monotone up to pi.
    near = np.linalg.norm(rays - axis, axis=-1) <= 2.0 * np.sin(0.5 * min(largest_angle_rad, np.pi)) + 1e-12
    return PixelRays(rays, _all_corners(valid & near))


def _all_corners(flags: Bool[np.ndarray, "h1 w1"]) -> Bool[np.ndarray, "h w"]:
    return flags[:-1, :-1] & flags[:-1, 1:] & flags[1:, :-1] & flags[1:, 1:]


def tile_sides(image_size: tuple[int, int]) -> tuple[int, ...]:
    """Sides of the tiles in pixels, each of which is cut into the next; of the last the visible faces are listed."""
    finest = min(4, 2 ** max(0, int(math.log2(max(image_size) / _TILES_ACROSS))))
    return 16 * finest, 4 * finest, finest


def tile_grid(shape: tuple[int, int], side: int) -> tuple[int, int]:
    """Rows and columns of tiles of `side` pixels that cover an image of (height, width)."""
    return -(-shape[0] // side), -(-shape[1] // side)


def tile_cones(rays: PixelRays, side: int) -> tuple[Cones, Bool[np.ndarray, " n"]]:
    """The cone around the rays of each tile, row by row, and whether any pixel of it sees."""
    rows, columns = tile_grid(rays.shape, side)
    # A corner counts where a pixel beside it sees.
    used = cv2.copyMakeBorder(rays.seen.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT).astype(bool)
    used = used[:-1, :-1] | used[:-1, 1:] | used[1:, :-1] | used[1:, 1:]
    # Tiles share their border corners: (side + 1) corners a side, the last ones repeated where the image ends.
    i = np.minimum(np.arange(rows)[:, None] * side + np.arange(side + 1), rays.shape[0])
    j = np.minimum(np.arange(columns)[:, None] * side + np.arange(side + 1), rays.shape[1])
    place = (i[:, None, :, None], j[None, :, None, :])
    corner = rays.corners[place].reshape(rows * columns, -1, 3)
    counts = used[place].reshape(rows * columns, -1)
    axis = (corner * counts[..., None]).sum(1)
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = np.where(length > 1e-9, axis / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    chord = np.where(counts, np.linalg.norm(corner - axis[:, None], axis=-1), 0.0).max(-1)
    # Bilinear rays between the corners lie a little off the cone of these.
    half = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)) * 1.05
    seen = np.zeros((rows * side, columns * side), dtype=bool)
    seen[: rays.shape[0], : rays.shape[1]] = rays.seen
    any_seen = seen.reshape(rows, side, columns, side).any((1, 3)).ravel()
    return Cones(axis, np.sin(np.minimum(half, 0.5 * np.pi))), any_seen
