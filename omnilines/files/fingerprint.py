"""What a result depends on, as one short text: it is computed anew only where that has changed."""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from camera_models import InputError


def fingerprint(files: Sequence[Path], options: str) -> str:
    """Of the contents of files, in their order, the options, and the version. Raises InputError where one cannot be read."""
    what = hashlib.sha256(f"{version('omnilines')} {options}".encode())
    for path in files:
        try:
            with path.open("rb") as file:
                what.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise InputError(f"{path} was expected to be readable, found that it is not ({error.strerror}).") from error
    return what.hexdigest()
