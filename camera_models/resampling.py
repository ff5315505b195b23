"""Resampling between cameras at one place: rectified views, tiles, panoramas, cube maps.

For every pixel of the output its bearing is turned into the source's frame and projected there:

    source pixel = source.project(source_from_output output.unproject(output pixel))

A grid of these pixels serves any number of photos of the source. Where the output is coarser than the source, the source is first
averaged over the area that a pixel of the output covers (a pyramid of areas of 2 x 2, linear between its levels).
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped

from camera_models._arrays import Array, as_tensor
from camera_models._model import CameraModel
from camera_models.errors import InputError

_PIXELS_PER_STRIP = 262_144
LARGEST_SIDE_PX = 32_766
"""Of images that cv2.remap takes."""
_FARTHEST_PX = 1e9
_COARSEST = 6
"""Level of the pyramid at which it ends: a pixel of the output covers 64 x 64 or more of the source there."""


@dataclass(frozen=True)
class SamplingGrid:
    """Where the pixels of an output image lie in a source image."""

    pixels: Float[np.ndarray, "h w 2"]
    """(u, v) in the source, single precision; (0, 0) where not valid."""
    valid: Bool[np.ndarray, "h w"]
    """Whether both cameras see the bearing, and the source within its image."""
    area: Float[np.ndarray, "h w"]
    """Pixels of the source that one of the output covers; 1 where not valid."""
    source_size: tuple[int, int]
    periodic: bool
    """Whether the source closes around: its last column is beside its first."""


def sampling_grid(
    output: CameraModel,
    source: CameraModel,
    source_from_output: Float[Array, "3 3"] | None = None,
    parallax: Float[Array, "3"] | None = None,
) -> SamplingGrid:
    """The source pixels of all output pixels; `source_from_output` turns bearings of the output camera, by default not at all.

    `parallax` is where the output camera stands in the source's frame, as a share of the distance of what both see: by default
    zero, which is true of the same place and of whatever is far away.
    Raises InputError where an image is too large for cv2.remap (32766 px a side).
    """
    for camera in (output, source):
        if max(camera.image_size) > LARGEST_SIDE_PX:
            raise InputError(
                f"Images of at most {LARGEST_SIDE_PX} px a side can be resampled, found {camera.image_size}; take a smaller one."
            )
    turn = torch.eye(3, dtype=torch.float64) if source_from_output is None else as_tensor(source_from_output)
    shift = torch.zeros(3, dtype=torch.float64) if parallax is None else as_tensor(parallax)
    width, height = output.image_size
    pixels = np.zeros((height, width, 2), dtype=np.float32)
    valid = np.zeros((height, width), dtype=bool)
    area = np.ones((height, width), dtype=np.float32)
    rows = max(1, _PIXELS_PER_STRIP // width)
    for top in range(0, height, rows):
        strip = slice(top, min(top + rows, height))
        pixels[strip], valid[strip], area[strip] = _strip(output, source, (turn, shift), strip)
    return SamplingGrid(pixels, valid, area, source.image_size, source.PERIODIC)


def _strip(
    output: CameraModel, source: CameraModel, motion: tuple[torch.Tensor, torch.Tensor], rows: slice
) -> tuple[Float[np.ndarray, "r w 2"], Bool[np.ndarray, "r w"], Float[np.ndarray, "r w"]]:
    """Some rows of a grid. A pixel more on every side tells the area that a pixel covers."""
    width, _ = output.image_size
    turn, shift = motion
    u, v = torch.arange(-1, width + 1, dtype=torch.float64), torch.arange(rows.start - 1, rows.stop + 1, dtype=torch.float64)
    with torch.no_grad():
        bearings, seen = output.unproject(torch.stack(torch.meshgrid(u, v, indexing="xy"), -1))
        found, imaged = source.project(bearings @ turn.mT + shift)
    # A model with wild coefficients may project anywhere: so far outside, it does not matter where.
    place = np.nan_to_num(found.numpy(), nan=_FARTHEST_PX).clip(-_FARTHEST_PX, _FARTHEST_PX)
    known = (seen & imaged).numpy()
    size = np.array(source.image_size)
    if source.PERIODIC:
        # A column may lie anywhere from its projection's own range: all that counts is where it is round the image.
        place[..., 0] = np.mod(place[..., 0] + 0.5, size[0]) - 0.5
    inside = known & ((place >= -0.5) & (place <= size - 0.5)).all(-1)
    right, down = place[1:-1, 2:] - place[1:-1, :-2], place[2:, 1:-1] - place[:-2, 1:-1]
    if source.PERIODIC:
        for step in (right, down):
            step[..., 0] -= size[0] * np.round(step[..., 0] / size[0])
    area = 0.25 * np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    around = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    inside = inside[1:-1, 1:-1]
    return np.where(inside[..., None], place[1:-1, 1:-1], 0.0), inside, np.where(inside & around, area, 1.0)


def resample(
    image: Shaped[np.ndarray, "h w *channels"], grid: SamplingGrid, area: bool = True, fill: int | float = 0
) -> Shaped[np.ndarray, "h1 w1 *channels"]:
    """The photo as the output camera sees it: bilinear, and with `area` averaged where its pixels are coarser.

    `fill` stands where the grid is not valid. cv2.remap places samples to 1/32 px for 8-bit images. Raises InputError where the
    photo has not the size of the source camera.
    """
    height, width = image.shape[:2]
    if (width, height) != grid.source_size:
        raise InputError(
            f"A photo of {grid.source_size[0]}x{grid.source_size[1]} px was expected, as the camera has, found {width}x{height}; "
            "give the photo that the calibration is of."
        )
    level = np.clip(0.5 * np.log2(np.maximum(grid.area, 1.0)), 0.0, _COARSEST) if area else np.zeros(grid.area.shape)
    levels = int(np.ceil(level.max(initial=0.0)))
    padded, shift = _padded(image, grid.periodic, levels)
    if not levels:
        sampled = _remap(padded, grid.pixels + shift)
    else:
        total = np.zeros((*grid.valid.shape, *image.shape[2:]), dtype=np.float32)
        padded = padded.astype(np.float32)  # rounded once, at the end
        for k in range(levels + 1):
            weight = np.maximum(1.0 - np.abs(level - k), 0.0).astype(np.float32)
            place = (grid.pixels + shift + np.float32(0.5)) / np.float32(2**k) - np.float32(0.5)
            total += weight.reshape(weight.shape + (1,) * (image.ndim - 2)) * _remap(padded, place)
            if k < levels:
                padded = cv2.resize(padded, (padded.shape[1] // 2, padded.shape[0] // 2), interpolation=cv2.INTER_AREA)
        exact = np.issubdtype(image.dtype, np.integer)
        sampled = (np.rint(total) if exact else total).astype(image.dtype)
    sampled[~grid.valid] = fill
    return sampled


def _padded(
    image: Shaped[np.ndarray, "h w *channels"], periodic: bool, levels: int
) -> tuple[Shaped[np.ndarray, "h1 w1 *channels"], Float[np.ndarray, "2"]]:
    """The image with sides that can be halved that often, continued round its seam where it closes; and its pixels' shift."""
    unit = 2**levels
    height, width = image.shape[:2]
    side = unit if periodic else 0
    right = -(width + side) % unit + side
    bottom = -height % unit
    shift = np.array([side, 0.0], dtype=np.float32)
    if periodic:
        image = np.concatenate([image[:, width - side :], image, image[:, :right]], 1)
        right = 0
    return (cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE) if right or bottom else image), shift


def _remap(
    image: Shaped[np.ndarray, "h w *channels"], place: Float[np.ndarray, "h1 w1 2"]
) -> Shaped[np.ndarray, "h1 w1 *channels"]:
    u, v = np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1])
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
