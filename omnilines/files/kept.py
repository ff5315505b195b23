"""Arrays that a run keeps for the next one with the same inputs: an NPZ, compressed, with a seal at its end.

The seal is the SHA-256 of the archive and of what it was made from. A file that was cut short, changed, or put in the place of
another has no such seal: it is made anew.
"""

import hashlib
import io
import threading
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from camera_models import InputError
from camera_models.formats.disk import read_bytes, write_atomically

SEAL_BYTES = 32
_LEVEL = 1
"""Of the compression: chains of edge points take half the room then, in a twentieth of the time that finding them takes."""
_ONE_HEADER = threading.Lock()
"""NumPy parses headers as Python; CPython before 3.11.8 and 3.12.2 raises SystemError where two threads parse at a time
(github.com/python/cpython/issues/106905)."""


def write_kept(path: Path, inputs: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Keep arrays that were made from `inputs`. Raises InputError where the file cannot be written."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    archive = zlib.compress(buffer.getvalue(), _LEVEL)
    write_atomically(path, archive + _seal(archive, inputs))


def read_kept(path: Path, inputs: str) -> dict[str, np.ndarray] | None:
    """The arrays; None where the file is absent, damaged, or of other inputs."""
    try:
        content = read_bytes(path)
    except InputError:
        return None
    archive = content[:-SEAL_BYTES]
    if content[-SEAL_BYTES:] != _seal(archive, inputs):
        return None
    try:
        plain = zlib.decompress(archive)
    except zlib.error:  # of a version that did not compress
        return None
    with _ONE_HEADER, np.load(io.BytesIO(plain)) as file:
        return dict(file)


def _seal(archive: bytes, inputs: str) -> bytes:
    return hashlib.sha256(archive + inputs.encode()).digest()
