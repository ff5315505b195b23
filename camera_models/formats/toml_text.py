"""TOML as files of other tools hold it: tables of numbers, texts and lists."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from camera_models.errors import InputError
from camera_models.formats.disk import read_text


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a file; raises InputError where it is no TOML."""
    content = read_text(path)
    try:
        return tomllib.loads(content)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not valid TOML: {error}; correct it or restore the file.") from None
    except ValueError:  # a number of more digits than Python reads
        raise InputError(
            f"{path} was expected to hold numbers within reason, found one of thousands of digits; restore it."
        ) from None
    except RecursionError:
        raise InputError(f"{path} is nested too deeply for a calibration; restore the file.") from None


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """What is written of tables; a name with dots is that of a table in a table."""
    blocks = []
    for name, table in tables.items():
        # JSON writes texts, numbers, truth and lists as TOML does.
        rows = [f"{key} = {json.dumps(value, allow_nan=False)}" for key, value in table.items()]
        blocks.append("\n".join([f"[{name}]", *rows, ""]))
    return "\n".join(blocks)
