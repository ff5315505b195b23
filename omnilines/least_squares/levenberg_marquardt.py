"""Levenberg-Marquardt on arrow-structured manifold blocks. It knows no camera and no line.

K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares problems, 2004, with Marquardt's scaling; the gauge
is fixed by constraints on the kept step, C' dk = 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar, runtime_checkable

S = TypeVar("S")

LEAST_DAMPING = 1e-15


class Outcome(Enum):
    """How a solution ended; the value is a sentence for people."""

    CONVERGED = "The cost no longer decreases and the gradient vanishes."
    STALLED = "No step decreases the cost although the gradient does not vanish."
    DEGENERATE = "The observations do not determine all parameters."
    OUT_OF_ITERATIONS = "The limit of iterations was reached before convergence."


@dataclass(frozen=True)
class Progress:
    """What a callback is told after every iteration."""

    iteration: int
    cost: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Step(Generic[S]):
    """Where a damped step leads."""

    state: S
    cost: float
    promised: float
    """Decrease of the cost that the linear model promises."""


@runtime_checkable
class Engine(Protocol[S]):
    """Whoever evaluates a problem and solves its damped normal equations; the loss is its own affair."""

    residuals: int
    """Number of residuals."""

    def cost(self, state: S) -> float:
        """Sum of the loss, and of the prior."""
        ...

    def step(self, state: S, damping: float) -> Step[S] | None:
        """The step from a state; None where the equations are singular."""
        ...


@dataclass(frozen=True)
class Minimum(Generic[S]):
    """Where the iterations ended."""

    state: S
    outcome: Outcome
    cost: float
    initial_cost: float
    iterations: int


def minimise(
    engine: Engine[S],
    state: S,
    max_iterations: int = 100,
    *,
    tolerance: float = 1e-12,
    callback: Callable[[Progress], None] | None = None,
    damping: float = 1e-4,
) -> Minimum[S]:
    """Iterate. Converged when the decrease that the linear model promises is below `tolerance` of the cost.

    `damping` is Marquardt's at first: the smaller, the nearer the first step is to that of Gauss and Newton.
    """
    cost = initial = engine.cost(state)
    growth = 2.0
    outcome = Outcome.OUT_OF_ITERATIONS
    iteration = 0
    # Residuals at rounding level are an exact fit: nothing is left to decrease.
    floor = 1e-30 * max(1, engine.residuals)
    while iteration < max_iterations:
        iteration += 1
        step = engine.step(state, damping)
        if step is None:
            damping, growth = max(damping, 1e-12) * growth, growth * 2
            if damping > 1e12:
                outcome = Outcome.DEGENERATE
                break
            continue
        if step.promised <= tolerance * cost + floor:
            outcome = Outcome.CONVERGED
            if not step.promised > 0:
                break
        accepted = step.cost < cost
        if callback is not None:
            callback(Progress(iteration, min(cost, step.cost), damping, accepted))
        if accepted:
            ratio = (cost - step.cost) / step.promised
            damping, growth = max(damping * max(1 / 10, 1 - (2 * ratio - 1) ** 3), LEAST_DAMPING), 2.0
            state, cost = step.state, step.cost
        else:
            damping, growth = damping * growth, growth * 2
        if outcome is Outcome.CONVERGED:
            break
        if damping > 1e16:
            outcome = Outcome.STALLED
            break
    return Minimum(state, outcome, cost, initial, iteration)
