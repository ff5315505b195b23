"""Costs enter in standard deviations of the noise, stated noise is used and tested, and covariances are those of each cost."""

import math
from dataclasses import replace

import pytest
import torch
from coverage_scenes import NOISE_PX, Truth, adjusted, rig_of, world_of

from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.noise import Noise
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.weighting import cost_weights, end_sigma_rad
from omnilines.costs import COSTS, cost_function
from omnilines.least_squares import Loss, Outcome
from omnilines.pages.noise_notes import noise_notes, noise_row

NAMES = [name for name, _ in COSTS]


def disturbed_with_prior(truth: Truth, cost: str, noise: str) -> tuple[MatchedArcs, Adjusted]:
    """Poses off by 0.6 degrees and 3 cm, with a prior that says 1 degree and 5 cm."""
    arcs, frames = truth.arcs(noise, 1), len(truth.rig_from_world)
    sigma = torch.tensor([math.radians(0.6)] * 3 + [0.03] * 3, dtype=torch.float64)
    random = torch.randn(frames, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    start = Pose.exp(random * sigma) @ truth.rig_from_world
    one = torch.ones(frames, dtype=torch.float64)
    prior = PosePrior(start, math.radians(1) * one, 0.05 * one)
    return arcs, adjust_lines(arcs, truth.lines, start, cost=cost, prior=prior)


def rms_px(arcs: MatchedArcs, found: Adjusted) -> float:
    return float(arcs.orthogonal_px(found.state.normals(arcs)).square().mean().sqrt())


@pytest.mark.parametrize("noise", ["stated", "unstated"])
@pytest.mark.parametrize("cost", NAMES)
def test_a_loose_prior_on_poses_leaves_the_adjustment_to_the_arcs(cost: str, noise: str) -> None:
    """Added to residuals in rad^1.5 as they are, it left 12 px of 0.3."""
    truth = world_of("pinhole", 20, 6)
    arcs, found = disturbed_with_prior(truth, cost, noise)
    assert found.outcome is Outcome.CONVERGED
    assert rms_px(arcs, found) < 1.2 * NOISE_PX
    _, best = disturbed_with_prior(truth, "whitened", noise)
    apart = (found.state.rig_from_world @ best.state.rig_from_world.inverse()).log()
    sigma = best.pose_covariance.diagonal(dim1=1, dim2=2).sqrt()
    # Costs differ by a part of the uncertainty that all of them have.
    assert float((apart / sigma).abs().max()) < 1.5
    ratio = found.pose_covariance.diagonal(dim1=1, dim2=2).sqrt() / sigma
    assert 0.85 < float(ratio.min()) and float(ratio.max()) < 1.5


def test_a_prior_weighs_alike_whatever_unit_the_noise_is_stated_in() -> None:
    """Noise that is not stated is found to be what it is, and then gives what the same noise, stated, gives."""
    truth = world_of("pinhole", 20, 6)
    results = [adjusted(truth, "whitened", noise, True, 3) for noise in ("stated", "unstated")]
    stated, unstated = results
    assert unstated.noise_factor == pytest.approx(NOISE_PX, rel=0.15) and stated.noise_factor == 1
    apart = (stated.state.rig_from_world @ unstated.state.rig_from_world.inverse()).log()
    sigma = stated.pose_covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert float((apart / sigma).abs().max()) < 0.2


def jacobian(problem: LineProblem, found: Adjusted) -> torch.Tensor:
    """d residual / d (kept, lines), dense."""
    at, arcs, size = problem.linearise(found.state), problem.arcs, problem.structure.kept_size
    m = at.residual.shape[1]
    dense = torch.zeros(len(arcs), m, size + 4 * arcs.tracks, dtype=torch.float64)
    for k in range(len(arcs)):
        line = size + 4 * int(arcs.track[k])
        dense[k, :, line : line + 4] = at.by_eliminated[k]
        parts = zip(problem.structure.groups, problem.structure.offsets, at.by_kept, strict=False)
        for group, offset, by_kept in parts:
            if group.index[k] >= 0:
                low = offset + group.dim * int(group.index[k])
                dense[k, :, low : low + group.dim] = by_kept[k]
    return dense


@pytest.mark.parametrize("rig", [False, True])
@pytest.mark.parametrize("cost", NAMES)
def test_covariances_are_the_sandwich_of_the_cost(cost: str, rig: bool) -> None:
    """(J'WJ)^-1 J'W S W J (J'WJ)^-1 of dense matrices, from the cost's own Jacobian and the noise of its residuals: of the
    compiled engine, which takes all but the rig, and of the general one."""
    truth = rig_of(5, 9) if rig else world_of("190 degrees", 14, 6)
    arcs, frames = truth.arcs("stated", 2), len(truth.rig_from_world)
    # Unequal noise of the two ends, as arcs of unequal length and contrast have it.
    unequal = arcs.covariance_px2 * torch.linspace(0.4, 1.6, 2 * len(arcs)).double().reshape(-1, 2, 1, 1)
    arcs = replace(arcs, covariance_px2=unequal)
    held = torch.zeros(frames, dtype=torch.bool)
    held[[0, 2]] = True
    found = adjust_lines(arcs, truth.lines, truth.rig_from_world, cost=cost, held=held, rig=truth.rig, refine_rig=rig)
    problem = LineProblem(arcs, cost, Freedom(held, None, False, rig), found.state)
    dense, normal = jacobian(problem, found), found.state.normals(arcs)
    bread = torch.linalg.inv(torch.einsum("nmi,nmj->ij", dense, dense))
    # In whitened coordinates the noise is one and the weights are A'A.
    plain = LineProblem(arcs, "whitened", Freedom(held, None, False, rig), found.state)
    whitened, weight = jacobian(plain, found), cost_weights(cost, arcs, normal)
    scores = torch.einsum("nab,nbi->nai", weight, whitened)
    expected = bread @ torch.einsum("nai,naj->ij", scores, scores) @ bread
    size = problem.structure.kept_size
    own = torch.stack([expected[low : low + 4, low : low + 4] for low in range(size, len(expected), 4)])
    scale = own.abs().amax((1, 2), keepdim=True) * found.noise_factor**2
    # To first order in the residuals, which are 1e-3 here.
    assert float(((found.line_covariance - found.noise_factor**2 * own).abs() / scale).max()) < 0.02
    some = torch.tensor([4, 0, 5])
    joint = found.joint_line_covariance(some).reshape(3, 4, 3, 4)
    columns = size + 4 * some[:, None] + torch.arange(4)
    dense_joint = expected[columns.flatten()][:, columns.flatten()].reshape(3, 4, 3, 4) * found.noise_factor**2
    assert float((joint - dense_joint).abs().max() / dense_joint.abs().max()) < 0.02
    for k, line in enumerate(some.tolist()):
        torch.testing.assert_close(joint[k, :, k], found.line_covariance[line], rtol=1e-8, atol=0)
    if rig:
        assert found.rig_covariance is not None
        part = expected[size - 6 : size, size - 6 : size] * found.noise_factor**2
        assert float((found.rig_covariance[1] - part).abs().max() / part.abs().max()) < 0.02


@pytest.mark.parametrize("cost", ["sector", "bartoli-sturm", "taylor-kriegman"])
@pytest.mark.slow
def test_weights_predict_the_spread_of_the_residuals(cost: str) -> None:
    """tr W is the mean square of a cost's residuals at the truth for noise of unit level, over draws."""
    truth = world_of("190 degrees", 14, 6)
    normal = truth.lines[truth.track].projection_normal(truth.rig_from_world[truth.image])
    total, predicted = [], []
    for seed in range(60):
        arcs = truth.arcs("stated", seed)
        total.append(float(cost_function(cost, arcs)(arcs.bearings, normal)[0].square().sum()))
        predicted.append(float(cost_weights(cost, arcs, normal).diagonal(dim1=1, dim2=2).sum()))
        assert float(end_sigma_rad(arcs, normal / normal.norm(dim=-1, keepdim=True)).min()) > 0
    assert sum(total) == pytest.approx(sum(predicted), rel=0.06)


def test_stated_noise_is_used_where_little_is_left_over() -> None:
    """Three views of one line leave two degrees of freedom, two views none: the uncertainty is that of the stated noise."""
    for views, left in ((3, 2), (2, 0)):
        truth = world_of("pinhole", 1, views)
        first, second = (adjusted(truth, "whitened", "stated", False, seed, refine_poses=False) for seed in (0, 1))
        assert first.noise_factor == second.noise_factor == 1 and first.noise.redundancy == left
        sigma = [found.line_covariance[0].diagonal().sqrt() for found in (first, second)]
        # The lines differ by noise, their uncertainty does not.
        torch.testing.assert_close(sigma[0], sigma[1], rtol=0.05, atol=0)
    assert math.isnan(first.noise.measured) and "as stated" in noise_row(first.noise)
    unstated = adjusted(truth, "whitened", "unstated", False, 0, refine_poses=False)
    assert bool(unstated.line_covariance.isnan().all()) and "no uncertainties" in noise_notes(unstated.noise)[0]


def test_noise_that_is_not_stated_widens_what_few_residuals_say() -> None:
    """By the quantile of F over that of chi-square: 8.11 for two degrees of freedom and four coordinates, none for many."""
    assert Noise(0.5, 2.0, False).widening(4) == pytest.approx(4 * 19.247 / 9.4877, rel=1e-3)
    assert Noise(0.5, 1e6, False).widening(6) == pytest.approx(1, rel=1e-4)
    assert Noise(1.1, 2.0, True).widening(4) == 1
    found = adjusted(world_of("pinhole", 1, 3), "whitened", "unstated", False, 0, refine_poses=False)
    assert "2 degrees of freedom tell little" in noise_notes(found.noise)[0]


def test_stated_noise_that_does_not_hold_is_said() -> None:
    truth = world_of("pinhole", 20, 6)
    arcs, held = truth.arcs("stated", 0), torch.zeros(6, dtype=torch.bool)
    held[[0, 3]] = True
    for factor, word in ((0.5, "as large as the stated noise"), (1.0, ""), (2.0, "likely to be too large")):
        other = replace(arcs, covariance_px2=arcs.covariance_px2 * factor**2)
        found = adjust_lines(other, truth.lines, truth.rig_from_world, cost="whitened", held=held)
        assert found.noise.measured == pytest.approx(1 / factor, rel=0.15)
        # Too large residuals widen all; stated noise that is too large is kept.
        assert found.noise_factor == (found.noise.measured if factor < 1 else 1.0)
        notes = noise_notes(found.noise)
        assert word in notes[0] if word else notes == ()


@pytest.mark.parametrize("cost", ["whitened", "sector"])
@pytest.mark.parametrize("stated", ["stated", "unstated"])
def test_outliers_under_a_robust_loss_do_not_widen_the_rest(cost: str, stated: str) -> None:
    """3 percent of outliers of 10 to 40 px; they made all standard deviations four times as large."""
    truth = world_of("pinhole", 20, 6)
    clean, wrong = (adjusted(truth, cost, noise, False, 5) for noise in (stated, f"{stated}, outliers"))
    ratio = (wrong.line_covariance / clean.line_covariance).diagonal(dim1=1, dim2=2).sqrt()
    assert 0.8 < float(ratio.median()) < 1.3
    # An efficient loss costs some percent: Huber's and Cauchy's variance over that of least squares, for Gaussian noise.
    loss = adjust_lines(
        truth.arcs("stated", 5), truth.lines, truth.rig_from_world, cost="whitened", refine_poses=False, loss=Loss("cauchy", 2.0)
    )
    plain = adjust_lines(truth.arcs("stated", 5), truth.lines, truth.rig_from_world, cost="whitened", refine_poses=False)
    ratio = (loss.line_covariance / plain.line_covariance).diagonal(dim1=1, dim2=2)
    assert float(ratio.median()) == pytest.approx(0.3358 / 0.5543**2, rel=0.05)


def test_uncertainties_are_not_too_large_where_many_observations_lie_far_off() -> None:
    small = Noise(0.87, 5000.0, True)
    assert "likely to be too large" in noise_notes(small)[0] and "likely to be too large" in noise_notes(small, 0.001)[0]
    assert "yet 9 percent of the observations lie far" in noise_notes(small, 0.09)[0]
