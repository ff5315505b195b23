"""Types of the arguments of compiled functions, as a table of text holds them, and back.

float64                       a number
float64 2 C                   an array: type of its values, dimensions, layout; `readonly` after it
omnilines.module.NAME 1 C     an array of records, whose NumPy dtype has that name
[int64, int64]                a tuple
{omnilines.module.Class: [float64 2 C, bool]}     a named tuple and its fields
"""

import importlib
from typing import Any

import numba
import numpy as np
from numba import from_dtype

types: Any = numba.types


def written(kind: Any, module: str) -> object:
    """A type of numba as text, lists and mappings; `module` is that of the function, where names of records are looked up.

    Raises TypeError for a type that the table has no way to write.
    """
    if isinstance(kind, types.BaseNamedTuple):
        its = kind.instance_class
        return {f"{its.__module__}.{its.__qualname__}": [written(field, module) for field in kind]}
    if isinstance(kind, types.BaseTuple):
        return [written(field, module) for field in kind]
    if isinstance(kind, types.Array):
        return f"{_named(kind.dtype, module)} {kind.ndim} {kind.layout}{'' if kind.mutable else ' readonly'}"
    return _named(kind, module)


def read(text: Any) -> Any:
    """The type of numba that `written` wrote."""
    if isinstance(text, dict):
        ((name, fields),) = text.items()
        return types.BaseTuple.from_types([read(field) for field in fields], _object(name))
    if isinstance(text, list):
        return types.BaseTuple.from_types([read(field) for field in text])
    name, *about = str(text).split()
    kind = from_dtype(_object(name)) if "." in name else getattr(types, NUMBA_NAMES.get(name, name))
    return types.Array(kind, int(about[0]), about[1], readonly="readonly" in about) if about else kind


NUMBA_NAMES = {"bool": "boolean"}
"""Names of types in the module of numba, where they are others than those it prints."""


def _named(kind: Any, module: str) -> str:
    if isinstance(kind, types.Record):
        for name, value in vars(importlib.import_module(module)).items():
            if isinstance(value, np.dtype) and value.names and from_dtype(value) == kind:
                return f"{module}.{name}"
    if isinstance(kind, types.Number | types.Boolean) and not isinstance(kind, types.Literal):
        return str(kind)
    raise TypeError(f"the table has no way to write the type {kind}, which a function of {module} is called with")


def _object(name: str) -> Any:
    module, _, own = name.rpartition(".")
    return getattr(importlib.import_module(module), own)
