"""Covariances of triangulated lines: the bound, Monte Carlo, and where noise is not stated."""

import math

import pytest
import torch
from triangulation_scenes import METHODS, SCENES, circle, deviations, generator, square_error

from omnilines.triangulation import triangulate
from omnilines.triangulation.residuals import chi_square_limit, noise_variance


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("name", SCENES)
def test_covariance_against_monte_carlo(name: str, stated: bool) -> None:
    """50 trials of 40 lines: 95 percent intervals of every chart coordinate and of the line as a whole cover in 93 to 97."""
    scene = SCENES[name](50)
    result = triangulate("ml", scene.observe(scene.noisy(0.5, seed=62), 0.5 if stated else None))
    delta = deviations(result, scene.ends)
    within = (delta.abs() < 1.95996 * result.covariance.diagonal(dim1=-2, dim2=-1).sqrt()).double().mean(0)
    distance = (delta * torch.linalg.solve(result.covariance, delta)).sum(-1)
    whole = float((distance < 9.4877).double().mean())
    print(f"{name}: coordinates {[f'{v:.3f}' for v in within.tolist()]}, line {whole:.3f}, factor {result.variance_factor:.4f}")
    assert 0.93 < float(within.mean()) < 0.97 and 0.93 < whole < 0.97
    assert 0.92 < float(within.min()) and float(within.max()) < 0.98
    assert result.variance_factor == (1.0 if stated else pytest.approx(0.25, rel=0.03))


def test_covariance_is_scaled_by_the_residuals_of_most_tracks_where_noise_is_not_stated() -> None:
    scene = circle(5)
    pixels = scene.noisy(0.5, seed=63)
    clean = triangulate("ml", scene.observe(pixels, in_pixels=False))
    pixels[:20, 0] += 40.0
    with_wrong = triangulate("ml", scene.observe(pixels, in_pixels=False))
    assert clean.variance_factor**0.5 == pytest.approx(0.5 / 1523, rel=0.05)
    assert with_wrong.variance_factor == pytest.approx(clean.variance_factor, rel=0.05)
    torch.testing.assert_close(
        with_wrong.covariance[20:] / with_wrong.variance_factor, clean.covariance[20:] / clean.variance_factor, rtol=1e-6, atol=0
    )


def test_pooled_variance_is_the_mean_of_chi_square_and_ignores_tracks_beyond_it() -> None:
    degrees = torch.tensor([2.0, 4.0, 12.0, 20.0], dtype=torch.float64).repeat(5000)
    cost = 0.09 * 2 * torch._standard_gamma(degrees / 2, generator=generator(64))
    assert noise_variance(cost, degrees) == pytest.approx(0.09, rel=0.02)
    cost[::10] *= 1e6
    assert noise_variance(cost, degrees) == pytest.approx(0.09, rel=0.03)
    assert math.isnan(noise_variance(cost[:4], torch.zeros(4, dtype=torch.float64)))
    quantile = chi_square_limit(torch.tensor([2.0, 12.0], dtype=torch.float64))
    # Of chi-square, 0.999, by tables.
    torch.testing.assert_close(quantile, torch.tensor([13.816, 32.909], dtype=torch.float64), rtol=0.03, atol=0)


def test_two_views_keep_their_line_and_say_so() -> None:
    scene = circle(1)
    observations = scene.observe(scene.noisy(0.5, seed=65), 0.5)
    keep = (torch.arange(8).repeat(40) < 2) | (scene.track < 5)
    results = {method: triangulate(method, observations.rows(keep)) for method in METHODS}
    for result in results.values():
        assert bool(result.known.all()) and result.two_views.tolist() == [False] * 5 + [True] * 35
        assert set(result.status_names[5:]) == {"weak"} and set(result.status_names[:5]) == {"ok"}
        assert bool(torch.isfinite(result.covariance).all()) and bool(torch.isfinite(result.ends_m).all())
        # Two planes meet in one line: no method has a choice.
        assert float(result.lines.angle_to(results["dual"].lines)[5:].max()) < 1e-7
    error = square_error(results["ml"], scene.ends)[5:]
    assert float(error.median().sqrt()) < 0.01


def test_two_views_of_unknown_noise_have_no_covariance() -> None:
    scene = circle(1)
    observations = scene.observe(scene.noisy(0.5, seed=65), in_pixels=False).rows(torch.arange(8).repeat(40) < 2)
    result = triangulate("ml", observations)
    assert int(result.known.sum()) >= 38 and math.isnan(result.variance_factor)
    assert bool(torch.isnan(result.covariance).all())
