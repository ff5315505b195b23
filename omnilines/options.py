"""Options: frozen, the same for the Python API, the command line and the keys of what is kept on disk.

Every stage has one frozen dataclass of options (`ExtractionOptions`, `MatchingOptions`, ...), whose fields are plain values or
groups of them: NamedTuples, which compiled loops take as they are. Default, unit (in the name) and the sentence below a field are
all that there is to say of it; `repr` of the options is their part of a cache key.
"""

import ast
import difflib
import functools
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
    kind: type = type(options)
    sentences = _sentences(kind)
    for name in names_of(options):
        value = getattr(options, name)
        if is_group(value):
            yield from walk(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, sentences.get(name, "")


@functools.cache
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
        if not equals and name in known:
            raise InputError(f"A value was expected behind {name}, found none; give it as {name}=VALUE.")
        if name not in known:
            near = difflib.get_close_matches(name, known, 3, 0.4)
            meant = f"; did you mean {' or '.join(near)}?" if near else "; docs/options.md lists them."
            raise InputError(f"An option was expected as NAME=VALUE, found '{setting}', of which no option has the name{meant}")
        options = _with(options, name.removeprefix(prefix).split("."), _parsed(name, text, known[name]))
    _require_ordered(options, prefix)
    return options


def _require_ordered(options: Any, prefix: str) -> None:
    """Raises InputError where the least of something is set above its most."""
    values = {f"{prefix}{name}": value for name, value, _ in walk(options)}
    for name, low in values.items():
        group, dot, last = name.rpartition(".")
        high = values.get(f"{group}{dot}max_{last.removeprefix('min_')}") if last.startswith("min_") else None
        if high is not None and low > high:
            raise InputError(
                f"{name} was expected to be at most {high:g}, found {low:g}; set {name.replace('min_', 'max_')} too."
            )


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
            _require_few(name, text.count(",") + 1, default)
            return tuple(_number(name, part, default or ("",)) for part in text.split(","))
        return text if isinstance(default, str) else _number(name, text, (default,))
    except InputError:
        raise
    except (KeyError, ValueError):
        kind = "true or false" if isinstance(default, bool) else "a number" if default is None else f"a value like {default}"
        raise InputError(f"{name} was expected to be {kind}, found '{text}'; correct it.") from None


PRIORS = "priors"
"""At the end of the names of lists that have a value for each order of a polynomial."""


def _require_few(name: str, count: int, default: tuple[Any, ...]) -> None:
    """Raises InputError where a list is longer than it may be, or has none where there are some by default."""
    fixed = name.endswith(PRIORS)
    most = len(default) if fixed else max(MOST_LISTED, 2 * len(default))
    least = most if fixed else min(1, len(default))
    if not least <= count <= most:
        raise InputError(f"{name} was expected as a list of {'' if fixed else f'{least} to '}{most}, found {count}; correct it.")


def _number(name: str, text: str, defaults: tuple[Any, ...]) -> Any:
    """A number like those that stand by default."""
    first = defaults[0]
    if isinstance(first, str):
        return text
    whole = isinstance(first, int) or (first is None and text.isdecimal())
    value: float | int = int(text) if whole else float(text)
    if math.isnan(value):
        raise ValueError(text)
    if value in defaults:
        return value
    _require_in_range(name, value, defaults, text)
    return value


def _require_in_range(name: str, value: float | int, defaults: tuple[Any, ...], said: str) -> None:
    """Raises InputError where a number is beyond reason, beside those that stand by default."""
    first = defaults[0]
    finite = tuple(default for default in defaults if default is None or math.isfinite(default))
    low, high = range_of(name, first) if first is None else (range_of(name, min(finite))[0], range_of(name, max(finite))[1])
    if not low <= value <= high:
        raise InputError(f"{name} was expected to be a number from {low:g} to {high:g}, found {said}; correct it.")


def require_ranges(options: Any) -> None:
    """Raises InputError where a number of options made in Python is beyond what `with_settings` takes."""
    usual = {name: value for name, value, _ in walk(type(options)())}
    for name, value, _ in walk(options):
        numbers, defaults = ((one if isinstance(one, tuple) else (one,)) for one in (value, usual[name]))
        if isinstance(usual[name], tuple):
            _require_few(name, len(numbers), usual[name])
        if not defaults or not all(one is None or _is_number(one) for one in defaults):
            continue
        for number in numbers:
            if _is_number(number) and number not in defaults:
                _require_in_range(name, number, defaults, f"{number:g}")
    _require_ordered(options, "")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def require_ranges_of_parts(options: Any) -> None:
    """`require_ranges` of the options that are part of others, whose own are checked by what takes them."""
    for part in vars(options).values():
        if is_group(part):
            require_ranges(part)


UNITS = {
    "share": (0.0, 1.0),
    "cosine": (-1.0, 1.0),
    "grey": (0.0, 255.0),
    "rad": (0.0, 2 * math.pi),
    "deg": (0.0, 360.0),
    "sigmas": (0.0, 30.0),
}
"""Ranges of values, by the unit that the name of an option ends in."""
SEED, ROUNDS = "seed", ("rounds", "searches")
MOST_ROUNDS, MOST_LISTED, MOST_LEAST = 100, 10, 10_000
MIXED, LEAST_MIXED = "share", 1e-6
"""Of a mixture: what alone is called so has a logarithm, as has what is left of 1."""
SCALES = {
    "smoothing", "sigma", "taper", "along", "block", "scale", "scales", "blur", "side", "priors", "offsets", "per", "false",
    "tried",
}  # fmt: skip
"""Words in names of what is divided by, or steps and sizes are made of: not 0."""


def range_of(name: str, default: float | int | None) -> tuple[float | int, float | int]:
    """Lowest and highest value within reason: those of the unit, else from 0 to 100 times the default or what is said below."""
    last = name.split(".")[-1]
    words = last.split("_")
    if last == SEED:
        return 0, 2**63 - 1
    if last == MIXED:
        return LEAST_MIXED, 1.0 - LEAST_MIXED
    if words[-1] in ROUNDS:
        return 0, MOST_ROUNDS
    if words[0] == "min" and words[-1] not in UNITS:
        # What has to reach it is compared with it, and no more is made.
        return (1, MOST_LEAST) if isinstance(default, int) else (0, 1e12)
    low = 1e-6 * (default or 0.0) if SCALES & set(words) else -math.inf
    if words[-1] not in UNITS and isinstance(default, int):
        # A count, or a size in pixels: time and memory may grow with its square.
        return max(min(20, default // 10) if "side" in words else 0, 0 if words[0] == "max" else 1), max(1000, 10 * default)
    lowest, highest = UNITS.get(words[-1], (0, 100 * max(1.0, default or 0.0)))
    return max(low, lowest), highest
