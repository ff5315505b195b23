"""How certain an adjustment is: the noise of the end points, and the normal equations that all covariances come from."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.repeatable import total
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.datum import constraint, known_of_poses
from omnilines.adjustment.engine import LineEngine
from omnilines.adjustment.engine_layout import Layout
from omnilines.adjustment.engine_solution import LineSolution, line_solution
from omnilines.adjustment.noise import Noise, fitting
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.parts import Division
from omnilines.adjustment.parts_engine import PartsEngine, PartsSolution, Workers, parts_solution
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.adjustment.weighting import Weighting, weighting
from omnilines.costs import WHITENED, cost_function
from omnilines.least_squares import Linearisation, Loss, Minimum, Solution, solve
from omnilines.least_squares.dense import constrained_inverse
from omnilines.least_squares.sandwich import Sandwich
from omnilines.least_squares.schur import eliminated_covariance, joint_eliminated_covariance, normal_equations

LEAST_REDUNDANCY = 1e-6
"""Degrees of freedom below which nothing is left over that tells the noise."""


@dataclass(frozen=True)
class Task:
    """What is adjusted, and how."""

    arcs: MatchedArcs
    cost: str
    freedom: Freedom
    loss: Loss
    layout: Layout | None
    """Of the compiled engine, where that takes the problem."""
    cautious: bool = False
    """Whether the noise is what all residuals show, also those of arcs that stand out, whatever is stated."""
    options: AdjustmentOptions = AdjustmentOptions()
    division: Division | None = None
    """Into parts that are adjusted apart, where the scene is divided."""
    workers: Workers = Workers()
    """Of the parts."""

    @property
    def stated(self) -> bool:
        """Whether the noise of the arcs is stated, to be used as it is."""
        return self.arcs.sigma_known and not self.cautious

    def seen_by(self, state: LinesAndPoses) -> "Task":
        """With the arcs as the cameras of a state see them, where these are refined."""
        return replace(self, arcs=self.arcs.seen_by(state.models)) if state.models else self

    def weights(self, state: LinesAndPoses, level: float, informing: Bool[Tensor, " n"] | None = None) -> Weighting:
        """What the arcs weigh at a state for noise of this level."""
        return weighting(self.cost, self.arcs, state.normals(self.arcs), self.loss, level, fitting=informing)


@dataclass(frozen=True)
class Uncertain:
    """A solution, the noise, and equations whose covariances are for it but for a factor."""

    found: Minimum[LinesAndPoses]
    problem: LineProblem
    equations: "GeneralSolution | LineSolution | PartsSolution"
    noise: Noise
    scale: float


@dataclass(frozen=True)
class GeneralSolution(Solution[LinesAndPoses]):
    """The general engine's normal equations, for residuals of unequal variance, or of the variance `unit`, which is that of the
    prior in either case."""

    datum: Float[Tensor, "k g"]
    """C of the constraint C' dk = 0 that covariances are for (`least_squares/datum.py`)."""
    unit: float = 1.0
    sandwich: Sandwich | None = None
    by_prior: Float[Tensor, "k k"] | None = None
    """P'P of the prior."""

    def absorbed(self, parameters: int) -> float:
        """Sum of the squared residuals of the noise of the arcs that so many free parameters take up."""
        if self.sandwich is not None:
            return self.sandwich.trace()
        return self.unit * (parameters - self.prior_share())

    def prior_share(self) -> float:
        """Parameters that the prior determines, tr(H^-1 P'P)."""
        return 0.0 if self.by_prior is None else total(self.inverse * self.by_prior)

    @cached_property
    def inverse(self) -> Float[Tensor, "k k"]:
        """S^-1 on the constraint."""
        return constrained_inverse(self.reduced.matrix, self.datum)

    def kept_covariance(self) -> Float[Tensor, "k k"]:
        """Of frames, rig and cameras together."""
        return self._with_prior.kept if self.sandwich is not None else self.unit * self.inverse

    def eliminated_covariance(self) -> Float[Tensor, "count e e"]:
        """Of every line."""
        return (
            self._with_prior.eliminated()
            if self.sandwich is not None
            else self.unit * eliminated_covariance(self.reduced, self.inverse)
        )

    def joint_eliminated_covariance(self, blocks: Int[Tensor, " b"]) -> Float[Tensor, "be be"]:
        """Of some lines together."""
        if self.sandwich is not None:
            return self._with_prior.joint(blocks)
        return self.unit * joint_eliminated_covariance(self.reduced, self.inverse, blocks)

    @cached_property
    def _with_prior(self) -> Sandwich:
        assert self.sandwich is not None
        if self.by_prior is None:
            return self.sandwich
        scores = self.sandwich.scores
        return replace(self.sandwich, scores=replace(scores, kept=scores.kept + self.unit * self.by_prior))


def uncertainty(
    task: Task, found: Minimum[LinesAndPoses], prior: PosePrior | None = None, level: float | None = None
) -> Uncertain:
    """The noise that the residuals of a solution show, and its equations.

    `prior` is that of the solution, weighed for noise of `level`; the noise that is found may be another one.
    """
    task = task.seen_by(found.state)
    if task.loss.name != "none":
        return _robust(task, found, prior, level)
    at = 1.0 if level is None else level
    weights = task.weights(found.state, at)
    problem, equations = _equations(task, found.state, weights, prior)
    parameters = _parameters(problem, found.state)
    redundancy = 2 * len(task.arcs) - parameters + equations.prior_share()
    left = weights.expected - equations.absorbed(parameters)
    measured = math.nan
    if redundancy > LEAST_REDUNDANCY and left > 0:
        measured = at * math.sqrt(max(found.cost - _prior_cost(problem, found.state), 0.0) / left)
    noise = Noise(measured, weights.share * redundancy, task.stated, task.options.significance)
    if prior is None:
        return Uncertain(found, problem, equations, noise, (noise.level / at) ** 2)
    return _for_other_noise(task, Uncertain(found, problem, equations, noise, 1.0), weights, prior, at)


