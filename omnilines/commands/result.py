"""What every command hands back to the command line."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omnilines.records import Check, Detail, Summary


@dataclass(frozen=True)
class CommandResult:
    """The outcome of a command: tables for people, `data` for `--json`, checks that decide the exit status, files written."""

    summaries: tuple[Summary, ...]
    data: Mapping[str, Any]
    """Numbers that are not known, which are NaN or infinite, become None: JSON has neither."""
    checks: tuple[Check, ...] = ()
    files: tuple[Path, ...] = ()
    report: Path | None = None
    warnings: tuple[str, ...] = field(default=())
    """What a person should know of all photos together, one sentence each."""
    details: tuple[Detail, ...] = field(default=())
    """And of single photos."""
    photos: int | None = None
    """How many photos were given, where that is known."""
    then: tuple[str, ...] = ()
    """The command that most often comes next, as words after `omnilines`; capital letters stand for what the user has."""

    @property
    def notes(self) -> list[str]:
        """Every sentence, what matters most first."""
        return [*self.warnings, *(one.text for one in self.details)]

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", known_numbers(self.data))

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)


def with_calibration(path: Path) -> tuple[str, ...]:
    """What a calibration is most often for."""
    return ("reconstruct", "PHOTOS", "--calibration", str(path), "--poses", "sfm", "--out", "scene")


def known_numbers(value: Any) -> Any:
    """The same with None for every number that is NaN or infinite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: known_numbers(part) for name, part in value.items()}
    return [known_numbers(part) for part in value] if isinstance(value, list | tuple) else value
