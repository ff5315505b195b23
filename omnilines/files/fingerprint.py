"""What a result depends on, as one short text: it is computed anew only where that has changed."""

import hashlib
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

from camera_models.formats.disk import read_bytes

SOURCES = Path(__file__).parents[2]
"""The folder that the packages lie in."""


def fingerprint(files: Sequence[Path], options: str, revision: str) -> str:
    """Of the contents of files, in their order, the options, and the revision of what makes the result.

    Raises InputError where a file cannot be read.
    """
    what = hashlib.sha256(f"{revision} {options}".encode())
    for path in files:
        what.update(bytes.fromhex(content_hash(path)))
    return what.hexdigest()


def content_hash(path: Path) -> str:
    """Of the content of a file (SHA-256). Raises InputError where it cannot be read."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


@cache
def revision(*packages: str) -> str:
    """Of the source of packages or modules such as `omnilines.extraction`; where it cannot be read, the version.

    It changes with every line of them, so that what older code made is never taken for the result of this one. Computed once.
    """
    what = hashlib.sha256()
    try:
        for package in packages:
            path = SOURCES.joinpath(*package.split("."))
            sources = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
            if not sources:
                return version("omnilines")
            for source in sources:
                what.update(source.relative_to(SOURCES).as_posix().encode() + b"\0" + source.read_bytes() + b"\0")
    except OSError:
        return version("omnilines")
    return what.hexdigest()
