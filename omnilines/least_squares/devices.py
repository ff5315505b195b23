"""Where tensors are worked on: the processor, or a GPU by name as torch knows it."""

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from camera_models.errors import InputError

T = TypeVar("T")

DEVICES = ("cpu", "cuda")


def usable_device(name: str) -> torch.device:
    """The device of that name, `cpu` or `cuda`. Raises InputError on another name and where no GPU can be used."""
    if name not in DEVICES:
        raise InputError(f"A device is one of {', '.join(DEVICES)}, found '{name}'; choose one of these.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("A GPU that PyTorch can use was expected for the device cuda, found none; use the device cpu.")
    return torch.device(name)


def moved_to(value: T, device: torch.device) -> T:
    """A tensor, or a dataclass or tuple of such, on a device; anything else as it is."""
    found: Any = value
    if isinstance(value, Tensor):
        found = value.to(device)
    elif isinstance(value, tuple):
        found = tuple(moved_to(part, device) for part in value)
    elif is_dataclass(value) and not isinstance(value, type):
        found = replace(value, **{field.name: moved_to(getattr(value, field.name), device) for field in fields(value)})
    return found


def free_bytes(device: torch.device) -> int | None:
    """Free memory of a GPU; None for the processor."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else None
