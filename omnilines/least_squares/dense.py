"""Problems that state residuals and Jacobians in blocks, solved with one dense system of what is kept."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.repeatable import total
from omnilines.least_squares.levenberg_marquardt import LEAST_DAMPING, Minimum, Outcome, Progress, S, Step, minimise
from omnilines.least_squares.losses import Loss, LossFunction
from omnilines.least_squares.schur import (
    CellLinearisation,
    Linearisation,
    NormalEquations,
    Reduced,
    back_substitute,
    eliminated_covariance,
    joint_eliminated_covariance,
    normal_equations,
    reduce,
)
from omnilines.least_squares.structure import Structure

LEAST_EIGENVALUE = 1e-13
"""Of the scaled reduced system; below it the observations do not determine everything."""
UNDAMPED_SHARE = 1e-9
"""Of the cost, that an undamped step may promise at the end: a ten thousandth of a variance with 100,000 residuals."""


@runtime_checkable
class Problem(Protocol[S]):
    """Residuals of a state. Whitening and priors are the problem's own affair."""

    structure: Structure

    def linearise(self, state: S) -> Linearisation | CellLinearisation:
        """Residuals and Jacobians with respect to the retraction at zero."""
        ...

    def retract(self, state: S, kept: Float[Tensor, " k"], eliminated: Float[Tensor, "count e"]) -> S:
        """The state moved by a tangent step."""
        ...

    def gauge(self, state: S) -> Float[Tensor, "k g"]:
        """Columns C of the constraints C' dk = 0; none where the observations determine everything."""
        ...


@dataclass(frozen=True)
class Solution(Generic[S]):
    """The state with the least cost found, and how certain it is."""

    state: S
    outcome: Outcome
    cost: float
    """Sum of the loss over all observations (for plain least squares the sum of squared residuals)."""
    initial_cost: float
    iterations: int
    reduced: Reduced
    """The undamped reduced normal equations at the solution."""
    gauge: Float[Tensor, "k g"]
    smallest_eigenvalue: float
    """Of the reduced system scaled to a unit diagonal, on the gauge's complement; about 1e-13 or less means degenerate."""
    weakest_direction: Float[Tensor, " k"]
    """The kept direction of that eigenvalue, in the problem's own units."""

    def kept_covariance(self) -> Float[Tensor, "k k"]:
        """Covariance of the kept parameters for residuals of unit variance, in the gauge of the problem."""
        return constrained_inverse(self.reduced.matrix, self.gauge)

    def eliminated_covariance(self) -> Float[Tensor, "count e e"]:
        """Covariance of every eliminated block for residuals of unit variance, in the gauge of the problem."""
        return eliminated_covariance(self.reduced, self.kept_covariance())

    def joint_eliminated_covariance(self, blocks: Int[Tensor, " b"]) -> Float[Tensor, "be be"]:
        """Covariance of some eliminated blocks together, dense: only for as many as such a matrix can hold."""
        return joint_eliminated_covariance(self.reduced, self.kept_covariance(), blocks)


def _unit_scale(matrix: Tensor) -> Tensor:
    """Factors that bring the diagonal of S to one; a zero diagonal is left as it is."""
    diagonal = torch.diagonal(matrix)
    return torch.where(diagonal > 0, diagonal.clamp_min(1e-300).rsqrt(), torch.ones_like(diagonal))


def constrained_solve(matrix: Float[Tensor, "k k"], gauge: Float[Tensor, "k g"], right: Float[Tensor, " k"]) -> Tensor | None:
    """x with S x = b on the constraint C' x = 0; None when the system is singular."""
    scale = _unit_scale(matrix)
    k, g = gauge.shape
    scaled, target = matrix * scale[:, None] * scale, (right * scale)[:, None]
    if g == 0:
        factor, info = torch.linalg.cholesky_ex(scaled)
        solution = torch.cholesky_solve(target, factor)
    else:
        constraint = gauge * scale[:, None]
        constraint = constraint / constraint.norm(dim=0)
        border = torch.cat([torch.cat([scaled, constraint], 1), torch.cat([constraint.mT, scaled.new_zeros(g, g)], 1)], 0)
        factor, pivots, info = torch.linalg.lu_factor_ex(border)
        solution = torch.linalg.lu_solve(factor, pivots, torch.cat([target, target.new_zeros(g, 1)]))
    usable = int(info) == 0 and bool(torch.isfinite(solution).all())
    return solution[:k, 0] * scale if usable else None


def _complement(matrix: Tensor, gauge: Tensor) -> tuple[Tensor, Tensor]:
    """S scaled to a unit diagonal on an orthonormal basis Z of the gauge's complement: (Z' S Z, scale * Z)."""
    scale = _unit_scale(matrix)
    scaled = matrix * scale[:, None] * scale
    if gauge.shape[1] == 0:
        return scaled, torch.diag(scale)
    basis, _ = torch.linalg.qr(gauge * scale[:, None], mode="complete")
    z = basis[:, gauge.shape[1] :]
    return z.mT @ scaled @ z, scale[:, None] * z


