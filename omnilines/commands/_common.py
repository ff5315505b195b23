"""What every command hands back to the command line and the Python API, and how it tells of its progress."""

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from camera_models import InputError
from omnilines.records import Check, Summary

ProgressCallback = Callable[[str, int, int], None]
"""Told (stage, done, total) as work goes on; total 0 where it is not known."""


def silent(stage: str, done: int, total: int) -> None:
    """The progress callback that says nothing."""


@dataclass(frozen=True)
class CommandResult:
    """The outcome of a command: tables for people, `data` for `--json`, checks that decide the exit status, files written."""

    summaries: tuple[Summary, ...]
    data: Mapping[str, Any]
    checks: tuple[Check, ...] = ()
    files: tuple[Path, ...] = ()
    report: Path | None = None
    warnings: tuple[str, ...] = field(default=())

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)


def provenance(inputs: Mapping[str, Any], seed: int | None = None) -> dict[str, Any]:
    """What a result was made from: software and version, the command line, the inputs and the seed."""
    return {
        "software": f"omnilines {version('omnilines')}",
        "command": " ".join(["omnilines", *sys.argv[1:]]) if sys.argv[0].endswith("omnilines") else "python",
        "inputs": {key: str(value) for key, value in inputs.items()},
        "seed": seed,
    }


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
