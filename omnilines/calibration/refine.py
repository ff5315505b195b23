"""Joint refinement of a camera's intrinsics and its board poses: minimise the squared reprojection error of the corners."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose, hat
from omnilines.calibration.initialise import BoardPoints
from omnilines.least_squares import KeptGroup, Linearisation, Loss, Progress, Solution, Structure, solve

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class CameraAndBoards:
    """State of the refinement: one camera and the pose of every board."""

    model: CameraModel
    cam_from_board: Pose

    def seen(self, points: BoardPoints) -> Float[Tensor, "n 3"]:
        """Board corners in the camera frame."""
        rotation, translation = self.cam_from_board.rotation[points.view], self.cam_from_board.translation[points.view]
        return (rotation @ points.board[..., None])[..., 0] + translation

    def residual_px(self, points: BoardPoints) -> Float[Tensor, "n 2"]:
        """Projected minus observed pixel."""
        return self.model.project(self.seen(points))[0] - points.pixels


class BoardProblem:
    """Intrinsics are the kept block (directions of `calibration_basis`), every board pose an eliminated one."""

    def __init__(self, points: BoardPoints, basis: Float[Tensor, "p q"], weight: Float[Tensor, " n"] | None = None) -> None:
        self.points = points
        self.basis = basis
        self.weight = torch.ones(len(points.view), dtype=torch.float64) if weight is None else weight
        shared = KeptGroup(torch.zeros_like(points.view), 1, basis.shape[1])
        self.structure = Structure(points.view, points.views, 6, (shared,))

    def residual(self, state: CameraAndBoards) -> Float[Tensor, "n 2"]:
        """Reprojection error in pixels, times the weight of the corner."""
        return state.residual_px(self.points) * self.weight[:, None]

    def linearise(self, state: CameraAndBoards) -> Linearisation:
        """d X = omega x X + v for the left perturbation (omega, v) of a board pose."""
        seen = state.seen(self.points)
        pixels, _, by_point, by_parameter = state.model.project_with_jacobians(seen)
        by_pose = torch.cat([-by_point @ hat(seen), by_point], -1)
        weight = self.weight[:, None, None]
        residual = (pixels - self.points.pixels) * weight[..., 0]
        return Linearisation(residual, by_pose * weight, ((by_parameter @ self.basis) * weight,))

    def retract(self, state: CameraAndBoards, kept: Tensor, eliminated: Tensor) -> CameraAndBoards:
        """Parameters move along the basis, poses by exp(delta) T."""
        model = state.model.with_parameters(state.model.parameters + self.basis @ kept)
        return CameraAndBoards(model, Pose.exp(eliminated) @ state.cam_from_board)

    def gauge(self, state: CameraAndBoards) -> Float[Tensor, "q 0"]:
        """None: the boards fix the frame and the scale."""
        return torch.zeros(self.basis.shape[1], 0, dtype=torch.float64)


def refine(
    points: BoardPoints,
    start: CameraAndBoards,
    loss: Loss | None = None,
    weight: Float[Tensor, " n"] | None = None,
    callback: Callable[[Progress], None] | None = None,
    max_iterations: int = 100,
) -> Solution[CameraAndBoards]:
    """Levenberg-Marquardt from `start`; the residual is in pixels."""
    problem = BoardProblem(points, start.model.calibration_basis(), weight)
    return solve(problem, start, loss, max_iterations=max_iterations, callback=callback)


def robust_scale_px(residual_px: Float[Tensor, "n 2"]) -> float:
    """Standard deviation per axis of the undisturbed part of the residuals, from their median absolute value."""
    return NORMAL_MAD * float(residual_px.abs().median())
