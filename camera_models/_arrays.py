"""NumPy arrays or torch tensors in, the same kind out; float64 throughout."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch

from camera_models.errors import InputError
from camera_models.typed import found

Array = torch.Tensor | np.ndarray

P = ParamSpec("P")
T = TypeVar("T")


def as_tensor(values: Array | Sequence[Any] | float | int, like: torch.Tensor | None = None) -> torch.Tensor:
    """A float64 tensor of `values`, on the device of `like` where one is given; a float64 tensor is returned as it is.

    Raises InputError where they are no real numbers, or rows of different length.
    """
    device = None if like is None else like.device
    try:
        if values.is_complex() if isinstance(values, torch.Tensor) else np.iscomplexobj(values):
            raise TypeError("complex numbers")
        if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
            # Torch takes neither negative strides nor other byte orders, and warns of arrays that are read only.
            usable = values.flags.writeable and values.dtype == np.float64 and values.flags.c_contiguous
            values = values if usable else np.array(values, dtype=np.float64, order="C")
        elif isinstance(values, list | tuple) and any(isinstance(one, torch.Tensor | np.ndarray) for one in values):
            values = torch.stack([as_tensor(one, like) for one in values])
        return torch.as_tensor(values, dtype=torch.float64, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"An array of real numbers was expected, found {found(values)}; correct it.") from None


def vectors(values: Any, sides: int, what: str) -> torch.Tensor:
    """Raises InputError where these are no vectors of so many sides."""
    if not isinstance(values, torch.Tensor) or values.shape[-1:] != (sides,):
        given = f"an array {tuple(values.shape)}" if isinstance(values, torch.Tensor) else type(values).__name__
        raise InputError(f"{what} were expected as an array (..., {sides}), found {given}; give them so.")
    return values


def _to_numpy(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, tuple):
        return tuple(_to_numpy(item) for item in value)
    return value


def array_function(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function written for float64 tensors take NumPy arrays too, and answer in the kind it was asked in.

    Positional arrays and sequences are converted. Tensors come back as NumPy arrays unless an argument was a tensor.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        if any(isinstance(a, torch.Tensor) for a in args):
            converted = [a.to(torch.float64) if isinstance(a, torch.Tensor) and a.is_floating_point() else a for a in args]
            return function(*converted, **kwargs)  # type: ignore[arg-type]
        converted = [as_tensor(a) if isinstance(a, np.ndarray | list | tuple) else a for a in args]
        return _to_numpy(function(*converted, **kwargs))  # type: ignore[arg-type]

    return wrapper
