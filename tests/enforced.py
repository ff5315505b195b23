"""Shapes and types of every signature, enforced while testing: jaxtyping's decorator at a fraction of its price.

jaxtyping binds the arguments of a call to their names and has beartype check each of them twice, before the call and beside the
result. Here beartype wraps the function itself: arguments are checked before the call and the result after it, in one scope of
jaxtyping's axis names, which is what makes "n" the same number throughout a signature. Of the calls of a function with arguments
of one kind the first ones are checked, then every so manieth: a hundred thousand calls of a pose's product tell nothing new.
"""

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable
from typing import Any, get_type_hints

import jaxtyping
import numpy as np
import torch
from jaxtyping._array_types import _MetaAbstractArray
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo, set_shape_memo

MOST, EVERY = 20, 20
"""Calls of a function with arguments of one kind that are all checked; after these every so manieth is."""
OFTEN = 100
"""Calls of a function after which what it is called with is looked at every so manieth time only."""
_jaxtyped = jaxtyping.jaxtyped
_is_instance = _MetaAbstractArray.__instancecheck__
_of_kind: set[tuple[type, type, object]] = set()
"""Annotations with the types and dtypes of arrays that they allow."""


def enforce(packages: list[str]) -> None:
    """Beartype checks every function and data class of packages that are imported from now on."""
    jaxtyping.install_import_hook(packages, "beartype.beartype")
    # The import hook writes `@jaxtyping.jaxtyped(typechecker=...)` before each of them.
    jaxtyping.jaxtyped = _enforced
    _MetaAbstractArray.__instancecheck__ = _is_array


def _enforced(*context: str, typechecker: Callable[..., Any] | None = None) -> Any:
    if context or typechecker is None:
        return _jaxtyped(*context)  # a scope of names of its own: `with jaxtyped("context")`

    def decorate(decorated: Any) -> Any:
        if inspect.isclass(decorated) and dataclasses.is_dataclass(decorated):
            if decorated.__init__.__globals__["__name__"] != __name__:
                decorated.__init__ = _checked(decorated.__init__, typechecker)
            return decorated
        # What a generator yields is none of beartype's business, and is made when the scope of its call has ended.
        if inspect.isfunction(decorated) and not inspect.isgeneratorfunction(decorated):
            return _checked(decorated, typechecker)
        return _jaxtyped(decorated, typechecker=typechecker)

    return decorate


def _is_array(annotation: Any, value: object) -> bool:
    """What jaxtyping answers, which spells the dtype out and looks for it in a list each time; here once for a kind of array."""
    kind = (annotation, type(value), getattr(value, "dtype", None))
    if kind not in _of_kind:
        found = _is_instance(annotation, value)
        if found:
            _of_kind.add(kind)
        return found
    names, batches, trees, arguments = get_shape_memo()
    before = (names.copy(), batches.copy(), trees, arguments)
    if annotation._check_shape(value, names, batches, arguments):
        set_shape_memo(*before)
        return False
    return True


def _kind(value: object) -> object:
    """Arguments that are checked alike: arrays of one type, dtype and number of axes, anything else of one type."""
    kind = type(value)
    if kind is np.ndarray or kind is torch.Tensor:
        return kind, value.dtype, value.ndim  # type: ignore[attr-defined]
    if kind is tuple:
        return kind, *map(_kind, value)  # type: ignore[call-overload]
    return kind


def _checked(function: Any, typechecker: Callable[..., Any]) -> Any:
    call: Callable[..., Any] | None = None
    calls = 0
    passed: dict[tuple[object, ...], int] = {}

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal call, calls
        calls += 1
        if calls > OFTEN and calls % EVERY:
            return function(*args, **kwargs)
        kinds = (*map(_kind, args), *kwargs, *map(_kind, kwargs.values()))
        before = passed.get(kinds, 0)
        if before >= MOST and before % EVERY:
            passed[kinds] = before + 1
            return function(*args, **kwargs)
        if call is None:
            # At the first call: the wrapper takes a millisecond to compile, most functions are called by no test of a file, and
            # what annotations name exists by now.
            call = typechecker(_twin(function))
        push_shape_memo({})
        try:
            result = call(*args, **kwargs)
        finally:
            pop_shape_memo()
        passed[kinds] = before + 1
        return result

    return checked


def _twin(function: Any) -> Any:
    """The function with its annotations resolved; those of the function itself stay as they are written."""
    twin = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    twin.__kwdefaults__, twin.__module__, twin.__qualname__ = function.__kwdefaults__, function.__module__, function.__qualname__
    twin.__annotations__ = {name: _resolved(hint, function) for name, hint in function.__annotations__.items()}
    return twin


def _resolved(hint: Any, function: Any) -> Any:
    """Anything passes for a name that only a type checker imports."""

    def of(value: hint) -> None: ...

    try:
        return get_type_hints(of, function.__globals__, include_extras=True)["value"]
    except NameError:
        return Any
