"""The pixels of one photo file, as everything that looks at photos sees them; pictures as JPEG."""

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Shaped, UInt, UInt8

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes
from camera_models.typed import typed
from omnilines.machine import available_bytes
from omnilines.photo_size import (
    MOST_TAG_BYTES,
    in_planes,
    is_tiff,
    is_webp,
    may_be_transparent,
    orientation_at_end,
    orientation_may_follow,
    orientation_of_photo,
    place_of_tags,
    size_of_photo,
    with_tags_before,
)

MOST_PIXELS = 1 << 29
"""Of a photo: a panorama of 32766 x 16383, the widest that `rectify` takes. Larger ones in a few bytes are made to harm."""

_HEADER_BYTES = 1 << 18
"""Of a photo, that mostly hold all before its pixels."""
_TAIL_BYTES = 1 << 16
"""Of a PNG, in which an orientation behind the pixels stands."""
LONGEST_JPEG_PX = 65_500
"""A side of what libjpeg writes."""


@typed
def read_photo(path: str | Path) -> UInt[np.ndarray, "h w *channels"]:
    """The pixels of a photo: (h, w) grey or (h, w, 3) BGR, 8 or 16 bits, turned upright as its EXIF orientation says.

    Transparency is dropped (`opaque_pixels`). Raises InputError naming the photo where it does not exist, is empty, damaged, cut
    short, holds other numbers than 8 or 16 bit ones, or more pixels than MOST_PIXELS or than fit into memory.
    """
    return decoded_photo(read_bytes(Path(path)), str(Path(path)))


def decoded_photo(content: bytes, name: str) -> UInt[np.ndarray, "h w *channels"]:
    """As `read_photo`, of the content of a file; errors say its name."""
    if is_tiff(content) and may_be_transparent(content):
        return _of_transparent_tiff(_decoded(content, name, cv2.IMREAD_UNCHANGED))
    return _decoded(content, name, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)


def _of_transparent_tiff(pixels: UInt[np.ndarray, "h w 4"]) -> UInt[np.ndarray, "h w 3"]:
    """The colours alone. libtiff multiplies those of 8 bits by their opacity; where that is zero they are lost."""
    colours = pixels[..., :3]
    if pixels.dtype != np.uint8:
        return np.ascontiguousarray(colours)
    opacity, colour = np.ogrid[:256, :256]
    table = np.where(opacity > 0, np.rint(colour * (255 / np.maximum(opacity, 1))), 0).clip(0, 255).astype(np.uint8)
    return table[pixels[..., 3:], colours]


@typed
def opaque_pixels(path: str | Path) -> Bool[np.ndarray, "h w"] | None:
    """Where a PNG, WebP or TIFF in colour shows anything: true where it is not wholly transparent, upright; None where that is
    everywhere, and of other files. Raises InputError as `read_photo`."""
    if not may_be_transparent(start_of_photo(Path(path))):
        return None
    content = read_bytes(Path(path))
    pixels = _decoded(content, str(Path(path)), cv2.IMREAD_UNCHANGED)
    if pixels.shape[2:] != (4,):
        return None
    opaque: Bool[np.ndarray, "h w"] = pixels[..., 3] > 0
    if opaque.all():
        return None
    # OpenCV turns every TIFF, and others where it drops their transparency.
    return opaque if is_tiff(content) else _upright(opaque, orientation_of_photo(content))


def start_of_photo(path: Path) -> bytes:
    """What stands before the pixels of a photo; of a TIFF its tags, which may stand behind them."""
    start = read_bytes(path, _HEADER_BYTES)
    place = place_of_tags(start)
    if place is None or place + MOST_TAG_BYTES <= len(start):
        return start
    return with_tags_before(start, read_bytes(path, MOST_TAG_BYTES, place))


def orientation_of_file(path: Path) -> int:
    """1 to 8 as in Exif 2.3; 1 where none is stated, or the file cannot be read."""
    try:
        start = start_of_photo(path)
        if is_webp(start):
            return orientation_of_photo(read_bytes(path))
        if orientation_may_follow(start):
            return orientation_at_end(read_bytes(path, _TAIL_BYTES, max(0, path.stat().st_size - _TAIL_BYTES)))
        return orientation_of_photo(start)
    except (InputError, OSError):
        return 1


