"""What the bytes of a photo say beside its pixels: how large it is, asked before it is decoded, since few bytes may stand for
gigabytes of pixels, whether it may have 16 bits a channel, whether it may be transparent, and how it is to be turned."""

import re
import struct
import zlib
from collections.abc import Iterator

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
_FILLING = re.compile(rb"\xff*")
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF, _BIG_TIFF = (b"II*\0", b"MM\0*"), (b"II+\0", b"MM\0+")
_WIDTH_TAG, _HEIGHT_TAG, _COLOURS_TAG, _ORIENTATION_TAG, _SAMPLES_TAG, _PLANES_TAG, _EXTRA_TAG = 256, 257, 262, 274, 277, 284, 338
_KIND_TAG, _OF_ANOTHER = 254, 0b101
"""NewSubfileType of TIFF 6.0, and its bits of a page that is a smaller version, or a mask, of another."""
_RGB, _IN_PLANES, _ALPHA = 2, 2, (1, 2)
"""Values of the tags of TIFF 6.0: PhotometricInterpretation, PlanarConfiguration, and those of ExtraSamples that are opacity."""
_STEPS_OF_50 = 3688
"""The sum of the example table of the standard for brightness."""
MOST_SEGMENTS = 100_000
"""Of a JPEG before its frame."""
MOST_ENTRIES = 1000
"""Of a directory of tags."""
MOST_TAG_BYTES = 8 + 20 * MOST_ENTRIES
"""Of such a directory."""


def size_of_photo(data: bytes) -> tuple[int, int] | None:
    """Width and height (px) that a PNG, JPEG, TIFF, BMP, WebP or PNM says it has; None of others and of damaged ones."""
    try:
        if data.startswith(_PNG):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if is_tiff(data):
            tags = _tags(data)
            return (tags[_WIDTH_TAG], tags[_HEIGHT_TAG]) if tags.keys() >= {_WIDTH_TAG, _HEIGHT_TAG} else None
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
    """Whether a PNG, by its kind of colour or a table before its pixels, a WebP, by its first bytes, or a TIFF in colour, by its
    tags, has transparency."""
    if data.startswith(_PNG):
        return data[25:26] in (b"\x04", b"\x06") or b"tRNS" in data.partition(b"IDAT")[0]
    if data[:4] == b"RIFF" and len(data) >= 30:
        return bool((data[12:16] == b"VP8X" and data[20] & 0x10) or (data[12:16] == b"VP8L" and data[24] & 0x10))
    tags = tiff_tags(data)
    return (tags.get(_COLOURS_TAG), tags.get(_SAMPLES_TAG)) == (_RGB, 4) and tags.get(_EXTRA_TAG) in _ALPHA


def in_planes(data: bytes) -> bool:
    """Whether a TIFF holds one colour after the other, not pixel after pixel."""
    tags = tiff_tags(data)
    return tags.get(_PLANES_TAG) == _IN_PLANES and tags.get(_SAMPLES_TAG, 1) > 1


def is_animated(data: bytes) -> bool:
    """Whether the beginning of a PNG or WebP says so."""
    if data.startswith(_PNG):
        return b"acTL" in data.partition(b"IDAT")[0]
    return is_webp(data) and data[12:16] == b"VP8X" and len(data) > 20 and bool(data[20] & 0x02)


def next_page(data: bytes) -> int | None:
    """Where in a TIFF the tags of its second page stand, by what stands behind those of the first; None where there is none."""
    try:
        return _next_page(data) or None if is_tiff(data) else None
    except struct.error:  # cut short
        return None


def is_picture_of_its_own(data: bytes) -> bool:
    """Whether the first page of a TIFF is no smaller version of another one, nor a mask of it."""
    return not tiff_tags(data).get(_KIND_TAG, 0) & _OF_ANOTHER


def is_tiff(data: bytes) -> bool:
    """Whether the first bytes are those of a TIFF, whose tags may stand behind its pixels."""
    return data[:4] in _TIFF + _BIG_TIFF


