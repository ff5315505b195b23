"""The pictures of the page: what the camera sees with the corners and the next pose over it, and what is known of it."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt, UInt8

from omnilines.guide.session import Known, Session
from omnilines.pages.board_curves import grid_curves_px
from omnilines.pages.uncertainty_map import UncertaintyMap
from omnilines.photo_file import eight_bits, jpeg_of

WIDEST_PX = 960
"""Of a picture on the page."""
QUALITY = 80
FOUND, NEXT, EARLIER = (80, 220, 60), (20, 140, 255), (60, 40, 30)
"""Colours (blue, green, red) of corners in the frame, of the next pose, and of corners in the frames that are kept."""
WELL, BADLY, UNSEEN = (196, 240, 253), (60, 85, 217), (60, 60, 60)
"""Where the projection is known well, where badly, and where the camera sees nothing."""
_SUBPIXEL_BITS = 4
_CIRCLE = 3
_WORST_FACTOR = 8.0
"""Uncertainties of this many times the median, or more, have the last colour."""


def live_picture(session: Session) -> bytes:
    """JPEG of the last frame; grey before the first."""
    frame, known = session.last, session.known
    if frame is None:
        return jpeg_of(np.full((270, 480, 3), UNSEEN, dtype=np.uint8), QUALITY)
    picture, scale = _shown(frame.pixels)
    if known is not None:
        _draw_board(picture, known, scale)
    _dots(picture, frame.found.pixels, scale, FOUND, _CIRCLE)
    return jpeg_of(picture, QUALITY)


def map_picture(session: Session) -> bytes:
    """JPEG of the projection uncertainty over the image, the corners that are kept, and the next pose."""
    known, kept = session.known, list(session.kept)
    if not kept:
        return jpeg_of(np.full((270, 480, 3), UNSEEN, dtype=np.uint8), QUALITY)
    height, width = kept[0].pixels.shape[:2]
    scale = min(1.0, WIDEST_PX / width)
    size = (round(scale * width), round(scale * height))
    picture = np.full((size[1], size[0], 3), UNSEEN, dtype=np.uint8)
    if known is not None:
        sigma = UncertaintyMap.of(known.result.fit).sigma_px
        share = np.log(np.maximum(sigma / known.advice.median_px, 1e-9)) / np.log(_WORST_FACTOR)
        bad = np.clip(0.5 + 0.5 * np.nan_to_num(share, nan=1.0), 0, 1).astype(np.float32)
        bad = cv2.resize(bad, size, interpolation=cv2.INTER_LINEAR)[..., None]
        picture = ((1 - bad) * np.array(WELL) + bad * np.array(BADLY)).astype(np.uint8)
        v, u = np.mgrid[: size[1], : size[0]]
        seen = known.projection.field.shows(torch.as_tensor(np.stack([u, v], -1) / scale))
        picture[~seen.numpy()] = UNSEEN
    for frame in kept:
        _dots(picture, frame.found.pixels, scale, EARLIER, 2)
    if known is not None:
        _draw_board(picture, known, scale)
    return jpeg_of(picture, QUALITY)


def _shown(pixels: UInt[np.ndarray, "h w *channels"]) -> tuple[UInt8[np.ndarray, "a b 3"], float]:
    """A picture in colour that is not too wide, and its scale."""
    eight = eight_bits(pixels)
    scale = min(1.0, WIDEST_PX / pixels.shape[1])
    small = cv2.resize(eight, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else eight.copy()
    return (cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small), scale


def _draw_board(picture: UInt8[np.ndarray, "h w 3"], known: Known, scale: float) -> None:
    if known.advice.poses:
        model = known.result.camera
        curves = grid_curves_px(model, known.advice.poses[0].cam_from_board, known.advice.board_m)
        parts = [curve[np.isfinite(curve).all(-1)] for curve in curves]
        _lines(picture, [part for part in parts if len(part) > 1], scale)


def _lines(picture: UInt8[np.ndarray, "h w 3"], curves: Sequence[Float[np.ndarray, "k 2"]], scale: float) -> None:
    points = [_fixed(curve, scale)[:, None] for curve in curves]
    cv2.polylines(picture, points, False, NEXT, 2, cv2.LINE_AA, _SUBPIXEL_BITS)


def _dots(
    picture: UInt8[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "n 2"], scale: float, colour: tuple[int, int, int], radius: int
) -> None:
    for u, v in _fixed(pixels, scale).tolist():
        cv2.circle(picture, (u, v), radius << _SUBPIXEL_BITS, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed(pixels: Float[np.ndarray, "n 2"], scale: float) -> np.ndarray:
    """Pixels of the photo in the picture, as OpenCV draws parts of a pixel."""
    return np.rint(((pixels + 0.5) * scale - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)
