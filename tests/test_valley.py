"""Intervals along the floor of a valley: straight, bent, with two lowest places, without an end."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize
import torch

from omnilines.least_squares import KeptGroup, Linearisation, Structure, solve
from omnilines.least_squares.valley import Quantities, curved_intervals

Residuals = Callable[[torch.Tensor], torch.Tensor]
SIGMAS = 1.96


class Fitted:
    """Residuals of two kept parameters and, as it must be, of one eliminated number z that they do not touch."""

    def __init__(self, residuals: Residuals) -> None:
        self.residuals = residuals
        count = len(residuals(torch.zeros(2, dtype=torch.float64)))
        group = KeptGroup(torch.zeros(count, dtype=torch.long), 1, 2)
        self.structure = Structure(torch.zeros(count, dtype=torch.long), 1, 1, (group,))

    def linearise(self, state: tuple[torch.Tensor, float]) -> Linearisation:
        x, z = state
        jacobian = torch.autograd.functional.jacobian(self.residuals, x)
        residual = torch.stack([self.residuals(x), torch.full((self.structure.index.numel(),), z, dtype=torch.float64)], -1)
        own = torch.tensor([0.0, 1.0], dtype=torch.float64).expand(len(residual), 2)[..., None]
        kept = torch.stack([jacobian, torch.zeros_like(jacobian)], 1)
        return Linearisation(residual, own, (kept,))

    def retract(self, state, kept, eliminated):
        return state[0] + kept, state[1] + float(eliminated)

    def gauge(self, state):
        return torch.zeros(2, 0, dtype=torch.float64)


def found_from(residuals: Residuals, *starts: tuple[float, float]):
    """The intervals around the minimum from the first start, with those from the others."""
    problem = Fitted(residuals)
    solutions = [solve(problem, (torch.tensor(start, dtype=torch.float64), 0.0)) for start in starts]
    quantities = Quantities(lambda state: state[0], torch.eye(2, dtype=torch.float64))
    return curved_intervals(problem, solutions[0], solutions[1:], quantities, variance=1.0, sigmas=SIGMAS), solutions


def profile(residuals: Residuals, column: int, value: float) -> float:
    """Least cost with one parameter held, by brute force over the other."""

    def cost(other: float) -> float:
        x = torch.tensor([value, other] if column == 0 else [other, value], dtype=torch.float64)
        return float(residuals(x).square().sum())

    grid = np.linspace(-12, 12, 2401)
    best = grid[np.argmin([cost(other) for other in grid])]
    return scipy.optimize.minimize_scalar(cost, bounds=(best - 0.02, best + 0.02), method="bounded", options={"xatol": 1e-9}).fun


def straight(x: torch.Tensor) -> torch.Tensor:
    return torch.stack([x[0] + x[1] - 1, 0.05 * (x[0] - x[1]) - 0.1, 0.5 * x[0]])


def bent(x: torch.Tensor) -> torch.Tensor:
    """A floor along x1 = exp(x0 / 2), shallow along it."""
    return torch.stack([10 * (x[1] - torch.exp(0.5 * x[0])), 0.8 * (x[0] - 1), 0.2 * (x[1] - 1)])


def double(x: torch.Tensor) -> torch.Tensor:
    """Lowest at x0 = -2 and 2, with a ridge of less than one between."""
    return torch.stack([0.2 * (x[0] ** 2 - 4), 5 * (x[1] - 0.3 * x[0]), 0.01 * x[0]])


def flat(x: torch.Tensor) -> torch.Tensor:
    """Upwards the cost ends below the limit."""
    return torch.stack([1.5 * torch.exp(-x[0]) - 0.3, 5 * (x[1] - x[0])])


def test_a_straight_valley_keeps_its_linear_intervals():
    assert found_from(straight, (0.0, 0.0))[0] is None


@pytest.mark.parametrize("residuals", [bent, double])
@pytest.mark.slow
def test_ends_are_where_the_profile_has_risen_as_far(residuals):
    starts = [(0.5, 0.5)] if residuals is bent else [(-2.1, -0.6), (2.1, 0.6)]
    found, solutions = found_from(residuals, *starts)
    assert found is not None
    least = min(solution.cost for solution in solutions)
    for column in (0, 1):
        low, high = (float(end[column]) for end in found)
        rises = [np.sqrt(profile(residuals, column, end) - least) for end in (low, high)]
        np.testing.assert_allclose(rises, SIGMAS, rtol=0.06)
        if residuals is double:
            assert low < (-2.0, -0.6)[column] and high > (2.0, 0.6)[column]


def test_a_floor_without_an_end_is_open():
    found, _ = found_from(flat, (0.5, 0.5))
    assert found is not None
    assert torch.isinf(found[1]).all() and torch.isfinite(found[0]).all()
