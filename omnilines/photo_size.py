"""What the first bytes of a photo say: how large it is, asked before it is decoded, since few bytes may stand for gigabytes of
pixels, whether it may have 16 bits a channel, and whether it may be transparent."""

import re
import struct

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
_FILLING = re.compile(rb"\xff*")
_WIDTH_TAG, _HEIGHT_TAG = 256, 257
MOST_SEGMENTS = 100_000
"""Of a JPEG before its frame."""


def size_of_photo(data: bytes) -> tuple[int, int] | None:
    """Width and height (px) that a PNG, JPEG, TIFF, BMP, WebP or PNM says it has; None of others and of damaged ones."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return _tiff(data)
        if data.startswith(b"BM"):
            old = struct.unpack_from("<I", data, 14)[0] == 12
            width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
            return abs(width), abs(height)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp(data)
        found = _PNM.match(data)
        return (int(found[1]), int(found[2])) if found else None
    except (struct.error, OverflowError):  # cut short, or a place beyond all files
        return None


def wrong_size(what: str, size: tuple[int, int], camera_size: tuple[int, int]) -> str | None:
    """Why a photo, or what lies over it, is none of a camera: its width and height (px) are others; None where they are not."""
    if size == camera_size:
        return None
    asked = f"A {what} of {camera_size[0]}x{camera_size[1]} px was expected, as the camera has, found {size[0]}x{size[1]} px"
    if size == camera_size[::-1]:
        return f"{asked}, which looks turned; turn it, or its EXIF orientation, as the photos that the calibration is of are."
    return f"{asked}; give the one that the calibration is of."


def may_have_16_bits(data: bytes) -> bool:
    """Whether the first 25 bytes of a photo leave it open that it has 16 bits a channel: a PNG says it, a TIFF or PNM later."""
    return data[24:25] == b"\x10" if data.startswith(b"\x89PNG") else data[:2] in (b"II", b"MM", b"P2", b"P3", b"P5", b"P6")


def may_be_transparent(data: bytes) -> bool:
    """Whether a PNG, by its kind of colour or a table before its pixels, or a WebP, by its first bytes, has transparency."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return data[25:26] in (b"\x04", b"\x06") or b"tRNS" in data.partition(b"IDAT")[0]
    if data[:4] == b"RIFF" and len(data) >= 30:
        return bool((data[12:16] == b"VP8X" and data[20] & 0x10) or (data[12:16] == b"VP8L" and data[24] & 0x10))
    return False


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """That of the frame, behind other segments."""
    place = 2
    for _ in range(MOST_SEGMENTS):
        filled = _FILLING.match(data, place)
        if filled is None or filled.end() == place:
            return None
        place = filled.end() - 1
        _, kind, length = struct.unpack_from(">BBH", data, place)
        if kind in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        place += 2 + length
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """That of the first page, the one that is read; of BigTIFF too."""
    order, big = "<" if data.startswith(b"II") else ">", data[2:4] in (b"+\0", b"\0+")
    (place,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, place)
    place, entry = place + (8 if big else 2), 20 if big else 12
    found: dict[int, int] = {}
    for _ in range(min(count, 1000)):
        tag, kind = struct.unpack_from(order + "HH", data, place)
        if tag in (_WIDTH_TAG, _HEIGHT_TAG):
            (found[tag],) = struct.unpack_from(order + {3: "H", 4: "I"}.get(kind, "Q"), data, place + (12 if big else 8))
        place += entry
    return (found[_WIDTH_TAG], found[_HEIGHT_TAG]) if len(found) == 2 else None


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X" and len(data) >= 30:
        width, height = (int.from_bytes(data[place : place + 3], "little") + 1 for place in (24, 27))
        return width, height
    return None
