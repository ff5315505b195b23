"""Lines of unequal noise: how it scatters is found again, and covariances hold for the noise of each line."""

import math

import numpy as np
import pytest
from scipy.special import chdtri, fdtri

from omnilines.adjustment.own_noise import line_factors, scattered_variances

LINES = 4000


def drawn(own: float, usual: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variances of lines, sums of squares of their residuals, and the degrees of freedom of these."""
    random = np.random.default_rng(seed)
    variance = np.full(LINES, usual) if math.isinf(own) else own * usual / random.chisquare(own, LINES)
    freedom = random.choice([2.0, 4.0, 6.0, 12.0], LINES)
    return variance, variance * random.chisquare(freedom), freedom


@pytest.mark.parametrize(("own", "usual"), [(3.0, 0.4), (5.0, 1.0), (8.0, 2.0)])
def test_the_scatter_of_the_noise_is_found(own: float, usual: float) -> None:
    _, square, freedom = drawn(own, usual, 0)
    found, about = scattered_variances(square / freedom, freedom)
    assert found == pytest.approx(own, rel=0.25)
    assert about == pytest.approx(usual, rel=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_equal_noise_is_not_taken_for_unequal(seed: int) -> None:
    """Half of the draws scatter a little more than the mean of all draws: what is made of that is next to nothing."""
    _, square, freedom = drawn(math.inf, 0.7, seed)
    factor = line_factors(square, freedom, math.sqrt(0.7))
    assert factor.std() < 0.1 and abs(factor.mean() - 1.0) < 0.1


@pytest.mark.parametrize("own", [3.0, 8.0])
def test_ellipsoids_hold_for_the_noise_of_each_line(own: float) -> None:
    """Errors of four coordinates of each line, drawn with its own noise, against covariances for the noise of all."""
    variance, square, freedom = drawn(own, 1.0, 1)
    level = math.sqrt(square.sum() / freedom.sum())
    error = variance * np.random.default_rng(2).chisquare(4.0, LINES)
    limit = chdtri(4, 0.05)
    factor = line_factors(square, freedom, level)
    inside = error < limit * level**2 * factor
    assert 0.94 < inside.mean() < 0.96
    # Quiet lines and noisy ones alike, which one noise for all can't.
    noisy = square / freedom > np.quantile(square / freedom, 0.8)
    assert 0.92 < inside[noisy].mean() < 0.98 and 0.92 < inside[~noisy].mean() < 0.98
    assert (error < limit * level**2)[noisy].mean() < 0.9


def test_few_lines_and_lines_of_two_arcs_tell_nothing_of_their_own() -> None:
    assert (line_factors(np.arange(9.0), np.full(9, 4.0), 1.0) == 1.0).all()
    variance, square, freedom = drawn(3.0, 1.0, 3)
    freedom[0], square[0] = 0.0, 1e-20
    factor = line_factors(square, freedom, 1.0)
    # What all lines tell is left, and the widest intervals.
    assert factor[0] == pytest.approx(4.0 * fdtri(4, 3.0, 0.95) / chdtri(4, 0.05), rel=0.1)
    assert variance.mean() < factor[0]
