"""What an adjustment can move beside lines and poses: cameras (calibrated by straight lines), a rig; held lines and priors."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_scene import RigScene, disturbed, moved_models
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.pose import Pose, adjoint
from omnilines.adjustment.accuracy import align_lines
from omnilines.adjustment.lines import adjust_lines
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import COSTS
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Outcome

NOISE_PX = 0.3


def test_adjoint():
    pose = disturbed(Pose.identity(5), 60, 1.0, 3)
    delta = 0.3 * torch.randn(5, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    left, right = pose @ Pose.exp(delta), Pose.exp((adjoint(pose) @ delta[..., None])[..., 0]) @ pose
    torch.testing.assert_close(left.rotation, right.rotation)
    torch.testing.assert_close(left.translation, right.translation)


@pytest.mark.parametrize("cost", [name for name, _ in COSTS])
def test_jacobian_by_poses_rig_and_cameras_is_that_of_differences(cost):
    """On exact arcs, where every cost is differentiable by the cameras to first order."""
    scene = RigScene(frames=3, lines=12)
    arcs = scene.arcs()
    chart = LineChart.about_cameras(scene.lines, scene.cam_from_world.centre[arcs.image], arcs.track)
    state = LinesAndPoses(scene.rig_from_world, chart, scene.rig, scene.models)
    problem = LineProblem(arcs, cost, Freedom(torch.tensor([True, False, False]), None, True, True), state)
    sizes = [6 * 2, 6, *(model.calibration_basis().shape[1] for model in scene.models)]
    assert problem.structure.kept_size == sum(sizes)
    at = problem.linearise(state)
    dense = torch.zeros(len(arcs), at.residual.shape[1], problem.structure.kept_size, dtype=torch.float64)
    for group, offset, jacobian in zip(problem.structure.groups, problem.structure.offsets, at.by_kept, strict=False):
        rows = torch.nonzero(group.index >= 0).flatten()
        columns = offset + group.index[rows, None] * group.dim + torch.arange(group.dim)
        dense[rows[:, None], :, columns] = jacobian[rows].transpose(1, 2)
    none = torch.zeros(arcs.tracks, 4, dtype=torch.float64)
    generator = torch.Generator().manual_seed(4)
    for _ in range(4):
        scale = torch.cat([torch.full((18,), 1e-5), *(_steps(model) for model in scene.models)]).double()
        step = scale * torch.randn(len(scale), generator=generator, dtype=torch.float64)
        ahead, behind = (problem.linearise(problem.retract(state, sign * step, none)).residual for sign in (1, -1))
        difference = 0.5 * (ahead - behind)
        torch.testing.assert_close(dense @ step, difference, rtol=1e-4, atol=1e-5 * float(difference.abs().max()))


def _steps(model: CameraModel) -> Tensor:
    """Steps along the calibration basis that move pixels by about 1e-3."""
    basis = model.calibration_basis()
    reach = torch.tensor([[0.8, 0.3, 0.5], [-0.6, 0.5, 0.2]], dtype=torch.float64)
    by_parameter = model.project_with_jacobians(reach)[3] @ basis
    return 1e-3 / by_parameter.norm(dim=(0, 1)).clamp_min(1e-9)


@pytest.mark.slow
def test_cameras_are_calibrated_by_straight_lines():
    """Focal lengths off by 2 percent and centres by 4 px, poses off too: found again, as exactly as the covariance says."""
    scene = RigScene(frames=12, lines=60)
    wrong = moved_models(scene.models)
    start = disturbed(scene.cam_from_world, 0.3, 0.01)
    exact = adjust_lines(scene.arcs(), scene.lines, start, models=wrong)
    assert exact.outcome is Outcome.CONVERGED
    for found, true in zip(exact.state.models, scene.models, strict=True):
        torch.testing.assert_close(found.parameters, true.parameters, rtol=1e-5, atol=1e-5)
    scores = []
    for seed in range(4):
        result = adjust_lines(scene.arcs(NOISE_PX, seed), scene.lines, start, cost="whitened", models=wrong)
        assert 0.9 < result.noise_factor < 1.1
        parts = zip(result.state.models, scene.models, result.camera_covariance, strict=True)
        for found, true, covariance in parts:
            basis = true.calibration_basis()
            into = torch.linalg.pinv(basis)
            error, spread = into @ (found.parameters - true.parameters), into @ covariance @ into.mT
            scores.append(float(error @ torch.linalg.solve(spread, error)) / len(error))
    # Eight means of 8 or 9 squares: all together chi-square of 68 degrees of freedom over 68.
    assert 0.55 < np.mean(scores) < 1.6


def test_a_rig_is_found_and_holds_its_frames_together():
    """Extrinsics off by half a degree and 1 cm; their covariance; the scale, which a rig that is refined leaves open, is kept."""
    scene = RigScene(frames=10, lines=50)
    off = Pose.exp(torch.tensor([[0.0] * 6, [0.01, -0.006, 0.005, 0.01, -0.008, 0.01]], dtype=torch.float64))
    wrong = replace(scene.rig, cam_from_rig=off @ scene.rig.cam_from_rig)
    start = disturbed(scene.rig_from_world, 0.3, 0.01)
    found = adjust_lines(scene.arcs(), scene.lines, start, rig=wrong, refine_rig=True)
    assert found.outcome is Outcome.CONVERGED and found.state.rig is not None
    turned = found.state.rig.cam_from_rig
    torch.testing.assert_close(turned.rotation, scene.rig.cam_from_rig.rotation, rtol=0, atol=1e-8)
    direction = turned.translation[1] / turned.translation[1].norm()
    true = scene.rig.cam_from_rig.translation[1] / scene.rig.cam_from_rig.translation[1].norm()
    torch.testing.assert_close(direction, true, rtol=0, atol=1e-7)
    noisy = adjust_lines(scene.arcs(NOISE_PX), scene.lines, start, rig=wrong, refine_rig=True, cost="whitened")
    covariance = noisy.rig_covariance
    assert covariance is not None and float(covariance[0].abs().max()) == 0
    error = (noisy.state.rig.cam_from_rig[1:] @ scene.rig.cam_from_rig[1:].inverse()).log()[0, :3]
    assert float(error @ torch.linalg.solve(covariance[1, :3, :3], error)) < 16.3


def test_a_held_rig_gives_the_scale():
    """With a known baseline nothing but the frame of the world is free: lines agree after a turn and a shift."""
    scene = RigScene(frames=10, lines=50)
    start = disturbed(scene.rig_from_world, 0.5, 0.02)
    problem_of = {}
    for name, rig in (("held", scene.rig), ("alone", None)):
        poses = start if rig is not None else rig_photos(scene, start)
        chart = LineChart.about_cameras(scene.lines, scene.cam_from_world.centre[scene.image], scene.track)
        state = LinesAndPoses(poses, chart, rig)
        problem_of[name] = LineProblem(scene.arcs(), "sector", Freedom(torch.zeros(len(poses), dtype=torch.bool)), state)
        assert problem_of[name].gauge(state).shape[1] == (6 if rig is not None else 7)
    found = adjust_lines(scene.arcs(), scene.lines, start, rig=scene.rig)
    assert found.outcome is Outcome.CONVERGED
    lines = found.state.chart.lines()
    aligned = align_lines(lines, lines[:, None].closest_point(scene.ends), scene.ends)
    assert aligned.rms_m < 1e-6 and abs(aligned.scale - 1) < 1e-7


def rig_photos(scene: RigScene, rig_from_world: Pose) -> Pose:
    return scene.rig.cam_from_rig[scene.rig.camera] @ rig_from_world[scene.rig.frame]


def test_held_lines_do_not_move_and_anchor_the_scene():
    scene = RigScene(frames=8, lines=40)
    held = torch.zeros(len(scene.ends), dtype=torch.bool)
    held[:6] = True
    start = disturbed(scene.cam_from_world, 0.5, 0.02)
    found = adjust_lines(scene.arcs(), scene.lines, start, held_lines=held)
    assert found.outcome is Outcome.CONVERGED
    lines = found.state.chart.lines()
    distance = lines[:, None].distance_to(scene.ends)
    assert float(distance[:6].max()) < 1e-12 and float(distance.max()) < 1e-6
    assert float(found.line_covariance[:6].abs().max()) == 0 and bool(
        (found.line_covariance[6:].diagonal(dim1=1, dim2=2) > 0).all()
    )


def test_priors_on_poses():
    """Derivative by differences; a tight prior keeps a pose, an infinite deviation leaves it free, and the gauge is closed."""
    scene = RigScene(frames=8, lines=40)
    count = len(scene.cam_from_world)
    start = disturbed(scene.cam_from_world, 0.5, 0.02)
    sigma = torch.full((count,), math.inf, dtype=torch.float64)
    sigma[:4] = 1e-7
    prior = PosePrior(scene.cam_from_world, sigma, sigma)
    near = disturbed(scene.cam_from_world, 8, 0.2)
    step = 1e-6 * torch.randn(count, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    one = PosePrior(scene.cam_from_world, torch.ones(count).double(), torch.ones(count).double())
    _, jacobian = one.residual(near)
    difference = 0.5 * (one.residual(Pose.exp(step) @ near)[0] - one.residual(Pose.exp(-step) @ near)[0])
    torch.testing.assert_close((jacobian @ step[..., None])[..., 0], difference, rtol=1e-3, atol=1e-10)
    found = adjust_lines(scene.arcs(), scene.lines, start, prior=prior, max_iterations=200)
    assert found.outcome is Outcome.CONVERGED
    lines = found.state.chart.lines()
    assert float(lines[:, None].distance_to(scene.ends).max()) < 1e-5
    torch.testing.assert_close(found.state.cam_from_world.translation, scene.cam_from_world.translation, rtol=0, atol=1e-5)
    loose = adjust_lines(scene.arcs(NOISE_PX), scene.lines, start, prior=replace(prior, sigma_rad=sigma, sigma_m=sigma))
    assert bool((loose.pose_covariance.diagonal(dim1=1, dim2=2)[4:] > 0).all())


def test_cameras_need_arcs_that_know_their_pixels():
    scene = RigScene(frames=4, lines=20)
    blind = replace(scene.arcs(), observed=None)
    with pytest.raises(InputError, match="know their pixels"):
        adjust_lines(blind, scene.lines, scene.cam_from_world, models=scene.models)
