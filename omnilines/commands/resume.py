"""A run with the same inputs and options as the last does nothing."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from camera_models.formats.disk import read_text, write_atomically
from camera_models.formats.values import items, mapping, text
from omnilines.commands.result import CommandResult
from omnilines.files.fingerprint import content_hash
from omnilines.files.sets import claimed
from omnilines.records import Summary


class Stamp:
    """What the last run was made from, with its result."""

    def __init__(self, path: Path, inputs: str) -> None:
        self.path = path
        self.inputs = inputs

    def result(self) -> CommandResult | None:
        """The last result, if it was made from the same inputs and all its files are there with the contents they had."""
        try:
            kept = json.loads(read_text(self.path))
            files = {self._file(name): content for name, content in kept["files"]}
            whole = kept["inputs"] == self.inputs and all(content_hash(file) == content for file, content in files.items())
            summaries, data = tuple(map(_summary, kept["summaries"])), mapping(kept["data"], "data")
            report = None if kept["report"] is None else self._file(kept["report"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):  # InputError is a ValueError
            return None
        if not whole:
            return None
        note = "Inputs and options are those of the last run, and so is the result; nothing was done."
        return CommandResult(summaries, data, files=tuple(files), report=report, warnings=(note,))

    def write(self, result: CommandResult) -> None:
        """Keep a result, after all its files are written."""
        kept: dict[str, Any] = {
            "inputs": self.inputs,
            "files": [(self._name(file), content_hash(file)) for file in result.files],
            "report": None if result.report is None else self._name(result.report),
            "summaries": [asdict(summary) for summary in result.summaries],
            "data": result.data,
        }
        with claimed(self.path.parent, [self.path.name], by="done"):
            write_atomically(self.path, json.dumps(kept, indent=1, allow_nan=False) + "\n")

    def _name(self, file: Path) -> str:
        """Seen from the folder of the stamp, which may be moved, or copied, with what is in it."""
        return os.path.relpath(file, self.path.parent)

    def _file(self, name: str) -> Path:
        return Path(os.path.normpath(self.path.parent / name))


def _summary(kept: Any) -> Summary:
    """One that was written; raises InputError, KeyError, TypeError or ValueError where it is none."""
    rows = tuple((text(name, "rows"), text(told, "rows")) for name, told in kept["rows"])
    return Summary(text(kept["title"], "title"), rows, tuple(text(note, "notes") for note in items(kept["notes"], "notes")))
