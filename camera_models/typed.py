"""What callers give is of the types that signatures and fields state: where it is not, one sentence says so before any work.

    @typed
    def extract(photos: Photos, camera: CameraModel | Calibration) -> PhotoArcs: ...

    @dataclass(frozen=True)
    class Segments(Typed): ...

Annotations are the only statement of what is allowed: classes, unions, tuples, sequences and mappings, and jaxtyping's arrays,
whose named sides have one length in all fields of a record. A whole number is a float too, a list a tuple; a float that is not a
number (NaN) is none.
"""

import collections.abc
import functools
import inspect
import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, asdict, dataclass, fields
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar

from camera_models.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")
SINGLE = ("float32", "float16", "bfloat16")
"""All numbers are of double precision: others would meet them half way through, and fail there."""
NUMBERS = {"Float": "float64", "Int": "whole numbers", "Bool": "true and false"}
"""Kinds of jaxtyping's arrays in words."""


def typed(function: Callable[P, T]) -> Callable[P, T]:
    """Refuse arguments of another kind than the signature states. Raises InputError."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        kinds = _kinds_of(function)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # which says what is wrong with the call, by its name
        from jaxtyping import jaxtyped

        for name, value in given.items():
            variable = signature.parameters[name].kind in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
            if name in kinds and not variable:
                with jaxtyped("context"):  # axes have the names of this signature, not of a caller's that is checked too
                    _require(value, kinds[name], name, function.__name__)
        return function(*args, **kwargs)

    return checked


class Typed:
    """Of a dataclass: its fields are of the kinds that it states. Raises InputError."""

    def __post_init__(self) -> None:
        require_fields(self)


@dataclass(frozen=True)
class Options(Typed):
    """Of a dataclass of options, made with `repr=False`: signatures, help and interpreters show what is not as by default."""

    def __repr__(self) -> str:
        """Only what was changed."""
        changed = (f"{one.name}={value!r}" for one in fields(self) if (value := getattr(self, one.name)) != _default(one))
        return f"{type(self).__name__}({', '.join(changed)})"

    @property
    def stated(self) -> str:
        """All values, for what a result was made from."""
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in asdict(self).items())})"


def _default(one: Field[Any]) -> Any:
    return one.default if one.default_factory is MISSING else one.default_factory()


def require_fields(record: Any) -> None:
    """Raises InputError where a field of a dataclass or a NamedTuple is of another kind than it states."""
    from jaxtyping import jaxtyped  # not with the command line, which makes no record

    kind: Any = type(record)
    kinds = _kinds_of(kind)
    names = getattr(record, "_fields", None) or [field.name for field in fields(record)]
    with jaxtyped("context"):
        for name in names:
            value = getattr(record, name)
            _require(value, kinds[name], name, type(record).__name__)
            if isinstance(value, tuple) and hasattr(value, "_fields"):
                require_fields(value)


@functools.cache
def _kinds_of(what: Any) -> dict[str, Any]:
    return typing.get_type_hints(what)


def _require(value: Any, kind: Any, name: str, owner: str) -> None:
    if not is_of(value, kind):
        raise InputError(f"`{name}` of {owner} was expected as {said(kind)}, found {found(value)}; give one.")


def is_of(value: Any, kind: Any) -> bool:
    """Whether a value is of the kind that an annotation states."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any or isinstance(kind, TypeVar):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(is_of(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        return isinstance(value, tuple | list) and _are_of(value, inner)
    if origin is collections.abc.Callable:
        return callable(value)
    if origin is not None and issubclass(origin, Mapping):
        keys, values = inner
        return isinstance(value, origin) and all(is_of(k, keys) and is_of(v, values) for k, v in value.items())
    if origin is not None and issubclass(origin, collections.abc.Iterable):
        return isinstance(value, origin) and not isinstance(value, str) and all(is_of(one, inner[0]) for one in value)
    return _is_plain(value, kind)


def _are_of(values: tuple[Any, ...] | list[Any], kinds: tuple[Any, ...]) -> bool:
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        if kinds[0] in (str, int):  # names of millions of lines: one of each type will do
            values = list({type(one): one for one in values}.values())
        return all(is_of(one, kinds[0]) for one in values)
    return len(values) == len(kinds) and all(map(is_of, values, kinds))


def _is_plain(value: Any, kind: Any) -> bool:
    if kind is bool:
        return type(value).__name__ in ("bool", "bool_")
    if kind in (int, float) and type(value) is bool:
        return False
    if kind is float:
        return isinstance(value, Real) and not math.isnan(value)
    if kind is int:
        return isinstance(value, Integral)
    if _is_array(kind):
        return isinstance(value, kind) and _number(value) not in SINGLE
    return isinstance(value, kind or types.NoneType)


def _is_array(kind: Any) -> bool:
    """Whether that is an annotation of jaxtyping."""
    return isinstance(kind, type) and hasattr(kind, "dim_str") and hasattr(kind, "array_type")


def _number(array: Any) -> str:
    # NumPy writes text as <U1.
    name = array.dtype.type.__name__.rstrip("_") if hasattr(array.dtype, "type") else str(array.dtype)
    return name.removeprefix("torch.")


def said(kind: Any) -> str:
    """A kind in words."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        parts = list(dict.fromkeys(map(said, inner)))
        return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} or {parts[-1]}"
    if origin is tuple:
        return f"({', '.join('...' if one is Ellipsis else said(one) for one in inner)})"
    if origin is not None and origin is not Literal:
        name = {collections.abc.Callable: "a function"}.get(origin, origin.__name__)
        return name if name == "a function" else f"{name} of {' and '.join(map(said, inner))}"
    if _is_array(kind):
        library = "torch" if kind.array_type.__module__.startswith("torch") else "NumPy"
        number = NUMBERS.get(kind.__name__.split("[")[0], "numbers")
        return f"an array of {library} ({', '.join(kind.dim_str.split())}) of {number}"
    return "None" if kind in (None, types.NoneType) else getattr(kind, "__name__", str(kind))


def found(value: Any) -> str:
    """A value in words: arrays by their shape, short values as they are."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{type(value).__name__} {tuple(value.shape)} of {_number(value)}"
    if isinstance(value, str | int | float | tuple | list) and len(repr(value)) <= 60:
        return repr(value)
    return type(value).__name__
