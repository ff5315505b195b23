"""The compiled line engine against the general path in torch, which the other tests compare with autograd and Monte Carlo."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from engine_scenes import Row, row

from omnilines.adjustment import lines as adjustment
from omnilines.adjustment import minimum
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.engine import LineEngine
from omnilines.adjustment.engine_solution import LineSolution
from omnilines.adjustment.kernels.line import LOSS_KINDS, Views, factorise
from omnilines.adjustment.kernels.line_step import take_loss_curvature
from omnilines.adjustment.kernels.schur import line_block
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import COSTS, cost_named
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Outcome, Solution

COMPILED_COSTS = [name for name, _ in COSTS if cost_named(name).scaled_rows is not None]


def by_torch(monkeypatch: pytest.MonkeyPatch, *given: object, converged: bool = False, **options: Any) -> Adjusted:
    """The general engine where the compiled one would be taken; with `converged` the latter takes lines to their own minima."""
    with monkeypatch.context() as patch:
        patch.setattr(adjustment, "is_compiled", lambda problem, state: False)
        if not converged:
            patch.setattr(minimum, "line_convergence", lambda problem, loss: None)
        found = adjust_lines(*given, **options)
    assert isinstance(found.whitened, Solution)
    return found


def both(monkeypatch: pytest.MonkeyPatch, scene: Row, **options: Any) -> tuple[Adjusted, Adjusted]:
    """Compiled, and by torch, at the point where the compiled engine ends: the scale, which nothing fixes, depends on the way.

    From the start it gets there in as many steps or fewer, and no less far down; torch stays there.
    """
    start = (scene.arcs, scene.lines, scene.poses)
    first, other = adjust_lines(*start, **options), by_torch(monkeypatch, *start, **options)  # type: ignore[arg-type]
    assert first.outcome is other.outcome is Outcome.CONVERGED
    assert abs(first.initial_cost / other.initial_cost - 1) < 1e-10
    alone = not options.get("refine_poses", True)
    assert (alone or first.iterations <= other.iterations) and first.cost <= other.cost * (1 + 1e-10)
    end = (scene.arcs, first.state.chart.lines(), first.state.rig_from_world)
    stays = by_torch(monkeypatch, *end, **options)
    assert stays.outcome is Outcome.CONVERGED and abs(first.cost / stays.cost - 1) < 1e-10
    compiled = adjust_lines(*end, **options, max_iterations=0)  # type: ignore[arg-type]
    assert isinstance(compiled.whitened, LineSolution)
    assert_near(compiled, stays)
    return compiled, by_torch(monkeypatch, *end, **options, max_iterations=0)


def assert_near(compiled: Adjusted, general: Adjusted) -> None:
    """Estimates in the same charts to 1e-3 standard deviations."""
    sigma = general.line_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    steps = torch.stack([compiled.state.chart.phi - general.state.chart.phi, sigma[:, 3]])
    assert bool((steps[0].abs() <= 1e-3 * steps[1] + 1e-12).all())
    turned = (compiled.state.chart.S - general.state.chart.S).flatten(1).norm(dim=1)
    assert bool((turned <= 1e-3 * sigma[:, :3].norm(dim=1) + 1e-12).all())
    moved = (compiled.state.rig_from_world @ general.state.rig_from_world.inverse()).log()
    own = general.pose_covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    assert bool((moved.abs() <= 1e-3 * own + 1e-12).all())


def assert_same(compiled: Adjusted, general: Adjusted) -> None:
    """Cost to 1e-10 and covariances to 1e-6."""
    assert abs(compiled.cost / general.cost - 1) < 1e-10
    assert abs(compiled.noise_factor / general.noise_factor - 1) < 1e-8
    for found, expected in (
        (compiled.line_covariance, general.line_covariance),
        (compiled.pose_covariance, general.pose_covariance),
        (compiled.joint_line_covariance(torch.arange(6)), general.joint_line_covariance(torch.arange(6))),
    ):
        scale = float(expected.abs().max())
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.parametrize("cost", COMPILED_COSTS)
@pytest.mark.parametrize("loss", [None, Loss("huber", 0.02), Loss("cauchy", 0.02)])
@pytest.mark.slow
def test_lines_and_poses_are_those_of_torch(monkeypatch: pytest.MonkeyPatch, cost: str, loss: Loss | None) -> None:
    if loss is not None and cost != "sector":
        loss = Loss(loss.name, 1.0)
    assert_same(*both(monkeypatch, row(), cost=cost, loss=loss))


@pytest.mark.parametrize("cost", ["sector", "whitened"])
def test_lines_alone_are_those_of_torch(monkeypatch: pytest.MonkeyPatch, cost: str) -> None:
    assert_same(*both(monkeypatch, row(seed=1), cost=cost, refine_poses=False))


@pytest.mark.slow
def test_no_line_alone_depends_on_another() -> None:
    """Of lines with as many wrong observations as good ones, each ends where it does without the others, and soon."""
    scene = row(lines=120, reach=8, seed=7)
    wrong = torch.rand(len(scene.arcs), generator=torch.Generator().manual_seed(0)) < 0.4
    bearings = torch.where(wrong[:, None, None], scene.arcs.bearings + 0.02, scene.arcs.bearings)
    arcs = dataclasses.replace(scene.arcs, bearings=bearings / bearings.norm(dim=-1, keepdim=True))
    options = {"cost": "whitened", "refine_poses": False, "loss": Loss("cauchy", 2.0)}
    costs: list[float] = []
    together = adjust_lines(arcs, scene.lines, scene.poses, **options, callback=lambda step: costs.append(step.cost))  # type: ignore[arg-type]
    assert together.outcome is Outcome.CONVERGED and together.iterations < 60 and costs == sorted(costs, reverse=True)
    total = 0.0
    for track in range(arcs.tracks):
        own = arcs.rows(arcs.track == track)
        one = dataclasses.replace(own, track=torch.zeros_like(own.track), tracks=1)
        line = scene.lines[torch.tensor([track])]
        alone = adjust_lines(one, line, scene.poses, **options)  # type: ignore[arg-type]
        sigma = alone.line_covariance[0].diagonal().clamp_min(0).sqrt()
        assert abs(float(alone.state.chart.phi[0] - together.state.chart.phi[track])) < 1e-3 * float(sigma[3])
        total += alone.cost
    assert abs(total / together.cost - 1) < 1e-9


@pytest.mark.parametrize("loss", [Loss(), Loss("cauchy", 1.5)])
def test_the_curvature_of_a_loss_is_its_second_derivative(loss: Loss) -> None:
    """Of residuals that are linear, half the second derivative of the sum of the loss is E."""
    generator = torch.Generator().manual_seed(1)
    start, rows = (torch.randn(9, *shape, generator=generator, dtype=torch.float64) for shape in ((2,), (2, 4)))

    def total(step: torch.Tensor) -> torch.Tensor:
        return loss((start + rows @ step).square().sum(-1))[0].sum()

    expected = torch.autograd.functional.hessian(total, torch.zeros(4, dtype=torch.float64)) / 2
    square = start.square().sum(-1)
    assert loss.name == "none" or bool((square > 1.5**2).any() and (square < 1.5**2).any())
    root = loss(square)[1].sqrt()[:, None]
    by_line, r = (root[..., None] * rows).reshape(9, 8).numpy(), (root * start).numpy()
    none = np.zeros(0)
    views = Views(none, none, none, none, none, LOSS_KINDS[loss.name], loss.scale)
    e, gradient = np.empty((4, 4)), np.empty(4)
    line_block(by_line, r, 9, e, gradient)
    take_loss_curvature(views, 9, by_line, r, e)
    np.testing.assert_allclose(np.tril(e), np.tril(expected.numpy()), rtol=1e-12, atol=1e-12)


def test_a_block_whose_loss_curves_away_in_all_directions_has_no_factor() -> None:
    """It would be taken for one of nothing but zeros, and its line for one that has come to rest."""
    factor = np.empty(10)
    assert not factorise(-np.eye(4), 1e-4, factor)
    assert factorise(np.zeros((4, 4)), 1e-4, factor)
    np.testing.assert_array_equal(factor, [1, 0, 1, 0, 0, 1, 0, 0, 0, 1])


def test_few_doubtful_lines_do_not_hold_up_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four of ten observations of some lines are wrong: poses and all lines converge together nevertheless, by either engine."""
    scene = row(lines=120, reach=8, seed=7)
    generator = torch.Generator().manual_seed(0)
    wrong = (torch.rand(len(scene.arcs), generator=generator) < 0.4) & (scene.arcs.track < 30)
    bearings = torch.where(wrong[:, None, None], scene.arcs.bearings + 0.02, scene.arcs.bearings)
    arcs = dataclasses.replace(scene.arcs, bearings=bearings / bearings.norm(dim=-1, keepdim=True))
    given = (arcs, scene.lines, scene.poses)
    found = adjust_lines(*given, cost="whitened", loss=Loss("cauchy", 2.0))
    general = by_torch(monkeypatch, *given, converged=True, cost="whitened", loss=Loss("cauchy", 2.0))
    assert found.outcome is general.outcome is Outcome.CONVERGED
    assert max(found.iterations, general.iterations) < 30
    assert abs(found.cost / general.cost - 1) < 1e-9


