"""Distortion that views which the fit has not seen do not support: it is held at zero and named.

With few views or a narrow lens the terms of a model make up for one another: they grow to values that say nothing of the lens
(k1 = 3, k2 = -20, k3 = 70) and bend the image beyond the data. Of the last term of the model, the last two, and so on, those are
left out without which the held-out error is least. The covariance and the intervals stay those of all terms: so uncertain they
are, and leaving them out makes no parameter better known than the data do. With many corners for each parameter nothing is left
out.
"""

from dataclasses import replace

import torch

from omnilines.calibration.held_out import ViewTerms, held_out
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.thresholds import HeldOutThresholds
from omnilines.least_squares import Solution


def without_unsupported_terms(
    problem: BoardProblem, solution: Solution[CameraAndBoards], thresholds: HeldOutThresholds
) -> tuple[Solution[CameraAndBoards], tuple[str, ...]]:
    """The solution with the unsupported of the model's OPTIONAL_TERMS at zero and the other parameters fitted anew, and a note;
    the same solution without a note where all are supported."""
    state, points = solution.state, problem.points
    if not state.model.OPTIONAL_TERMS or problem.structure.kept_size < thresholds.few_parameters_share * len(points.view):
        return solution, ()
    values = state.model.named_parameters()
    # Each parameter that is estimated moves along a column of its own.
    columns = {name: int(row.argmax()) for name, row in zip(values, problem.basis, strict=True) if bool(row.any())}
    every = ViewTerms.of(problem, state)
    with_all = every.held_out()
    step = torch.zeros(problem.structure.kept_size, dtype=torch.float64)
    tried, held, least = list[str](), list[str](), thresholds.no_worse_factor * with_all.rms_px
    for group in reversed(state.model.OPTIONAL_TERMS):
        tried = [*(name for name in group if name in columns), *tried]
        for name in tried:
            step[columns[name]] = -values[name]
        left = [column for column in range(len(step)) if column not in [columns[name] for name in tried]]
        without = every.moved(step, left).held_out().rms_px
        # One term alone may be missed where several are not: all numbers of terms are tried.
        if without <= least:
            held, least = tried, without
    if not held:
        return solution, ()
    start = _stepped(problem, state, every, {columns[name]: -values[name] for name in held})
    free = [column for column in range(problem.basis.shape[1]) if column not in [columns[name] for name in held]]
    fewer = BoardProblem(points, problem.basis[:, free], problem.weight, state.shape)
    found = fewer.solve(start, max_iterations=300)
    error = held_out(fewer, found.state)
    if error.rms_px > thresholds.no_worse_factor * with_all.rms_px:
        return solution, ()
    at = problem.solve(found.state, max_iterations=0)
    note = (
        f"The distortion {' '.join(held)} is held at 0: each view is predicted by the others no worse without it "
        f"({error.rms_px:.3f} px per point; with it {with_all.rms_px:.3f}). The standard deviations and 95 percent "
        "intervals are those with it free."
    )
    return replace(at, outcome=found.outcome, iterations=solution.iterations + found.iterations), (note,)


def _stepped(problem: BoardProblem, state: CameraAndBoards, terms: ViewTerms, change: dict[int, float]) -> CameraAndBoards:
    """The state with some of the parameters changed, and the others to where they then fit best (to first order)."""
    step = torch.zeros(problem.structure.kept_size, dtype=torch.float64)
    step[list(change)] = torch.tensor(list(change.values()), dtype=torch.float64)
    others = [column for column in range(len(step)) if column not in change]
    matrix = terms.matrix.sum(0)
    scale = matrix.diagonal()[others].clamp_min(1e-300).rsqrt()
    within = matrix[others][:, others] * scale[:, None] * scale
    step[others] = -scale * torch.linalg.solve(within, scale * (matrix @ step)[others])
    return problem.retract(state, step, torch.zeros(problem.points.views, 6, dtype=torch.float64))
