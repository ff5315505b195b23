"""The pixels of one photo file, as everything that looks at photos sees them."""

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes


def read_photo(path: str | Path) -> UInt[np.ndarray, "h w *channels"]:
    """The pixels of a photo: (h, w) grey or (h, w, 3) BGR, 8 or 16 bits, turned upright as its EXIF orientation says.

    Transparency is dropped. Raises InputError naming the photo where it does not exist, is empty, damaged, cut short, or holds
    other numbers than 8 or 16 bit ones.
    """
    file = Path(path)
    data = np.frombuffer(read_bytes(file), dtype=np.uint8)
    if not len(data):
        raise InputError(f"The image {file} is empty (0 bytes); copy it again.")
    try:
        with quiet_codecs():
            pixels = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    except cv2.error as error:
        raise InputError(f"The image {file} cannot be decoded ({error.err}); convert it to PNG or JPEG.") from None
    if pixels is None:
        raise InputError(f"The image {file} cannot be decoded: it is damaged, cut short or of another format; copy it again.")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"The image {file} must have 8 or 16 bits per channel, found {pixels.dtype}; convert it.")
    return pixels


_stderr_is_taken = threading.Lock()


@contextlib.contextmanager
def quiet_codecs() -> Iterator[None]:
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
