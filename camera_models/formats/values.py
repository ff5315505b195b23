"""Values as files of data give them, checked: each function takes a value and the place where it stands, for the message."""

import math
import sys
import unicodedata
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models.errors import InputError

LARGEST = 1e100
"""Of a number in a file; squares and cubes of it are numbers still."""
LARGEST_SIDE_PX = 100_000
"""Of an image."""
MOST_TOLD = 200
"""Characters of a value in a message."""
STEPS = 8
"""Of rounding, within which a number is looked for that is written as wanted."""


def default(value: Any, otherwise: Any) -> Any:
    """The value, or `otherwise` where it is absent (None)."""
    return otherwise if value is None else value


def required(data: Mapping[str, Any], key: str, where: str) -> Any:
    """The value of a key; raises InputError where it is absent."""
    if data.get(key) is None:
        raise InputError(f"The key {key} is missing in {where}; add it.")
    return data[key]


def mapping(value: Any, where: str) -> dict[str, Any]:
    """A mapping whose keys are text."""
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a mapping of names to values, found {found(value)}; correct it.")
    for key in value:
        if not isinstance(key, str):
            raise InputError(f"Names in {where} must be text, found {key!r}; put it in quotes.")
    return value


def items(value: Any, where: str) -> list[Any]:
    """A list."""
    if not isinstance(value, list):
        raise InputError(f"{where} must be a list, found {found(value)}; correct it.")
    return value


def text(value: Any, where: str) -> str:
    """A text."""
    if not isinstance(value, str):
        raise InputError(f"{where} must be text, found {found(value)}; put it in quotes.")
    return value


def whole(value: Any, where: str) -> int:
    """A whole number that is not negative."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{where} must be a whole number, not negative, found {found(value)}; correct it.")
    return value


def number(value: Any, where: str) -> float:
    """A finite number."""
    # A comparison, because float() overflows for an int of hundreds of digits.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise InputError(f"{where} must be a finite number, found {found(value)}; correct it.")
    if abs(value) > LARGEST:
        raise InputError(f"{where} must be a number within reason (below {LARGEST:g}), found {float(value):g}; correct it.")
    return float(value)


def of_text(cell: str, kind: type[int] | type[float] = float) -> int | float:
    """A number as a text file writes it; raises ValueError on 1_000, which Python alone reads as one."""
    if "_" in cell:
        raise ValueError(cell)
    return kind(cell)


def written_as(wanted: float, written: Callable[[float], float], near: float) -> float:
    """A number a few steps of rounding from `near` that is written as wanted, where there is one; else `near`.

    A file that holds a parameter in another unit is then written as it was read.
    """
    below = above = near
    for _ in range(STEPS):
        if written(below) == wanted:
            return below
        if written(above) == wanted:
            return above
        below, above = math.nextafter(below, -math.inf), math.nextafter(above, math.inf)
    return near


def optional_number(data: Mapping[str, Any], key: str, where: str) -> float | None:
    """The number of a key, None where it is absent."""
    return None if data.get(key) is None else number(data[key], f"{key} of {where}")


def numbers(value: Any, shape: tuple[int, ...], where: str) -> Float[np.ndarray, "..."]:
    """Nested lists of finite numbers of a given shape."""
    rows = items(value, where)
    if len(rows) != shape[0]:
        raise InputError(f"{where} must hold {' x '.join(map(str, shape))} numbers, found a list of {len(rows)}; correct it.")
    if len(shape) == 1:
        return np.array([number(item, where) for item in rows])
    return np.array([numbers(item, shape[1:], f"row {row + 1} of the {where}") for row, item in enumerate(rows)])


def image_size(value: Any, where: str) -> tuple[int, int]:
    """[width, height], each at least one pixel."""
    size = items(value, where)
    if len(size) != 2:
        raise InputError(f"{where} must be [width, height], found {len(size)} numbers; give two.")
    width, height = (whole(side, where) for side in size)
    if min(width, height) < 1:
        raise InputError(f"{where} must be at least 1 x 1 pixels, found {width} x {height}; correct it.")
    if max(width, height) > LARGEST_SIDE_PX:
        raise InputError(f"{where} must be at most {LARGEST_SIDE_PX} pixels a side, found {width} x {height}; correct it.")
    return width, height


def image_name(value: Any, where: str) -> str:
    """The name of a photo: a path relative to the folder of the photos, that stays in it."""
    name = text(value, where)
    why = stray(name)
    if why is not None:
        raise InputError(
            f"{where} must be the name of a photo inside the folder of the photos, found {name[:80]!r}, which {why}."
        )
    return name


def stray(name: str) -> str | None:
    """Why a name is not that of a photo inside a folder, as the end of a sentence; None where it is."""
    if name.startswith(("/", "\\")) or name[1:3] in (":\\", ":/"):
        return "is an absolute path; leave out the folder"
    if ".." in name.replace("\\", "/").split("/"):
        return "leads out of it; give the folder that holds all photos"
    if not is_text(name):
        return "holds characters that are not text; rename it"
    return None


def is_text(name: str) -> bool:
    """Whether a name is without control characters and halves of pairs."""
    return not any(unicodedata.category(character) in ("Cc", "Cs") for character in name)


def found(value: Any) -> str:
    """A value as a message names it."""
    kinds = {dict: "a mapping", list: "a list", type(None): "nothing"}
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        # Python itself refuses to print those of thousands.
        return f"a whole number of about {int(value.bit_length() * math.log10(2))} digits"
    told = kinds.get(type(value)) or repr(value)
    return told if len(told) <= MOST_TOLD else f"{told[:MOST_TOLD]}..."
