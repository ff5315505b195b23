"""Every option by its name, as docs/options.md lists them. This writes that part of it anew:

python -m omnilines.pages.options docs/options.md
"""

import importlib
import sys
from pathlib import Path
from typing import Any

from omnilines.options import walk

STAGES: tuple[tuple[str, str], ...] = (
    ("frames", "omnilines.footage.options:FrameOptions"),
    ("detection", "calib_patterns.options:DetectionOptions"),
    ("calibration", "omnilines.calibration.options:CalibrationOptions"),
    ("guide", "omnilines.guide.options:GuideOptions"),
    ("extraction", "omnilines.extraction.options:ExtractionOptions"),
    ("directions", "omnilines.structure.options:DirectionsOptions"),
    ("lines", "omnilines.pipelines.line_options:LinesOptions"),
    ("check", "omnilines.pipelines.check_options:CheckOptions"),
    ("posing", "omnilines.posing.options:PosingOptions"),
    ("scene", "omnilines.pipelines.options:SceneOptions"),
    ("triangulation", "omnilines.triangulation.options:TriangulationOptions"),
    ("render", "omnilines.pipelines.render:RenderOptions"),
)
"""(name before those of its options, "module:Class" of the options of a stage), in the order of the data flow."""


HEADING = "## All of them\n"
"""Below it the page holds what is written here, and nothing else."""


def options_of(stage: str) -> Any:
    """The options of a stage with their defaults."""
    module, _, kind = dict(STAGES)[stage].partition(":")
    return getattr(importlib.import_module(module), kind)()


def options_table() -> str:
    """A table for every stage: name, default, and the sentence below the field."""
    parts = []
    for stage, place in STAGES:
        options = walk(options_of(stage), f"{stage}.")
        rows = [f"| `{name}` | {_shown(value)} | {_cell(sentence)} |" for name, value, sentence in options]
        parts.append("\n".join([f"### `{place.partition(':')[2]}`", "", "| option | default | |", "|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def with_options(page: str) -> str:
    """The text of docs/options.md with the tables of today."""
    return f"{page[: page.index(HEADING)]}{HEADING}\n{options_table()}"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_shown, value)) or "none"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else "not set" if value is None else str(value) or "none"


def _cell(sentence: str) -> str:
    """A sentence as it can stand in a table."""
    return " ".join(sentence.split()).replace("|", "\\|")


if __name__ == "__main__":
    document = Path(sys.argv[1])
    document.write_text(with_options(document.read_text(encoding="utf-8")), encoding="utf-8")
