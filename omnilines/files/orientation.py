"""Photos that their EXIF orientation turns otherwise than the others of their camera.

A calibration is about the pixels of a sensor. Photos are used as their orientation turns them, which is the same for all photos
of a camera that is held the same way; one that is turned otherwise would have other pixels of the sensor, at the same size where
it is turned by half a turn.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Shaped

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes
from omnilines.files.photos import Photo, PhotoRef

HEAD_BYTES = 1 << 18
"""In which the orientation stands."""
MOST_ENTRIES = 1000
"""Of a directory of tags."""
_TAG = 0x0112
_TURNS = {
    1: "not at all",
    2: "to a mirror image",
    3: "by 180 degrees",
    4: "upside down to a mirror image",
    5: "on its side to a mirror image",
    6: "by 90 degrees to the right",
    7: "on its side to a mirror image",
    8: "by 90 degrees to the left",
}
"""By the value of the tag (Exif 2.3, 0x0112)."""


def turned_otherwise(photos: Sequence[Photo]) -> dict[str, str]:
    """Of photos of one camera, by name, those that are turned otherwise than most, each with a reason; where as many are turned
    one way as the other, those that are turned."""
    orientation = {photo.name: exif_orientation(photo) for photo in photos}
    counts = Counter(orientation.values())
    usual = min(counts, key=lambda value: (-counts[value], value), default=1)
    return {name: _reason(value, usual) for name, value in orientation.items() if value != usual}


def by_camera(photos: Sequence[Photo], camera_of: Mapping[str, str]) -> dict[str, str]:
    """`turned_otherwise` of each camera's own photos."""
    return {
        name: reason
        for camera in dict.fromkeys(camera_of.values())
        for name, reason in turned_otherwise([photo for photo in photos if camera_of[photo.name] == camera]).items()
    }


def _reason(value: int, usual: int) -> str:
    return (
        f"its EXIF orientation turns it {_TURNS[value]}, and the other photos {_TURNS[usual]}, where pixels have to be those of "
        "one sensor; give it the orientation of the others"
    )


def exif_orientation(photo: Photo) -> int:
    """1 to 8 as in Exif 2.3; 1 where none is stated, or the file cannot be read."""
    if not isinstance(photo, PhotoRef):
        return 1
    try:
        head = read_bytes(photo.path, HEAD_BYTES)
    except InputError:
        return 1
    try:
        value = next((found for tiff in _tiffs(head) if (found := _orientation(tiff)) is not None), 1)
    except struct.error:  # cut short
        return 1
    return value if value in _TURNS else 1


def upright(pixels: Shaped[np.ndarray, "h w"], orientation: int) -> Shaped[np.ndarray, "..."]:
    """Pixels as they stand in a file, turned as its orientation says."""
    stood = pixels.T if orientation >= 5 else pixels
    return stood[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def _tiffs(head: bytes) -> Iterator[bytes]:
    """Where tags stand: in a TIFF file itself, in segments of a JPEG, in a chunk of a PNG."""
    if head[:4] in (b"II*\0", b"MM\0*"):
        yield head
    elif head[:2] == b"\xff\xd8":
        at = 2
        while head[at : at + 1] == b"\xff":
            _, kind, length = struct.unpack_from(">BBH", head, at)
            if kind in (0xD9, 0xDA):
                return
            if kind == 0xE1 and head[at + 4 : at + 10] == b"Exif\0\0":
                yield head[at + 10 : at + 2 + length]
            at += 2 + length
    elif head[:8] == b"\x89PNG\r\n\x1a\n":
        at = 8
        while at + 8 <= len(head):
            (length,) = struct.unpack_from(">I", head, at)
            if head[at + 4 : at + 8] == b"eXIf":
                yield head[at + 8 : at + 8 + length]
            at += 12 + length


def _orientation(tiff: bytes) -> int | None:
    """The tag in the first directory."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    (start,) = struct.unpack_from(f"{order}I", tiff, 4)
    (entries,) = struct.unpack_from(f"{order}H", tiff, start)
    for k in range(min(entries, MOST_ENTRIES)):
        tag, kind, count, value = struct.unpack_from(f"{order}HHIH", tiff, start + 2 + 12 * k)
        if tag == _TAG:
            return int(value) if (kind, count) == (3, 1) else None
    return None
