"""JSON as files of other tools hold it: read with one sentence where it is damaged."""

import json
from pathlib import Path
from typing import Any

from camera_models.errors import InputError
from camera_models.formats.disk import read_text


def read_json(path: Path) -> Any:
    """The content of a file; raises InputError where it is no JSON."""
    content = read_text(path)
    try:
        return json.loads(content)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno} is not valid JSON: {error.msg}; correct it or restore the file.") from None
    except ValueError:  # a number of more digits than Python reads
        raise InputError(
            f"{path} was expected to hold numbers within reason, found one of thousands of digits; restore it."
        ) from None
    except RecursionError:
        raise InputError(f"{path} is nested too deeply for a calibration; restore the file.") from None


def json_text(value: Any) -> str:
    """What is written of a value."""
    return json.dumps(value, indent=4, allow_nan=False) + "\n"
