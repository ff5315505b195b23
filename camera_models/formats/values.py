"""Values as files of data give them, checked: each function takes a value and the place where it stands, for the message."""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models.errors import InputError


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
    return float(value)


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
    return width, height


def found(value: Any) -> str:
    """A value as a message names it."""
    kinds = {dict: "a mapping", list: "a list", type(None): "nothing"}
    return kinds.get(type(value)) or repr(value)