def _upright(pixels: Shaped[np.ndarray, "h w"], orientation: int) -> Shaped[np.ndarray, "..."]:
    """Pixels as they stand in a file, turned as its orientation says."""
    stood = pixels.T if orientation >= 5 else pixels
    return stood[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


_OF_PHONES = {b"ftyp" + brand for brand in (b"heic", b"heix", b"hevc", b"heim", b"mif1", b"msf1", b"avif", b"avis")}
"""In the beginning of photos of phones, which are renamed to .jpg at times."""


def _decoded(content: bytes, name: str, flags: int) -> UInt[np.ndarray, "h w *channels"]:
    """The pixels, of which OpenCV's flags say which channels they have."""
    data = np.frombuffer(content, dtype=np.uint8)
    if not len(data):
        raise InputError(f"The image {name} is empty (0 bytes); copy it again.")
    _require_room(name, size_of_photo(content))
    try:
        with quiet_codecs():
            pixels = cv2.imdecode(data, flags)
    except cv2.error:
        pixels = None
    if pixels is None and content[4:12] in _OF_PHONES:
        raise InputError(f"The image {name} is HEIC or AVIF, whatever its name says, which is not read; convert it to JPEG.")
    if pixels is None:
        raise InputError(f"The image {name} cannot be decoded: it is damaged, cut short or of another format; copy it again.")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"The image {name} must have 8 or 16 bits per channel, found {pixels.dtype}; convert it.")
    if pixels.dtype == np.uint16 and in_planes(content):
        # OpenCV takes the first plane for all colours.
        raise InputError(
            f"The image {name} was expected to hold its colours pixel by pixel, found them in planes of 16 bits; save it "
            "interleaved (PlanarConfiguration 1)."
        )
    return pixels


def stretched(
    pixels: UInt[np.ndarray, "h w *channels"], levels: tuple[int, int], kind: type[np.uint8] | type[np.uint16]
) -> UInt[np.ndarray, "h w *channels"]:
    """Pixels of 16 bits with the first of `levels` as black and the second as white, of 8 or 16 bits."""
    dark, bright = levels
    white = np.iinfo(kind).max
    table = (np.arange(np.iinfo(np.uint16).max + 1) - dark) * (white / max(bright - dark, 1))
    return np.rint(table).clip(0, white).astype(kind)[pixels]


def levels_of(pixels: UInt[np.ndarray, "h w *channels"]) -> tuple[int, int]:
    """The darkest and the brightest level of all channels."""
    return int(pixels.min()), int(pixels.max())


def eight_bits(pixels: UInt[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w *channels"]:
    """A photo in 8 bits: of 16, which cameras seldom fill, it is stretched from its darkest level to its brightest."""
    return pixels if pixels.dtype == np.uint8 else stretched(pixels, levels_of(pixels), np.uint8)


def _require_room(name: str, size: tuple[int, int] | None) -> None:
    """Raises InputError where a photo of this size should not be decoded."""
    if size is None:
        return
    pixels, available = size[0] * size[1], available_bytes()
    if pixels > MOST_PIXELS:
        raise InputError(
            f"The image {name} was expected to have at most {MOST_PIXELS / 1e6:.0f} megapixels, found {size[0]} x {size[1]} px; "
            "give a smaller one."
        )
    if available is not None and 3 * pixels > available:
        raise InputError(
            f"Memory for the image {name} of {size[0]} x {size[1]} px was expected, found {available / 1e9:.1f} GB; give a "
            "smaller one, or more memory."
        )


def jpeg_of(picture: UInt8[np.ndarray, "h w *channels"], quality: int) -> bytes:
    """A picture to look at, reduced where it is longer than a JPEG can be."""
    scale = LONGEST_JPEG_PX / max(picture.shape[:2])
    if scale < 1:
        size = [max(1, round(scale * side)) for side in picture.shape[1::-1]]
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


_stderr_is_taken = threading.Lock()


@contextlib.contextmanager
def quiet_codecs() -> Iterator[None]:
    """Within it decoders say nothing on the standard error of the process."""
    # libjpeg and libpng write about damaged files to the process's standard error, past OpenCV's logging and past Python.
    with _stderr_is_taken:
        try:
            kept = os.dup(2)
        except OSError:
            kept = -1  # standard error is closed: there is nothing to keep quiet
        if kept < 0:
            yield
            return
        sink = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(sink, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(sink)
