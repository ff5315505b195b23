"""The factor of a covariance: stated noise and its test, and Student's t."""

import math

import numpy as np
import pytest

from omnilines.least_squares.variance import variance_factor

DOUBT = 0.01


def test_stated_noise_is_used_where_the_residuals_do_not_contradict_it() -> None:
    """Over many seeds the test fires as rarely as it says; residuals too large fire it, small ones do not shrink the factor."""
    rng = np.random.default_rng(1)
    squares = (rng.standard_normal((4000, 12)) ** 2).sum(-1) * 0.09
    factors = [variance_factor(float(s), 12, 0.09, DOUBT) for s in squares]
    refused = [f for f in factors if not f.holds]
    assert 0.4 * DOUBT < len(refused) / len(factors) < 2 * DOUBT
    assert all(f.value == 0.09 and f.sigmas() == pytest.approx(1.95996, abs=1e-5) for f in factors if f.holds)
    large, small = (variance_factor(12 * own, 12, 0.09, DOUBT) for own in (0.36, 0.01))
    assert not large.holds and large.value == pytest.approx(0.36) and large.ratio == pytest.approx(2.0)
    assert small.holds and small.value == 0.09 and small.ratio == pytest.approx(1 / 3)


def test_without_a_degree_of_freedom_only_stated_noise_says_anything() -> None:
    stated = variance_factor(0.0, 0, 0.25, DOUBT)
    assert stated.value == 0.25 and stated.holds
    assert math.isnan(variance_factor(0.0, 0, None, DOUBT).value)


def test_student_intervals_cover_with_few_residuals() -> None:
    """The mean of four numbers: normal intervals of their own variance would cover 85 percent."""
    rng = np.random.default_rng(2)
    numbers = rng.standard_normal((4000, 4))
    covered = normal = 0
    for row in numbers:
        factor = variance_factor(float(((row - row.mean()) ** 2).sum()), 3, None, DOUBT)
        sigma = math.sqrt(factor.value / 4)
        covered += abs(row.mean()) <= factor.sigmas() * sigma
        normal += abs(row.mean()) <= 1.96 * sigma
    assert covered / 4000 == pytest.approx(0.95, abs=0.012) and normal / 4000 < 0.88
