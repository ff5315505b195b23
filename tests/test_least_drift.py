"""The least drift that explains scores: closed forms and a general minimiser."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch

from omnilines.calibration.lines.least_drift import least_drift
from omnilines.calibration.lines.scores import pseudo_inverse


def test_one_parameter_gives_how_far_it_is_off_less_what_chance_makes() -> None:
    information, noise, off, moves_px, limit = 50.0, 0.02, 0.1, 3.0, 9.0
    score, precision = torch.tensor([-information * off]), torch.tensor([[1.0 / (information * noise) ** 2]])
    found = least_drift(
        score.double(), precision.double(), torch.tensor([[information]]).double(), torch.eye(1).double() * 9, limit
    )
    assert found == pytest.approx(moves_px * (off - math.sqrt(limit) * noise), rel=1e-9)
    assert (
        least_drift(score.double() * 0.5, precision.double(), torch.eye(1).double() * information, torch.eye(1).double(), limit)
        == 0.0
    )


@pytest.mark.parametrize("seen", [5, 3])
def test_no_change_moves_the_image_less(seen: int) -> None:
    """Against a minimiser with constraints; also where lines do not see all parameters."""
    random = np.random.default_rng(seen)
    rows, moves = random.normal(size=(seen, 5)), random.normal(size=(7, 5)) * [30.0, 1.0, 1.0, 0.1, 3.0]
    information, motion = rows.T @ rows, moves.T @ moves / 7
    spread = rows.T @ np.diag(random.uniform(0.5, 2.0, seen)) @ rows
    precision = pseudo_inverse(torch.from_numpy(spread)).numpy()
    score, limit = information @ random.normal(size=5) * 9.0, 7.0

    def excess(e: np.ndarray) -> float:
        """Of the limit."""
        return limit - float((score + information @ e) @ precision @ (score + information @ e))

    start = -np.linalg.pinv(information) @ score
    best = scipy.optimize.minimize(
        lambda e: e @ motion @ e, start, jac=lambda e: 2 * motion @ e, method="SLSQP", options={"maxiter": 500, "ftol": 1e-12},
        constraints=[{"type": "ineq", "fun": excess}],
    )  # fmt: skip
    assert best.success and excess(np.zeros(5)) < 0
    found = least_drift(*(torch.from_numpy(one) for one in (score, precision, information, motion)), limit)
    assert found == pytest.approx(math.sqrt(best.fun), rel=1e-4)


def test_what_is_hardly_seen_hides_no_drift() -> None:
    """One parameter is off by ten standard deviations; the other moves the image much, but lines hardly tell it."""
    information, noise = (
        torch.diag(torch.tensor([1.0, 1e-4], dtype=torch.float64)),
        torch.tensor([0.1, 1e-3], dtype=torch.float64),
    )
    score, precision = -information @ torch.tensor([1.0, 0.0], dtype=torch.float64), torch.diag(noise**-2)
    found = least_drift(score, precision, information, torch.diag(torch.tensor([1.0, 4.0], dtype=torch.float64)), 9.0)
    assert found == pytest.approx(1.0 - 3.0 * 0.1, rel=1e-9)