def constrained_inverse(matrix: Float[Tensor, "k k"], gauge: Float[Tensor, "k g"]) -> Float[Tensor, "k k"]:
    """The covariance S^-1 on the complement of the gauge; NaN where the system is singular."""
    inner, basis = _complement(matrix, gauge)
    factor, info = torch.linalg.cholesky_ex(inner)
    if bool(info != 0):
        return torch.full_like(matrix, float("nan"))
    return basis @ torch.cholesky_inverse(factor) @ basis.mT


class DenseEngine(Generic[S]):
    """Any problem: batched products in torch and a dense reduced system."""

    def __init__(self, problem: Problem[S], state: S, loss: LossFunction, converge: Callable[[S], S] | None = None) -> None:
        """`converge` takes the eliminated blocks of a state to lower costs of their own, after every step."""
        self.problem, self.loss, self.converge = problem, loss, converge
        self._trial: tuple[S, Linearisation | CellLinearisation, Tensor] | None = None
        self._at: tuple[S, NormalEquations] | None = None
        self.residuals = 0
        self.residuals = self._linearised(state)[0].residual.numel()

    def _linearised(self, state: S) -> tuple[Linearisation | CellLinearisation, Tensor]:
        """Nearly every step is accepted, so the derivatives are taken along with the residuals and kept for the next one."""
        if self._trial is None or self._trial[0] is not state:
            at = self.problem.linearise(state)
            self._trial = (state, at, self.loss((at.residual**2).sum(-1))[1])
        return self._trial[1:]

    def cost(self, state: S) -> float:
        """Sum of the loss, and of the prior."""
        at, _ = self._linearised(state)
        return total(self.loss((at.residual**2).sum(-1))[0]) + at.prior_cost

    def equations(self, state: S) -> NormalEquations:
        """The normal equations of a state; those of the last one are kept."""
        if self._at is None or self._at[0] is not state:
            self._at = (state, normal_equations(self.problem.structure, *self._linearised(state)))
        return self._at[1]

    def step(self, state: S, damping: float) -> Step[S] | None:
        """The step from a state; None where the equations are singular."""
        equations = self.equations(state)
        reduced = reduce(equations, damping)
        kept = constrained_solve(reduced.matrix, self.problem.gauge(state), reduced.right_side) if reduced.sound else None
        if kept is None:
            return None
        eliminated = back_substitute(reduced, kept)
        trial = self.problem.retract(state, kept, eliminated)
        if self.converge is not None:
            trial = self.converge(trial)
        return Step(trial, self.cost(trial), equations.promised_decrease(kept, eliminated, damping))


def solve(
    problem: Problem[S],
    state: S,
    loss: LossFunction | None = None,
    *,
    max_iterations: int = 100,
    tolerance: float = 1e-12,
    callback: Callable[[Progress], None] | None = None,
    damping: float = 1e-4,
    converge: Callable[[S], S] | None = None,
) -> Solution[S]:
    """Minimise sum loss(|r|^2) of any problem; the options are those of `minimise` and, `converge`, of `DenseEngine`."""
    engine = DenseEngine(problem, state, loss or Loss(), converge)
    found = minimise(engine, state, max_iterations, tolerance=tolerance, callback=callback, damping=damping)
    solution = _finish(problem, found, reduce(engine.equations(found.state), 0.0))
    while solution.outcome is Outcome.CONVERGED and found.iterations < max_iterations and _promises_more(engine, solution):
        left = max_iterations - found.iterations
        onwards = minimise(engine, found.state, left, tolerance=tolerance, callback=callback, damping=LEAST_DAMPING)
        fell = onwards.cost < (1 - UNDAMPED_SHARE) * found.cost
        found = replace(onwards, initial_cost=found.initial_cost, iterations=found.iterations + onwards.iterations)
        solution = _finish(problem, found, reduce(engine.equations(found.state), 0.0))
        if not fell:
            break
    return solution


def _promises_more(engine: DenseEngine[S], solution: Solution[S]) -> bool:
    """Whether the undamped step promises a lower cost where the damped one did not, as on the floor of a flat valley."""
    kept = constrained_solve(solution.reduced.matrix, solution.gauge, solution.reduced.right_side)
    if kept is None:
        return False
    eliminated = back_substitute(solution.reduced, kept)
    promised = engine.equations(solution.state).promised_decrease(kept, eliminated, 0.0)
    return promised > UNDAMPED_SHARE * solution.cost + 1e-30 * max(1, engine.residuals)


def _finish(problem: Problem[S], found: Minimum[S], reduced: Reduced) -> Solution[S]:
    gauge = problem.gauge(found.state)
    smallest, outcome = 0.0, found.outcome
    direction = reduced.right_side.new_zeros(problem.structure.kept_size)
    if reduced.sound:
        inner, basis = _complement(reduced.matrix, gauge)
        values, vectors = torch.linalg.eigh(inner)
        smallest = float(values[0]) if len(values) else 1.0
        direction = basis @ vectors[:, 0] if len(values) else reduced.right_side
    if smallest < LEAST_EIGENVALUE:
        outcome = Outcome.DEGENERATE
    return Solution(
        state=found.state,
        outcome=outcome,
        cost=found.cost,
        initial_cost=found.initial_cost,
        iterations=found.iterations,
        reduced=reduced,
        gauge=gauge,
        smallest_eigenvalue=smallest,
        weakest_direction=direction,
    )
