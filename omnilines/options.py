"""Options: frozen, the same for the Python API, the command line and the keys of what is kept on disk.

Every stage has one frozen dataclass of options (`ExtractionOptions`, `MatchingOptions`, ...), whose fields are plain values or
groups of them: NamedTuples, which compiled loops take as they are. Default, unit (in the name) and the sentence below a field are
all that there is to say of it; `repr` of the options is their part of a cache key.
"""

import ast
import difflib
import inspect
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from camera_models.errors import InputError

O = TypeVar("O")  # noqa: E741


def names_of(options: Any) -> list[str]:
    """The fields of a dataclass or a NamedTuple of options."""
    return [field.name for field in fields(options)] if is_dataclass(options) else list(options._fields)


def is_group(value: Any) -> bool:
    """Whether a value holds options itself."""
    return (is_dataclass(value) and not isinstance(value, type)) or (isinstance(value, tuple) and hasattr(value, "_fields"))


def walk(options: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Every single option: its name with those of its groups before it, its value, and the sentence below its field."""
    sentences = _sentences(type(options))
    for name in names_of(options):
        value = getattr(options, name)
        if is_group(value):
            yield from walk(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, sentences.get(name, "")


def _sentences(kind: type) -> dict[str, str]:
    """The docstrings of the fields of a class."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = inspect.cleandoc(ast.literal_eval(text.value))
    return found


def with_settings(options: O, settings: Iterable[str], prefix: str = "") -> O:
    """The options with some of them as texts `group.name=value` say; numbers of a tuple are separated by commas.

    `prefix` stands before every name, as `extraction.`. Raises InputError where there is no such option or its value is of
    another kind.
    """
    known = {f"{prefix}{name}": value for name, value, _ in walk(options)}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or name not in known:
            near = difflib.get_close_matches(name, known, 3, 0.4)
            meant = f"; did you mean {' or '.join(near)}?" if near else "; docs/options.md lists them."
            raise InputError(f"An option was expected as NAME=VALUE, found '{setting}', of which no option has the name{meant}")
        options = _with(options, name.removeprefix(prefix).split("."), _parsed(name, text, known[name]))
    return options


def _with(options: Any, path: list[str], value: Any) -> Any:
    if len(path) > 1:
        value = _with(getattr(options, path[0]), path[1:], value)
    if hasattr(options, "_replace"):
        return options._replace(**{path[0]: value})
    return replace(options, **{path[0]: value})


def _parsed(name: str, text: str, default: Any) -> Any:
    """A text as a value of the kind that the default has, within reason."""
    if isinstance(default, Mapping):
        raise InputError(f"{name} was expected by the options of its own that commands have, found '{text}'; give those.")
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        if isinstance(default, tuple):
            return tuple(_number(name, part, default[0] if default else "") for part in text.split(","))
        return text if isinstance(default, str) else _number(name, text, default)
    except (KeyError, ValueError):
        kind = "true or false" if isinstance(default, bool) else "a number" if default is None else f"a value like {default}"
        raise InputError(f"{name} was expected to be {kind}, found '{text}'; correct it.") from None


def _number(name: str, text: str, default: Any) -> Any:
    if isinstance(default, str):
        return text
    whole = isinstance(default, int) or (default is None and text.isdecimal())
    value: float | int = int(text) if whole else float(text)
    if math.isnan(value):
        raise ValueError(text)
    low, high = range_of(name, default)
    if not low <= value <= high:
        raise InputError(f"{name} was expected to be a number from {low:g} to {high:g}, found '{text}'; correct it.")
    return value


UNITS = {"share": (0.0, 1.0), "cosine": (-1.0, 1.0), "grey": (0.0, 255.0), "rad": (0.0, 2 * math.pi), "deg": (0.0, 360.0)}
"""Ranges of values, by the unit that the name of an option ends in."""
SEED, REASON = "seed", 100


def range_of(name: str, default: float | int | None) -> tuple[float | int, float | int]:
    """Lowest and highest value within reason: those of the unit, else from 0 to 100, or to 100 times the default."""
    last = name.split(".")[-1]
    if last == SEED:
        return 0, 2**63 - 1
    return UNITS.get(last.split("_")[-1], (0, REASON * max(1, default or 0)))
