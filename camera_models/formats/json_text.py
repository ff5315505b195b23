"""JSON as files of other tools hold it: read with one sentence where it is damaged."""

import json
from pathlib import Path
from typing import Any

from camera_models.formats.parsed_text import parsed_text


def read_json(path: Path) -> Any:
    """The content of a file; raises InputError where it is no JSON."""
    return parsed_text(path, json.loads, _syntax)


def _syntax(error: ValueError) -> str | None:
    return f", line {error.lineno} is not valid JSON: {error.msg}" if isinstance(error, json.JSONDecodeError) else None


def json_text(value: Any) -> str:
    """What is written of a value."""
    return json.dumps(value, indent=4, allow_nan=False) + "\n"
