"""The pose of a board from corners of one photo, the camera held: robust least squares from a pose nearby.

    minimise  sum_i log(1 + |p_i - project(R X_i + t)|^2 / (k s)^2)

by iteratively reweighted Levenberg-Marquardt on the left perturbation exp(delta) T, with s the robust standard deviation of the
residuals (their median absolute value), found anew before each round.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._model import CameraModel
from camera_models.pose import Pose, hat

BEND = 2.0
"""k: residuals beyond so many standard deviations lose their say."""
NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_LEAST_SCALE_PX = 0.02
_ROUNDS = 4
_STEPS = 8
FREEDOM = 6
"""Of a pose."""


def refit_pose(
    model: CameraModel, cam_from_board: Pose, board_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Pose, Float[np.ndarray, "n 2"]]:
    """The pose near `cam_from_board` that fits at least four corners best, and their residuals (observed minus projected, px).

    Corners that the camera cannot see from the pose have no say; their residuals mean nothing.
    """
    board, observed = torch.as_tensor(board_m), torch.as_tensor(pixels)
    pose = cam_from_board
    with torch.no_grad():
        for _ in range(_ROUNDS):
            bend = BEND * max(robust_scale_px(_residual_px(model, pose, board, observed).numpy()), _LEAST_SCALE_PX)
            pose, moved = _refined(model, pose, board, observed, bend)
            if not moved:
                break
        return pose, _residual_px(model, pose, board, observed).numpy()


def robust_scale_px(residual_px: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation per axis of the undisturbed part of the residuals of a pose that was fitted to them."""
    freedom = max(residual_px.size - FREEDOM, 1)
    return NORMAL_MAD * float(np.median(np.abs(residual_px))) * float(np.sqrt(residual_px.size / freedom))


def _residual_px(model: CameraModel, pose: Pose, board: Tensor, observed: Tensor) -> Float[Tensor, "n 2"]:
    return observed - model.project(pose.transform(board))[0]


def _refined(model: CameraModel, pose: Pose, board: Tensor, observed: Tensor, bend_px: float) -> tuple[Pose, bool]:
    """A few damped steps with the loss bent at `bend_px`, and whether they moved the corners by more than a thousandth of it."""
    damping, moved = 1e-4, False
    cost, normal, right = _linearised(model, pose, board, observed, bend_px)
    for _ in range(_STEPS):
        step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal() + 1e-12), right)
        trial = Pose.exp(step) @ pose
        found = _linearised(model, trial, board, observed, bend_px)
        if found[0] < cost:
            gain = cost - found[0]
            pose, (cost, normal, right), damping = trial, found, 0.2 * damping
            moved |= gain > 1e-6 * len(board)
            if gain < 1e-9 * cost:
                break
        else:
            damping *= 10.0
    return pose, moved


def _linearised(
    model: CameraModel, pose: Pose, board: Tensor, observed: Tensor, bend_px: float
) -> tuple[float, Float[Tensor, "6 6"], Float[Tensor, "6"]]:
    """Cost, normal matrix and right side; d X = omega x X + v."""
    seen = pose.transform(board)
    projected, valid, by_point, _ = model.project_with_jacobians(seen)
    residual = observed - projected
    share = (residual**2).sum(-1) / bend_px**2
    # What the camera cannot see costs as much as a corner far off, so that no pose hides corners from it.
    cost = float(torch.where(valid, torch.log1p(share), torch.full_like(share, 20.0)).sum())
    by_pose = torch.cat([-by_point @ hat(seen), by_point], -1)
    weighted = by_pose * (valid / (1.0 + share))[:, None, None]
    normal = torch.einsum("nki,nkj->ij", weighted, by_pose)
    return cost, normal, torch.einsum("nki,nk->i", weighted, residual)
