"""A run with the same inputs and options as the last does nothing."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from camera_models.formats.disk import read_text, write_atomically
from camera_models.formats.values import items, mapping, text, whole
from omnilines.commands.result import CommandResult
from omnilines.files.fingerprint import content_hash
from omnilines.files.sets import claimed
from omnilines.records import Advice, Detail, Summary

NOTE = "Inputs and options are those of the last run, and so is the result; nothing was done."


class Stamp:
    """What the last run was made from, with its result."""

    def __init__(self, path: Path, inputs: str) -> None:
        self.path = path
        self.inputs = inputs

    def result(self) -> CommandResult | None:
        """The last result, if it was made from the same inputs and all its files are there with the contents they had. It says
        all that the run which made it said, but for the command that comes next."""
        try:
            kept = json.loads(read_text(self.path))
            files = {self._file(name): content for name, content in kept["files"]}
            if kept["inputs"] != self.inputs or any(content_hash(file) != content for file, content in files.items()):
                return None
            return CommandResult(
                tuple(map(_summary, kept["summaries"])),
                mapping(kept["data"], "data"),
                files=tuple(files),
                report=None if kept["report"] is None else self._file(kept["report"]),
                warnings=(NOTE, *_texts(kept["warnings"], "warnings")),
                details=tuple(Detail(**_words(one, "details")) for one in kept["details"]),
                photos=None if kept["photos"] is None else whole(kept["photos"], "photos"),
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):  # InputError is a ValueError
            return None

    def write(self, result: CommandResult) -> None:
        """Keep a result whose checks hold, after all its files are written."""
        kept: dict[str, Any] = {
            "inputs": self.inputs,
            "files": [(self._name(file), content_hash(file)) for file in result.files],
            "report": None if result.report is None else self._name(result.report),
            "summaries": [asdict(summary) for summary in result.summaries],
            "data": result.data,
            "warnings": result.warnings,
            "details": [asdict(detail) for detail in result.details],
            "photos": result.photos,
        }
        with claimed(self.path.parent, [self.path.name], by="done"):
            write_atomically(self.path, json.dumps(kept, indent=1, allow_nan=False) + "\n")

    def _name(self, file: Path) -> str:
        """Seen from the folder of the stamp, which may be moved, or copied, with what is in it."""
        return os.path.relpath(file, self.path.parent)

    def _file(self, name: str) -> Path:
        return Path(os.path.normpath(self.path.parent / name))


def _summary(kept: Any) -> Summary:
    """One that was written; this and the functions below raise InputError, KeyError, TypeError or ValueError where it is none."""
    rows = tuple((text(name, "rows"), text(told, "rows")) for name, told in kept["rows"])
    advice = tuple(Advice(**_words(one, "advice")) for one in kept["advice"])
    title, verdict, of_photos = text(kept["title"], "title"), text(kept["verdict"], "verdict"), kept["of_photos"] is True
    return Summary(title, rows, _texts(kept["notes"], "notes"), of_photos, verdict, advice)


def _texts(kept: Any, where: str) -> tuple[str, ...]:
    return tuple(text(one, where) for one in items(kept, where))


def _words(kept: Any, where: str) -> dict[str, str]:
    return {name: text(value, where) for name, value in mapping(kept, where).items()}
