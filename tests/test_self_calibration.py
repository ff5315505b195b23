"""Intrinsics from straight lines with noise: the gradient of the whole cost by differences, and coverage over many seeds.

Exact arcs hide what a derivative at the wrong place does: it is a product with the residual, of one sign in all observations.
"""

import numpy as np
import pytest
import torch
from self_calibration import FISHEYE, PINHOLE, SelfCalibration
from torch import Tensor

from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import COSTS
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome

NOISE_PX = 0.8
NORMAL_95 = 1.959964
MODELS = pytest.mark.parametrize("model", [PINHOLE, FISHEYE], ids=["pinhole", "190"])
EVERY_COST = pytest.mark.parametrize("cost", [name for name, _ in COSTS])


def whole_cost(problem: LineProblem, state: LinesAndPoses) -> float:
    return float(problem.linearise(state).residual.square().sum())


@MODELS
@EVERY_COST
def test_gradient_of_the_whole_cost_by_cameras_is_that_of_differences(model, cost):
    scene = SelfCalibration(model)
    arcs = scene.arcs(NOISE_PX, 0)
    chart = LineChart.about_cameras(scene.lines, scene.cam_from_world.centre[arcs.image], arcs.track)
    state = LinesAndPoses(scene.cam_from_world, chart, None, (model,))
    held = torch.ones(arcs.images, dtype=torch.bool)
    problem = LineProblem(arcs, cost, Freedom(held, None, True), state)
    at = problem.linearise(state)
    analytic = 2 * (at.by_kept[0].mT @ at.residual[..., None])[..., 0].sum(0)
    # Its terms cancel over many observations, so that it is compared with their size.
    size = 2 * (at.by_kept[0] * at.residual[..., None]).square().sum((0, 1)).sqrt()
    none = torch.zeros(arcs.tracks, 4, dtype=torch.float64)
    found = []
    for column, step in enumerate(steps_of_pixels(at.by_kept[0])):
        delta = torch.zeros(len(analytic), dtype=torch.float64)
        delta[column] = step
        ahead, behind = (whole_cost(problem, problem.retract(state, sign * delta, none)) for sign in (1, -1))
        found.append((ahead - behind) / (2 * float(step)))
    assert float(((analytic - torch.tensor(found)) / size).abs().max()) < 2e-3


def steps_of_pixels(by_camera: Tensor) -> Tensor:
    """A step of each intrinsic that moves residuals by a ten-thousandth of what it could do at most."""
    return 1e-4 / by_camera.abs().amax((0, 1))


DEFAULT = [(PINHOLE, "whitened", 10), (FISHEYE, "whitened", 10), (PINHOLE, "sector", 6), (PINHOLE, "taylor-kriegman", 6)]
EVERY = [pytest.param(model, name, 200, marks=pytest.mark.full) for model in (PINHOLE, FISHEYE) for name, _ in COSTS]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "cost", "seeds"), [*DEFAULT, *EVERY])
def test_intrinsics_are_unbiased_and_covered(model, cost, seeds):
    """No intrinsic is off on average, and the whitened cost's intervals cover the truth; other costs scatter a little more."""
    scene = SelfCalibration(model)
    scores = []
    for seed in range(seeds):
        found = scene.calibrated(NOISE_PX, seed, cost)
        assert found.outcome is Outcome.CONVERGED
        scores.append(scene.scores(found).numpy())
    mean, covered = np.mean(scores, 0), float((np.abs(scores) < NORMAL_95).mean())
    print(f"{model.NAME} {cost}: mean z {np.round(mean, 2)}, sd {np.round(np.std(scores, 0), 2)}, covered {covered:.3f}")
    # Four standard deviations of a mean.
    assert float(np.abs(mean).max()) < 4 / np.sqrt(seeds)
    if cost == "whitened":
        assert (0.92 if seeds == 200 else 0.8) <= covered <= (0.98 if seeds == 200 else 1.0)