def _for_other_noise(task: Task, done: Uncertain, weights: Weighting, prior: PosePrior | None, at: float) -> Uncertain:
    """Where the noise is another one than the prior was weighed for: the weights of the solution, and what they make of that
    noise."""
    level = done.noise.level
    if not math.isfinite(level) or level == at or not task.stated:
        return replace(done, scale=1.0 if math.isfinite(level) else math.nan)
    eye = torch.eye(2, dtype=torch.float64).expand(len(task.arcs), 2, 2)
    scatter = (level / at) ** 2 * (weights.unit * eye if weights.scatter is None else weights.scatter)
    problem, equations = _equations(task, done.found.state, replace(weights, scatter=scatter), prior)
    return replace(done, problem=problem, equations=equations)


def _robust(task: Task, found: Minimum[LinesAndPoses], prior: PosePrior | None, level: float | None) -> Uncertain:
    """With a robust loss: the noise of the arcs that do not stand out; the others weigh what the loss gives them."""
    state, arcs = found.state, task.arcs
    whitened = cost_function(WHITENED, arcs)(arcs.bearings, state.normals(arcs))[0].detach()
    plain = LineProblem(arcs, WHITENED, task.freedom, state, prior)
    taken, least, significance = float(_parameters(plain, state)), 1.0 if task.stated else 0.0, task.options.significance
    fits = torch.isfinite(whitened).all(-1) if task.cautious else fitting(whitened, taken, least, significance)
    if level is None:
        noise = _noise_of(task, state, whitened, fits, taken)
        weights = task.weights(state, noise.level if math.isfinite(noise.level) else 1.0, fits)
        problem, equations = _equations(task, state, weights, prior)
        return Uncertain(found, problem, equations, noise, 1.0 if math.isfinite(noise.level) else math.nan)
    weights = task.weights(state, level, fits)
    problem, equations = _equations(task, state, weights, prior)
    taken -= equations.prior_share()
    if not task.cautious:
        fits = fitting(whitened, taken, least, significance)
    noise = _noise_of(task, state, whitened, fits, taken)
    return _for_other_noise(task, Uncertain(found, problem, equations, noise, 1.0), weights, prior, level)


def _noise_of(task: Task, state: LinesAndPoses, whitened: Float[Tensor, "n 2"], fits: Bool[Tensor, " n"], taken: float) -> Noise:
    """The noise of the arcs that fit, which have decided so many parameters. An estimate that spreads `excess` times as much
    as the best one leaves so much more of its errors in the residuals; the loss sees these, which are smaller than the noise."""
    count, square, stated = 2 * int(fits.sum()), total(whitened[fits].square()), task.stated
    redundancy = count - taken
    if redundancy <= LEAST_REDUNDANCY:
        return Noise(math.nan, redundancy, stated, task.options.significance)
    left = redundancy + (task.weights(state, math.sqrt(square / count), fits).excess - 1) * taken
    return Noise(math.sqrt(square / left), redundancy, stated, task.options.significance)


def _equations(
    task: Task, state: LinesAndPoses, weights: Weighting, prior: PosePrior | None
) -> tuple[LineProblem, GeneralSolution | LineSolution | PartsSolution]:
    """The weighted equations at a state."""
    problem = LineProblem(task.arcs, WHITENED, task.freedom, state, prior, mix=weights.mix)
    known = known_of_poses(problem, state)
    if task.division is not None:
        assert weights.scatter is None, "the whitened cost weighs arcs by their noise"
        parts = PartsEngine(problem, state, Loss(), task.division, task.workers)
        return problem, parts_solution(parts, parts.minimise(state, 0), weights.unit, known)
    if task.layout is not None:
        engine = LineEngine(problem, Loss(), task.layout)
        return problem, line_solution(engine, engine.minimise(state, 0), weights.scatter, weights.unit, known)
    plain = solve(problem, state, max_iterations=0)
    solution = GeneralSolution(**vars(plain), unit=weights.unit, datum=constraint(problem, state, known))
    at = problem.linearise(state)
    if at.prior is not None:
        solution = replace(solution, by_prior=at.prior.by_kept.mT @ at.prior.by_kept)
    if weights.scatter is None:
        return problem, solution
    values, vectors = torch.linalg.eigh(weights.scatter)
    root = vectors @ torch.diag_embed(values.clamp_min(0).sqrt()) @ vectors.mT
    spread = Linearisation(at.residual, root @ at.by_eliminated, tuple(root @ by_kept for by_kept in at.by_kept))
    scores = normal_equations(problem.structure, spread, torch.ones(len(task.arcs), dtype=root.dtype))
    return problem, replace(solution, sandwich=Sandwich(solution.reduced, solution.inverse, scores))


def _parameters(problem: LineProblem, state: LinesAndPoses) -> int:
    """Number of free parameters."""
    arcs, held = problem.arcs, problem.freedom.held_lines
    observed = torch.bincount(arcs.track, minlength=arcs.tracks) > 0
    moving = observed if held is None else observed & ~held
    return 4 * int(moving.sum()) + problem.structure.kept_size - problem.gauge(state).shape[1]


def _prior_cost(problem: LineProblem, state: LinesAndPoses) -> float:
    if problem.prior is None or not len(problem.free):
        return 0.0
    return total(problem.prior.residual(state.rig_from_world)[0][problem.free].square())
