"""TOML as files of other tools hold it: tables of numbers, texts and lists."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from camera_models.formats.parsed_text import parsed_text


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a file; raises InputError where it is no TOML."""
    content: dict[str, Any] = parsed_text(path, tomllib.loads, _syntax)
    return content


def _syntax(error: ValueError) -> str | None:
    return f" is not valid TOML: {error}" if isinstance(error, tomllib.TOMLDecodeError) else None


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """What is written of tables; a name with dots is that of a table in a table."""
    blocks = []
    for name, table in tables.items():
        # JSON writes texts, numbers, truth and lists as TOML does.
        rows = [f"{key} = {json.dumps(value, allow_nan=False)}" for key, value in table.items()]
        blocks.append("\n".join([f"[{name}]", *rows, ""]))
    return "\n".join(blocks)
