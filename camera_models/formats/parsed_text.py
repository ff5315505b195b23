"""Text files of other tools that a parser reads: what is wrong with one is said in a sentence."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from camera_models.errors import InputError
from camera_models.formats.disk import read_text


def parsed_text(path: Path, parse: Callable[[str], Any], syntax: Callable[[ValueError], str | None]) -> Any:
    """What `parse` makes of the text of a file; `syntax` says what is wrong with it, None where the error is of another kind.

    Raises InputError where the text cannot be parsed, is nested too deeply, or holds a number of more digits than Python reads.
    """
    content = read_text(path)
    try:
        return parse(content)
    except RecursionError:
        raise InputError(f"{path} is nested too deeply for a calibration; restore the file.") from None
    except ValueError as error:
        wrong = syntax(error)
        told = (
            f"{path} was expected to hold numbers within reason, found one of thousands of digits; restore it."
            if wrong is None
            else f"{path}{wrong}; correct it or restore the file."
        )
        raise InputError(told) from None
