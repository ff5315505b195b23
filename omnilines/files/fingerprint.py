"""What a result depends on, as one short text: it is computed anew only where that has changed."""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from camera_models.formats.disk import read_bytes


def fingerprint(files: Sequence[Path], options: str) -> str:
    """Of the contents of files, in their order, the options, and the version. Raises InputError where one cannot be read."""
    what = hashlib.sha256(f"{version('omnilines')} {options}".encode())
    for path in files:
        what.update(hashlib.sha256(read_bytes(path)).digest())
    return what.hexdigest()
