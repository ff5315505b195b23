"""The inverse of a map of the plane that is one-to-one on a disc about the origin, where plain Newton steps do not find it."""

from collections.abc import Callable
from typing import Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

DAMPED_STEPS = 60


@runtime_checkable
class Image(Protocol):
    """Where a map takes points; with it comes what else the step needs."""

    @property
    def x(self) -> Tensor: ...

    @property
    def y(self) -> Tensor: ...


At = TypeVar("At", bound=Image)


def damped_newton(
    image: Callable[[Tensor, Tensor], At],
    step_back: Callable[[At, Tensor, Tensor], tuple[Tensor, Tensor]],
    largest: float,
    target: Tensor,
    plane: Tensor,
) -> tuple[Tensor, Tensor]:
    """Newton with step halving from any point of the disc, kept inside it; whether it converged is told by the residual.

    `step_back` is the inverse of the Jacobian times a residual.
    """

    def value(p: Tensor) -> tuple[At, Tensor]:
        at = image(p[..., 0], p[..., 1])
        return at, torch.stack([at.x, at.y], -1) - target

    at, residual = value(plane)
    error = residual.norm(dim=-1)
    for _ in range(DAMPED_STEPS):
        step = torch.stack(step_back(at, *residual.unbind(-1)), -1)
        best, best_error = plane, error
        for shrink in (1.0, 0.5, 0.125, 0.02):
            trial = plane - shrink * step
            trial = trial * torch.clamp(largest / trial.norm(dim=-1, keepdim=True).clamp_min(1e-300), max=1.0)
            trial_error = value(trial)[1].norm(dim=-1)
            better = trial_error < best_error
            best = torch.where(better[..., None], trial, best)
            best_error = torch.where(better, trial_error, best_error)
            if bool((better | (error == 0)).all()):
                break
        stalled = bool((best_error >= error).all())
        plane, error = best, best_error
        at, residual = value(plane)
        if stalled:
            break
    return plane, error < 1e-9 * (1 + target.norm(dim=-1))
