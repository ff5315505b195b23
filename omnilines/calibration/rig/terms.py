"""Distortion that the corners of a rig do not support is held at zero and named, as of a camera alone (`calibration/terms.py`).

The last of the model's OPTIONAL_TERMS, the last two, and so on: those without which the fit loses least for what they cost. With
W = k' Cov_k^-1 k, the loss of leaving out q terms k in variances of a corner, W - 2 q is least (Akaike 1974); leaving
one view out in turn tells the same in the limit of many views (M. Stone 1977).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.problem import RigState
from omnilines.least_squares import Outcome, solve
from omnilines.least_squares.schur import back_substitute

PER_TERM = 2.0
"""What each term costs (Akaike)."""


def without_unsupported_terms(outcome: RigOutcome) -> RigOutcome:
    """The outcome with the unsupported terms of every camera at zero, all else fitted anew, and a note of each; its covariance is
    that with them free."""
    held = tuple(list[int]() for _ in outcome.data.cameras)
    for member in range(len(outcome.data.cameras)):
        if outcome.solution.outcome is Outcome.CONVERGED and outcome.freedom > 0:
            outcome, own = _of_member(outcome, member, held)
            held[member].extend(own)
    return outcome


def _of_member(outcome: RigOutcome, member: int, held: Sequence[Sequence[int]]) -> tuple[RigOutcome, list[int]]:
    """The outcome without the unsupported terms of one camera, and which columns of its basis these are; `held` are those of all
    cameras that are at zero already."""
    data, state = outcome.data, outcome.solution.state
    camera = data.views.cameras[data.cameras[member]]
    setup, basis, model = outcome.setups[camera], data.bases[member], state.models[member]
    corners = int((outcome.fit.points.camera[outcome.fit.points.view] == member)[outcome.fit.kept].sum())
    few = basis.shape[1] >= outcome.thresholds.held_out.few_parameters_share * corners
    if not (model.OPTIONAL_TERMS and few and setup.variant_open):
        return outcome, []
    values = model.named_parameters()
    first = [sum(own.shape[1] for own in data.bases[:k]) for k in range(len(data.bases))]
    columns = {name: first[member] + int(row.argmax()) for name, row in zip(values, basis, strict=True) if bool(row.any())}
    tail = _unsupported(outcome, member, columns)
    if not tail:
        return outcome, []
    mine = [columns[name] - first[member] for name in tail]
    every = [[*zero, *mine] if k == member else [*zero] for k, zero in enumerate(held)]
    fewer = replace(data, bases=tuple(map(_free, data.bases, every)))
    points = outcome.fit.points.chosen(outcome.fit.kept)
    before = [first[k] + column for k, zero in enumerate(held) for column in zero]
    found = solve(fewer.problem(points), _without(outcome, tail, member, columns, before), max_iterations=300, damping=1e-8)
    lost = (found.cost - outcome.solution.cost) / outcome.factor.value
    if found.outcome is not Outcome.CONVERGED or lost > PER_TERM * len(tail):
        return outcome, []
    at = solve(data.problem(points), found.state, max_iterations=0)
    note = (
        f"Camera {camera}: the distortion {' '.join(tail)} is held at 0: the corners do not support it (chi-square "
        f"{rounded(lost)} of {len(tail)}). The standard deviations are those with it free."
    )
    solution = replace(at, outcome=found.outcome, iterations=outcome.solution.iterations + found.iterations)
    fit = replace(outcome.fit, state=found.state)
    return replace(outcome, solution=solution, fit=fit, notes=(*outcome.notes, note)), mine


def _free(basis: Float[Tensor, "parameters n"], held: Sequence[int]) -> Float[Tensor, "parameters k"]:
    return basis[:, [column for column in range(basis.shape[1]) if column not in held]]


def _unsupported(outcome: RigOutcome, member: int, columns: Mapping[str, int]) -> list[str]:
    """The last groups of terms without which W - 2 q is least, where that is below zero."""
    covariance, model = outcome.kept_covariance, outcome.solution.state.models[member]
    values = model.named_parameters()
    tried, found, least = list[str](), list[str](), 0.0
    for group in reversed(model.OPTIONAL_TERMS):
        tried = [*(name for name in group if name in columns), *tried]
        if not tried:
            continue
        own = [columns[name] for name in tried]
        k = torch.tensor([values[name] for name in tried], dtype=torch.float64)
        cost = float(k @ torch.linalg.solve(covariance[own][:, own], k)) - PER_TERM * len(tried)
        if cost < least:
            found, least = tried, cost
    return found


def _without(outcome: RigOutcome, tail: list[str], member: int, columns: Mapping[str, int], before: Sequence[int]) -> RigState:
    """The state with these terms at zero, and the other kept parameters, but for those `before`, where they then fit best (to
    first order)."""
    problem, matrix = outcome.solution.reduced.equations.structure, outcome.solution.reduced.matrix
    values = outcome.solution.state.models[member].named_parameters()
    step = torch.zeros(problem.kept_size, dtype=torch.float64)
    own = [columns[name] for name in tail]
    step[own] = torch.tensor([-values[name] for name in tail], dtype=torch.float64)
    others = [column for column in range(len(step)) if column not in own and column not in before]
    scale = matrix.diagonal()[others].clamp_min(1e-300).rsqrt()
    within = matrix[others][:, others] * scale[:, None] * scale
    step[others] = -scale * torch.linalg.solve(within, scale * (matrix @ step)[others])
    frames = back_substitute(outcome.solution.reduced, step) - back_substitute(outcome.solution.reduced, 0 * step)
    points = outcome.fit.points.chosen(outcome.fit.kept)
    return outcome.data.problem(points).retract(outcome.solution.state, step, frames)