def is_webp(data: bytes) -> bool:
    """Whether the first bytes are those of a WebP, whose orientation stands behind its pixels."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def place_of_tags(data: bytes) -> int | None:
    """Where in a TIFF its tags stand, by its first bytes; None of other files and of those cut short."""
    try:
        return _place_of_tags(data)[0] if is_tiff(data) else None
    except struct.error:
        return None


def with_tags_before(data: bytes, tags: bytes) -> bytes:
    """The head of a TIFF with the bytes that stand where its tags do right behind."""
    order, big = "<" if data.startswith(b"II") else ">", data[:4] in _BIG_TIFF
    return data[:8] + struct.pack(f"{order}Q", 16) + tags if big else data[:4] + struct.pack(f"{order}I", 8) + tags


def orientation_may_follow(data: bytes) -> bool:
    """Whether the first bytes are those of a PNG whose orientation may stand at its end: none stands in them."""
    return data.startswith(_PNG) and not list(_tiffs(data))


def orientation_at_end(data: bytes) -> int:
    """As `orientation_of_photo`, of a PNG by its last bytes."""
    at = data.rfind(b"eXIf")
    length = int.from_bytes(data[at - 4 : at], "big") if at >= 4 else 0
    chunk = data[at : at + 4 + length]
    if not length or data[at + 4 + length : at + 8 + length] != zlib.crc32(chunk).to_bytes(4, "big"):
        return 1
    return orientation_of_photo(chunk[4:])


def orientation_of_photo(data: bytes) -> int:
    """1 to 8 as in Exif 2.3, of a TIFF, JPEG, PNG or WebP; 1 where none is stated."""
    try:
        value = next((tags[_ORIENTATION_TAG] for tags in map(_tags, _tiffs(data)) if _ORIENTATION_TAG in tags), 1)
    except (struct.error, OverflowError):  # cut short
        return 1
    return value if 1 <= value <= 8 else 1


def jpeg_quality(data: bytes) -> int | None:
    """1 to 100 as libjpeg has it, of a JPEG by its beginning: by the mean step that brightness is rounded to, over that of the
    example tables of the standard (ITU-T T.81, table K.1), which are quality 50. None of other files and of damaged ones."""
    if not data.startswith(b"\xff\xd8"):
        return None
    try:
        table = next((content for kind, content in _jpeg_segments(data) if kind == 0xDB), b"")
    except struct.error:  # cut short
        return None
    if len(table) < 65 or table[0] >> 4:  # steps of two bytes are of images of 12 bits
        return None
    times = sum(table[1:65]) / _STEPS_OF_50
    return max(1, round(100 - 50 * times if times <= 1 else 50 / times))


def tiff_tags(data: bytes) -> dict[int, int]:
    """The tags of the first page of a TIFF, the one that is read, that have one whole number; none of others and damaged ones."""
    try:
        return _tags(data) if is_tiff(data) else {}
    except (struct.error, OverflowError):
        return {}


def _tags(tiff: bytes) -> dict[int, int]:
    """Those of the first directory; raises struct.error where it is cut short."""
    place, order, big = _place_of_tags(tiff)
    (entries,) = struct.unpack_from(order + ("Q" if big else "H"), tiff, place)
    place, entry = place + (8 if big else 2), 20 if big else 12
    found: dict[int, int] = {}
    for _ in range(min(entries, MOST_ENTRIES)):
        tag, kind, count = struct.unpack_from(order + ("HHQ" if big else "HHI"), tiff, place)
        form = {3: "H", 4: "I", 16: "Q" if big else None}.get(kind)
        if count == 1 and form is not None:
            (found[tag],) = struct.unpack_from(order + form, tiff, place + (12 if big else 8))
        place += entry
    return found


def _next_page(tiff: bytes) -> int:
    """Where the next directory begins, 0 where there is none; raises struct.error where the first is cut short."""
    place, order, big = _place_of_tags(tiff)
    (entries,) = struct.unpack_from(order + ("Q" if big else "H"), tiff, place)
    (following,) = struct.unpack_from(
        order + ("Q" if big else "I"), tiff, place + (8 + 20 * entries if big else 2 + 12 * entries)
    )
    return int(following)


def _place_of_tags(tiff: bytes) -> tuple[int, str, bool]:
    """Where the first directory begins, the order of bytes, and whether it is a BigTIFF."""
    order, big = "<" if tiff.startswith(b"II") else ">", tiff[:4] in _BIG_TIFF
    (place,) = struct.unpack_from(order + ("Q" if big else "I"), tiff, 8 if big else 4)
    return place, order, big


def _tiffs(data: bytes) -> Iterator[bytes]:
    """Where tags stand: in a TIFF file itself, in segments of a JPEG, in a chunk of a PNG or a WebP."""
    if is_tiff(data):
        yield data
    elif data[:2] == b"\xff\xd8":
        for kind, content in _jpeg_segments(data):
            if kind == 0xE1 and content.startswith(b"Exif\0\0"):
                yield from _exif(content[6:])
    elif data.startswith(_PNG):
        at = 8
        while at + 8 <= len(data):
            (length,) = struct.unpack_from(">I", data, at)
            if data[at + 4 : at + 8] == b"eXIf":
                yield from _exif(data[at + 8 : at + 8 + length])
            at += 12 + length
    elif is_webp(data):
        at = 12
        while at + 8 <= len(data):
            (length,) = struct.unpack_from("<I", data, at + 4)
            if data[at : at + 4] == b"EXIF":
                yield from _exif(data[at + 8 : at + 8 + length].removeprefix(b"Exif\0\0"))
            at += 8 + length + length % 2


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of those before the pixels."""
    at = 2
    while data[at : at + 1] == b"\xff":
        _, kind, length = struct.unpack_from(">BBH", data, at)
        if kind in (0xD9, 0xDA):
            return
        yield kind, data[at + 4 : at + 2 + length]
        at += 2 + length


def _exif(tiff: bytes) -> Iterator[bytes]:
    if is_tiff(tiff):
        yield tiff


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
