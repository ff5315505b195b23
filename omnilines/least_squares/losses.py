"""Robust losses of the squared norm s of an observation's whitened residual: cost = sum rho(s), weight = rho'(s)."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from camera_models.errors import InputError

LossFunction = Callable[[Tensor], tuple[Tensor, Tensor]]


def _none(s: Tensor) -> tuple[Tensor, Tensor]:
    return s, torch.ones_like(s)


def _huber(s: Tensor) -> tuple[Tensor, Tensor]:
    root = s.clamp_min(1e-300).sqrt()
    return torch.where(s <= 1, s, 2 * root - 1), torch.where(s <= 1, torch.ones_like(s), 1 / root)


def _cauchy(s: Tensor) -> tuple[Tensor, Tensor]:
    return torch.log1p(s), 1 / (1 + s)


# From the plainest to the one that forgives most.
LOSSES: tuple[tuple[str, LossFunction], ...] = (("none", _none), ("huber", _huber), ("cauchy", _cauchy))


@dataclass(frozen=True)
class Loss:
    """A loss by name, of this scale in the unit of the residual; `none` is plain least squares."""

    name: str = "none"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in dict(LOSSES):
            raise InputError(f"A loss is one of {', '.join(dict(LOSSES))}, found '{self.name}'; choose one of these.")
        if not self.scale > 0:
            raise InputError(f"The scale of a loss is a positive number, found {self.scale}; give one.")

    def __call__(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and weight of each squared residual norm."""
        cost, weight = dict(LOSSES)[self.name](s / self.scale**2)
        return cost * self.scale**2, weight
