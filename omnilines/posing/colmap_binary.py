"""Whether a binary COLMAP model is whole: COLMAP's own reader goes on without end where a file was cut short."""

import struct
from pathlib import Path

from camera_models import InputError
from camera_models.formats.disk import read_bytes

IMAGE_BYTES, POINT_2D_BYTES = 64, 24
"""Of an image before its name (id, quaternion, translation, camera), and of each of its points."""
POINT_3D_BYTES, TRACK_BYTES = 43, 8
"""Of a point before its track (id, place, colour, error), and of each place in it."""


def require_whole(model: Path) -> None:
    """Raises InputError where images.bin or points3D.bin of a model ends before or after what it announces."""
    for name, end in (("images.bin", _end_of_images), ("points3D.bin", _end_of_points)):
        content = read_bytes(model / name)
        try:
            whole = end(content) == len(content)
        except (struct.error, ValueError):
            whole = False
        if not whole:
            raise InputError(
                f"{model / name}: a COLMAP model was expected, found a damaged one (it is cut short); export it again."
            )


def _count(content: bytes, at: int) -> int:
    return int(struct.unpack_from("<Q", content, at)[0])


def _end_of_images(content: bytes) -> int:
    at = 8
    for _ in range(_count(content, 0)):
        at = content.index(b"\0", at + IMAGE_BYTES) + 1
        at += 8 + POINT_2D_BYTES * _count(content, at)
    return at


def _end_of_points(content: bytes) -> int:
    at = 8
    for _ in range(_count(content, 0)):
        at += POINT_3D_BYTES
        at += 8 + TRACK_BYTES * _count(content, at)
    return at
