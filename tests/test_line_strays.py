"""Lines that stray from their directions, as those of buildings do: no camera gains by making strays small in radians."""

import math
from dataclasses import replace

import pytest
import torch
from drawn_chains import FISHEYE, OPTIONS, true_chains

from camera_models import Pinhole
from omnilines.pipelines.line_camera import adjusted_camera, readjusted_camera
from omnilines.pipelines.line_scale import doubt, scaled
from omnilines.structure.told_scale import ToldScale

PLAIN = Pinhole([420.0, 420.0, 319.5, 239.5, *([0.0] * 9)], (640, 480))
STRAY_RAD = math.radians(0.3)


@pytest.mark.slow
def test_strays_in_pixels_do_not_draw_at_the_focal_length() -> None:
    """Without right angles nothing tells it: one round, before it is held, leaves it at the start's. By strays in radians it goes
    to 430 px."""
    chains = true_chains(PLAIN, 0, photos=8, lines=200, stray_rad=STRAY_RAD)
    done = adjusted_camera(PLAIN, chains, replace(OPTIONS, right_angles=False, rounds=1))
    sigma = float((done.problem.basis @ done.scores.covariance @ done.problem.basis.mT)[0, 0].sqrt())
    assert done.prior.held is None and done.families.lone and sigma > 40.0
    assert abs(float(done.model.parameters[0]) - 420.0) < 0.05 * sigma


@pytest.mark.slow
def test_residuals_follow_their_derivatives_by_the_camera() -> None:
    done = adjusted_camera(FISHEYE, true_chains(FISHEYE, 0, stray_rad=STRAY_RAD))
    problem, state = done.problem, done.state
    change = torch.tensor([1.0, 1.0, 0.0, 0.0, 0.002, 0.0, 0.0, 0.0], dtype=torch.float64)
    high, low = (
        problem.linearise(replace(state, model=state.model.with_parameters(state.model.parameters + step * change))).residual
        for step in (1e-3, -1e-3)
    )
    told = problem.linearise(state).by_kept[0] @ (problem.basis.mT @ change)
    torch.testing.assert_close((high - low) / 2e-3, told, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_another_model_has_the_same_strays_in_pixels() -> None:
    done = adjusted_camera(FISHEYE, true_chains(FISHEYE, 0, stray_rad=STRAY_RAD))
    other = readjusted_camera(scaled(FISHEYE, 1.05, math.radians(95.0)), done, OPTIONS)
    first, second = (one.families.stray_rad[one.problem.members] for one in (done, other))
    ratio = other.problem.turning.rad_per_px / done.problem.turning.rad_per_px
    torch.testing.assert_close(second, first * ratio)
    assert float((ratio - 1.0).abs().max()) > 0.01


def test_walls_that_explain_the_same_focal_length_are_not_told_as_another() -> None:
    told = ToldScale(1.003, 0.016, 0.08, 5.5, 1.0045, math.radians(88.4), False, 1.0, 0.02, True)
    assert doubt(told).endswith("in other ways, as by walls at 88 degrees and about the same focal length.")
    other = doubt(replace(told, rival_factor=1.2, rival_angle_rad=None))
    assert other.endswith("as by a focal length 20 percent longer with right angles.")