@pytest.mark.parametrize("held", [(0,), (2, 7), (4,)])
def test_held_poses_give_what_torch_gives(monkeypatch: pytest.MonkeyPatch, held: tuple[int, ...]) -> None:
    mask = torch.zeros(10, dtype=torch.bool)
    mask[list(held)] = True
    compiled, general = both(monkeypatch, row(seed=2), held=mask)
    assert_same(compiled, general)
    assert bool((compiled.pose_covariance[mask] == 0).all())


@pytest.mark.slow
def test_held_lines_and_a_prior_give_what_torch_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = row(seed=3)
    held = torch.zeros(60, dtype=torch.bool)
    held[5:9] = True
    prior = PosePrior(scene.poses, torch.full((10,), 0.003).double(), torch.full((10,), 0.02).double())
    compiled, general = both(monkeypatch, scene, cost="whitened", prior=prior)
    assert_same(compiled, general)
    compiled, general = both(monkeypatch, scene, cost="whitened", held_lines=held, prior=prior)
    assert abs(compiled.cost / general.cost - 1) < 1e-10
    assert bool((compiled.line_covariance[held] == 0).all())
    torch.testing.assert_close(compiled.pose_covariance, general.pose_covariance, rtol=1e-6, atol=1e-12)


def test_the_order_of_photos_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shuffled photos make a wide band, which the engine orders anew."""
    scene = row(cameras=30, lines=150, seed=4)
    shuffle = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    place = torch.argsort(shuffle)
    arcs = dataclasses.replace(scene.arcs, image=place[scene.arcs.image])
    shuffled = dataclasses.replace(scene, arcs=arcs, poses=scene.poses[shuffle])
    state = LinesAndPoses(scene.poses, LineChart.about_cameras(scene.lines, scene.poses.centre[scene.arcs.image], arcs.track))
    freedom = Freedom(torch.zeros(30, dtype=torch.bool))
    engine = LineEngine(LineProblem(arcs, "sector", freedom, state), Loss())
    assert engine.layout.pattern.reach < 12
    assert_same(*both(monkeypatch, shuffled))
    compiled = adjust_lines(shuffled.arcs, shuffled.lines, shuffled.poses)
    straight = adjust_lines(scene.arcs, scene.lines, scene.poses)
    assert abs(straight.cost / compiled.cost - 1) < 1e-10
    torch.testing.assert_close(straight.pose_covariance[shuffle], compiled.pose_covariance, rtol=1e-6, atol=1e-12)


def test_what_observations_do_not_determine_is_named_by_both(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = row(seed=5)
    kept = (scene.arcs.track != 7) | (torch.arange(len(scene.arcs)) == torch.nonzero(scene.arcs.track == 7).flatten()[0])
    one_view = dataclasses.replace(scene, arcs=scene.arcs.rows(kept))
    compiled = adjust_lines(one_view.arcs, one_view.lines, one_view.poses, max_iterations=60)
    monkeypatch.setattr(adjustment, "is_compiled", lambda problem, state: False)
    general = adjust_lines(one_view.arcs, one_view.lines, one_view.poses, max_iterations=60)
    assert compiled.outcome is general.outcome


@pytest.mark.parametrize("cost", ["sector", "whitened"])
@pytest.mark.slow
def test_results_are_equal_to_the_last_bit_on_any_number_of_threads(cost: str) -> None:
    """Lines are summed in pieces that do not depend on threads, and of two cameras equally far from a line one is its chart's."""
    scene = row(cameras=40, lines=900, seed=6)
    threads, found = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            found.append(adjust_lines(scene.arcs, scene.lines, scene.poses, cost=cost))
    finally:
        torch.set_num_threads(threads)
    one = found[0]
    assert one.outcome is Outcome.CONVERGED
    for other in found[1:]:
        assert (other.cost, other.iterations) == (one.cost, one.iterations)
        for name in ("pose_covariance", "line_covariance"):
            assert torch.equal(getattr(other, name), getattr(one, name)), name
        for name in ("centre", "scale", "S", "phi"):
            assert torch.equal(getattr(other.state.chart, name), getattr(one.state.chart, name)), name
        assert torch.equal(other.state.rig_from_world.rotation, one.state.rig_from_world.rotation)
