"""Folders that results are written to."""

import os
from pathlib import Path

from camera_models import InputError


def output_folder(out: str | Path) -> Path:
    """The folder, made if absent. Raises InputError when that cannot be done."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"A folder to write to was expected at {folder}, found that it cannot be made ({error.strerror})."
        ) from error
    return folder


def check_output_folder(out: str | Path) -> None:
    """Refuse, before any work, a folder that could not be made or written to; nothing is made yet. Raises InputError."""
    folder = Path(out).absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        why = "cannot be written to" if there.is_dir() else "is no folder"
        raise InputError(f"A folder to write to was expected at {out}, found that {there} {why}; name another.")
