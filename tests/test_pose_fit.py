"""The robust fit of a pose: its minimum against SciPy's, with residuals of pixels and of bearings."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from camera_models import OpenCVFisheye
from camera_models.pose import Pose
from camera_models.pose_fit import LOSS_SIGMAS, Residuals, by_pose, fit_pose, pose_covariance, refit_pose
from omnilines.posing.bearing_residual import across, bearing_residual, placed

CAMERA = OpenCVFisheye([300.0, 300.0, 400.0, 300.0, 0.02, -0.01, 0.0, 0.0], (800, 600))
TRUE = Pose.exp(torch.tensor([0.2, -0.3, 0.1, 0.05, -0.02, 0.4], dtype=torch.float64))
NEAR = Pose.exp(torch.tensor([0.03, 0.02, -0.01, 0.01, 0.0, -0.02], dtype=torch.float64)) @ TRUE


def board(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([rng.uniform(-0.3, 0.3, (60, 2)), rng.uniform(-0.05, 0.05, (60, 1))], 1)


def seen(points: np.ndarray, pose: Pose = TRUE) -> np.ndarray:
    return CAMERA.project(pose.transform(torch.as_tensor(points)))[0].numpy()


@pytest.mark.slow
def test_a_pose_from_pixels_is_the_least_squares_one_and_its_covariance_is_what_poses_scatter_by() -> None:
    rng = np.random.default_rng(0)
    points = board(rng)
    covariance = pose_covariance(CAMERA, TRUE, points, 0.2)
    off = []
    for _ in range(60):
        pixels = seen(points) + rng.normal(0.0, 0.2, (60, 2))
        pose, residual = refit_pose(CAMERA, NEAR, points, pixels)
        np.testing.assert_allclose(residual, pixels - seen(points, pose), atol=1e-9)
        off.append((pose @ TRUE.inverse()).log().numpy())
    ratio = np.var(off, axis=0) / covariance.diagonal()
    assert 0.6 < ratio.min() and ratio.max() < 1.8
    np.testing.assert_allclose(pose_covariance(CAMERA, TRUE, points, np.full(60, 0.2)), covariance, rtol=1e-12)


@pytest.mark.parametrize("kind", ["pixels", "bearings"])
@pytest.mark.slow
def test_a_pose_has_the_least_robust_cost_with_a_fifth_of_wrong_points(kind: str) -> None:
    rng = np.random.default_rng(1)
    points = torch.as_tensor(board(rng))
    exact = TRUE.transform(points)
    bearings = exact / exact.norm(dim=-1, keepdim=True) + 1e-3 * torch.as_tensor(rng.normal(size=(60, 3)))
    bearings[::5] += 0.1 * torch.as_tensor(rng.normal(size=(12, 3)))
    bearings = bearings / bearings.norm(dim=-1, keepdim=True)
    pixels, rows = CAMERA.project(bearings)[0], across(bearings) / 1e-3

    def residuals_at(pose: Pose) -> Residuals:
        there = pose.transform(points)
        if kind == "pixels":
            projected, valid, by_point, _ = CAMERA.project_with_jacobians(there)
            return (projected - pixels) / 0.3, by_pose(by_point, there) / 0.3, valid
        residual, by_point = bearing_residual(bearings, rows, placed(pose, points))
        return residual, by_pose(by_point, there), None

    fit = fit_pose(NEAR, residuals_at, LOSS_SIGMAS, steps=30, least_gain=1e-12)

    def lengths(delta: np.ndarray) -> np.ndarray:
        return residuals_at(Pose.exp(torch.as_tensor(delta)) @ TRUE)[0].norm(dim=-1).numpy() / LOSS_SIGMAS

    theirs = least_squares(lengths, np.zeros(6), loss="cauchy", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert fit.moved and fit.cost == pytest.approx(2.0 * theirs.cost, rel=1e-9)
    off = (fit.pose @ (Pose.exp(torch.as_tensor(theirs.x)) @ TRUE).inverse()).log()
    assert float(off.abs().max()) < 1e-5


def test_points_that_the_camera_does_not_see_cost_more_than_those_it_does() -> None:
    """No pose is better for hiding points, and hidden ones do not move it."""
    points = torch.as_tensor(board(np.random.default_rng(2)))
    pixels = torch.as_tensor(seen(points.numpy()))

    def residuals_at(pose: Pose) -> Residuals:
        there = pose.transform(points)
        projected, valid, by_point, _ = CAMERA.project_with_jacobians(there)
        valid = valid.clone()
        valid[:6] = False
        return projected - pixels, by_pose(by_point, there), valid

    fit = fit_pose(NEAR, residuals_at, 1.0, steps=30, least_gain=1e-12)
    assert fit.cost == pytest.approx(6 * 20.0, rel=1e-9)
    assert float((fit.pose @ TRUE.inverse()).log().abs().max()) < 1e-8
    again = fit_pose(fit.pose, residuals_at, 1.0, steps=8, least_gain=1e-9)
    assert not again.moved
