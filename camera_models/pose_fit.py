"""The pose of a camera from what it sees of known points: robust least squares from a pose nearby.

    minimise  sum_i log(1 + |r_i(T)|^2 / c^2)

by iteratively reweighted Levenberg-Marquardt on the left perturbation exp(delta) T. `fit_pose` takes residuals r of any
kind with their derivatives; `refit_pose` takes those of corners in pixels, and finds c from them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._model import CameraModel
from camera_models.pose import Pose, hat

LOSS_SIGMAS = 2.0
"""c in standard deviations: residuals beyond lose their say."""
NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
FREEDOM = 6
"""Of a pose."""
_UNSEEN_COST = 20.0
"""What the camera cannot see costs as much as a point far off, so that no pose hides points from it."""
_MOST_DAMPING = 1e8
LEAST_SCALE_PX = 0.02
_ROUNDS, _STEPS, _LEAST_GAIN = 4, 8, 1e-9
_MOVED = 1e-6
"""A step that lowers the cost by more than this for each point has moved them by more than a thousandth of c."""

Residuals = tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 6"], Bool[Tensor, " n"] | None]
"""Residuals of a pose, their derivatives by its left perturbation (rotation_rad, translation_m), and which points are seen (None:
all)."""


class PoseFit(NamedTuple):
    """Where a fit ended."""

    pose: Pose
    cost: float
    moved: bool
    """Whether some step was worth it."""


def by_pose(by_point: Float[Tensor, "n 2 3"], seen: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 6"]:
    """Derivatives by the left perturbation exp(delta) T, delta = (rotation_rad, translation_m), of what depends on points in the
    camera frame (`seen`), from those by the points: d X = omega x X + v."""
    return torch.cat([-by_point @ hat(seen), by_point], -1)


def fit_pose(
    start: Pose, residuals_at: Callable[[Pose], Residuals], loss_scale: float, *, steps: int, least_gain: float
) -> PoseFit:
    """The pose near a start with the least robust cost, after `steps` damped steps at most.

    `loss_scale` is c, in the unit of the residuals; a step that gains less than `least_gain` of the cost is the last.
    """
    pose, damping, moved = start, 1e-4, False
    residual, jacobian, seen = residuals_at(pose)
    cost, normal, right = _normal_equations(residual, jacobian, seen, loss_scale)
    for _ in range(steps):
        step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal() + 1e-12), right)
        trial = Pose.exp(step) @ pose
        found = _normal_equations(*residuals_at(trial), loss_scale)
        if found[0] < cost:
            gain = cost - found[0]
            pose, (cost, normal, right), damping = trial, found, 0.2 * damping
            moved |= gain > _MOVED * len(residual)
            if gain < least_gain * cost:
                break
        else:
            damping *= 10.0
            if damping > _MOST_DAMPING:
                break
    return PoseFit(pose, cost, moved)


def _normal_equations(
    residual: Float[Tensor, "n 2"], jacobian: Float[Tensor, "n 2 6"], seen: Bool[Tensor, " n"] | None, loss_scale: float
) -> tuple[float, Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """Robust cost, normal matrix and right side."""
    share = residual.square().sum(-1) / loss_scale**2
    loss = torch.log1p(share)
    if seen is None:
        weighted = jacobian / (1.0 + share)[:, None, None]
    else:
        loss = torch.where(seen, loss, torch.full_like(share, _UNSEEN_COST))
        weighted = jacobian * (seen / (1.0 + share))[:, None, None]
    normal = torch.einsum("nki,nkj->ij", weighted, jacobian)
    return float(loss.sum()), normal, -torch.einsum("nki,nk->i", weighted, residual)


def refit_pose(
    model: CameraModel, cam_from_board: Pose, board_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Pose, Float[np.ndarray, "n 2"]]:
    """The pose near `cam_from_board` that fits at least four corners best, and their residuals (observed minus projected, px).

    The loss has its scale from the robust standard deviation of the residuals, found anew before each round. Corners that the
    camera cannot see from the pose have no say; their residuals mean nothing.
    """
    board, observed = torch.as_tensor(board_m), torch.as_tensor(pixels)

    def residuals_at(pose: Pose) -> Residuals:
        seen = pose.transform(board)
        projected, valid, by_point, _ = model.project_with_jacobians(seen)
        return projected - observed, by_pose(by_point, seen), valid

    pose = cam_from_board
    with torch.no_grad():
        for _ in range(_ROUNDS):
            scale_px = robust_scale_px((observed - model.project(pose.transform(board))[0]).numpy())
            loss_px = LOSS_SIGMAS * max(scale_px, LEAST_SCALE_PX)
            fit = fit_pose(pose, residuals_at, loss_px, steps=_STEPS, least_gain=_LEAST_GAIN)
            pose = fit.pose
            if not fit.moved:
                break
        return pose, (observed - model.project(pose.transform(board))[0]).numpy()


def robust_scale_px(residual_px: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation per axis of the undisturbed part of the residuals of a pose that was fitted to them."""
    freedom = max(residual_px.size - FREEDOM, 1)
    return NORMAL_MAD * float(np.median(np.abs(residual_px))) * float(np.sqrt(residual_px.size / freedom))


def pose_covariance(
    model: CameraModel, pose: Pose, points_m: Float[np.ndarray, "n 3"], sigma_px: float | Float[np.ndarray, " n"]
) -> Float[np.ndarray, "6 6"]:
    """(J' J)^-1 of a pose fitted to pixels of standard deviations `sigma_px`, J by the left perturbation of the pose."""
    with torch.no_grad():
        seen = pose.transform(torch.as_tensor(points_m))
        _, valid, by_point, _ = model.project_with_jacobians(seen)
        rows = (by_pose(by_point, seen) * (valid / torch.as_tensor(sigma_px))[:, None, None]).flatten(0, 1)
        inverse: Float[np.ndarray, "6 6"] = torch.linalg.inv(rows.mT @ rows).numpy()
    return inverse
