"""The least cost of lines, poses, cameras and rig from a start, by the engine that takes the problem."""

from collections.abc import Callable
from contextlib import closing

import torch

from camera_models import InputError
from omnilines.adjustment.engine import LineEngine, is_compiled, line_convergence
from omnilines.adjustment.engine_passes import EXACT_FIT
from omnilines.adjustment.engine_solution import line_solution
from omnilines.adjustment.memory import require_for_general
from omnilines.adjustment.parts_engine import PartsEngine, parts_solution
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.adjustment.uncertainty import Task
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, solve
from omnilines.least_squares.devices import moved_to

REWEIGHTED = 1e-6
"""Of the mean cost of an observation, by which new weights may still lower the whole: a step of 1e-3 standard deviations."""


def line_minimum(
    task: Task,
    state: LinesAndPoses,
    prior: PosePrior | None,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
    *,
    place: torch.device,
) -> Minimum[LinesAndPoses]:
    """The least cost from a start, by the engine that takes the problem."""
    problem, loss = LineProblem(task.arcs, task.cost, task.freedom, state, prior), task.loss
    if place.type != "cpu":
        if state.models:
            raise InputError("Cameras are refined on the processor, found the device cuda; use the device cpu.")
        return minimum_on(place, problem, state, loss, max_iterations=max_iterations, callback=callback)
    if task.division is not None:
        with closing(PartsEngine(problem, state, loss, task.division, task.workers)) as parts:
            return parts_solution(parts, parts.minimise(state, max_iterations, callback)).end
    if task.layout is not None and is_compiled(problem, state):
        engine = LineEngine(problem, loss, task.layout)
        return line_solution(engine, engine.minimise(state, max_iterations, callback)).end
    require_for_general(problem.arcs, problem.structure.kept_size)
    if problem.held_weights is not None:
        return _reweighted(problem, state, loss, max_iterations, callback)
    converge = line_convergence(problem, loss)
    found = solve(problem, state, loss, max_iterations=max_iterations, callback=callback, converge=converge)
    return Minimum(found.state, found.outcome, found.cost, found.initial_cost, found.iterations)


def _reweighted(
    problem: LineProblem,
    state: LinesAndPoses,
    loss: Loss | None,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
) -> Minimum[LinesAndPoses]:
    """Solves with weights that are held, formed anew at the end of each, until they no longer change it (`intrinsics.py`)."""
    least = REWEIGHTED / len(problem.arcs)
    found = solve(problem, state, loss, max_iterations=max_iterations, tolerance=least, callback=callback)
    initial, iterations = found.initial_cost, found.iterations
    while found.outcome is Outcome.CONVERGED and iterations < max_iterations:
        again = LineProblem(problem.arcs, problem.cost_name, problem.freedom, found.state, problem.prior)
        left = max_iterations - iterations
        found = solve(again, found.state, loss, max_iterations=left, tolerance=least, callback=callback)
        iterations += found.iterations
        if found.initial_cost - found.cost <= least * found.cost + EXACT_FIT * 2 * len(problem.arcs):
            break
    return Minimum(found.state, found.outcome, found.cost, initial, iterations)


def minimum_on(
    device: torch.device,
    problem: LineProblem,
    state: LinesAndPoses,
    loss: Loss,
    *,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
) -> Minimum[LinesAndPoses]:
    """The iterations of a problem on another device. After each, lines go to their own minima on the processor: where a loss
    leaves arcs out, some need many small steps. Raises InputError where the problem does not fit into the device's memory.
    """
    home = state.chart.phi.device
    arcs, freedom, prior = moved_to(problem.arcs, device), moved_to(problem.freedom, device), moved_to(problem.prior, device)
    require_for_general(arcs, problem.structure.kept_size)
    here, own = line_convergence(problem, loss), moved_to(state, device)

    def converge(there: LinesAndPoses) -> LinesAndPoses:
        return there if here is None else moved_to(here(moved_to(there, home)), device)

    there = LineProblem(arcs, problem.cost_name, freedom, own, prior)
    found = solve(there, own, loss, max_iterations=max_iterations, callback=callback, converge=converge)
    return Minimum(moved_to(found.state, home), found.outcome, found.cost, found.initial_cost, found.iterations)
