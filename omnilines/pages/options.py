"""Every option by its name, as docs/options.md lists them:

python -m omnilines.pages.options
"""

import importlib
from typing import Any

from omnilines.options import walk

STAGES: tuple[tuple[str, str], ...] = ()
"""(name before those of its options, "module:Class" of the options of a stage), in the order of the data flow."""


def options_of(stage: str) -> Any:
    """The options of a stage with their defaults."""
    module, _, kind = dict(STAGES)[stage].partition(":")
    return getattr(importlib.import_module(module), kind)()


def options_table() -> str:
    """A table for every stage: name, default, and the sentence below the field."""
    parts = []
    for stage, place in STAGES:
        rows = [
            f"| `{name}` | {_shown(value)} | {_cell(sentence)} |"
            for name, value, sentence in walk(options_of(stage), f"{stage}.")
        ]
        parts.append("\n".join([f"### `{place.partition(':')[2]}`", "", "| option | default | |", "|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_shown, value)) or "none"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else "" if value is None else str(value)


def _cell(sentence: str) -> str:
    """A sentence as it can stand in a table."""
    return " ".join(sentence.split()).replace("|", "\\|")


if __name__ == "__main__":
    print(options_table(), end="")
