"""What every command hands back to the command line."""

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
    checks: tuple[Check, ...] = ()
    files: tuple[Path, ...] = ()
    report: Path | None = None
    warnings: tuple[str, ...] = field(default=())
    """What a person should know of all photos together, one sentence each."""
    details: tuple[Detail, ...] = field(default=())
    """And of single photos."""
    photos: int | None = None
    """How many photos were given, where that is known."""

    @property
    def notes(self) -> list[str]:
        """Every sentence, what matters most first."""
        return [*self.warnings, *(one.text for one in self.details)]

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)
