"""Joint refinement of a camera's intrinsics, its board poses and, if asked, the shape of the board: minimise the squared
reprojection error of the corners."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose, hat
from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.least_squares import KeptGroup, Linearisation, Loss, Progress, Solution, Structure, solve
from omnilines.least_squares.groups import OPEN, Groups
from omnilines.least_squares.variance import NORMAL_MAD


@dataclass(frozen=True)
class CameraAndBoards:
    """State of the refinement: one camera, the pose of every board, and how the board differs from its drawing."""

    model: CameraModel
    cam_from_board: Pose
    shape: BoardShape = AS_DRAWN

    def seen(self, points: BoardPoints) -> Float[Tensor, "n 3"]:
        """Board corners in the camera frame."""
        rotation, translation = self.cam_from_board.rotation[points.view], self.cam_from_board.translation[points.view]
        return (rotation @ self.shape.place(points.board)[..., None])[..., 0] + translation

    def residual_px(self, points: BoardPoints) -> Float[Tensor, "n 2"]:
        """Projected minus observed pixel."""
        return self.model.project(self.seen(points))[0] - points.pixels


class BoardProblem:
    """Intrinsics (along `basis`, columns of the parameter vector) and the free board terms are the kept block, every board pose
    an eliminated one. With a basis of no columns the camera is held."""

    def __init__(
        self,
        points: BoardPoints,
        basis: Float[Tensor, "p q"],
        weight: Float[Tensor, " n"] | None = None,
        shape: BoardShape | None = None,
    ) -> None:
        self.points, self.basis = points, basis
        self.weight = torch.ones(len(points.view), dtype=torch.float64) if weight is None else weight
        self.free_terms = (shape or AS_DRAWN).free
        kept = basis.shape[1] + self.free_terms.shape[1]
        groups = (KeptGroup(torch.zeros_like(points.view), 1, kept),) if kept else ()
        self.structure = Structure(points.view, points.views, 6, groups)
        self._last: tuple[CameraAndBoards, Linearisation] | None = None

    def linearise(self, state: CameraAndBoards) -> Linearisation:
        """Reprojection error (px) times the weight of the corner; d X = omega x X + v for the left perturbation of a pose."""
        # A solution begins where the one before ended.
        if self._last is None or self._last[0] is not state:
            self._last = state, self._linearised(state)
        return self._last[1]

    def _linearised(self, state: CameraAndBoards) -> Linearisation:
        seen = state.seen(self.points)
        pixels, _, by_point, by_parameter = state.model.project_with_jacobians(seen)
        by_point = by_point * self.weight[:, None, None]
        by_pose = torch.cat([-by_point @ hat(seen), by_point], -1)
        residual = (pixels - self.points.pixels) * self.weight[:, None]
        by_kept = (by_parameter @ self.basis) * self.weight[:, None, None]
        if self.free_terms.shape[1]:
            turned = state.cam_from_board.rotation[self.points.view] @ (state.shape.by_terms(self.points.board) @ self.free_terms)
            by_kept = torch.cat([by_kept, by_point @ turned], -1)
        return Linearisation(residual, by_pose, (by_kept,) if self.structure.groups else ())

    def by_views(self, state: CameraAndBoards) -> Groups:
        """What each view adds to the normal equations of the kept block, its pose eliminated."""
        at = self.linearise(state)
        gram = self.points.cells.gram(torch.cat([at.by_eliminated, *at.by_kept, at.residual[..., None]], -1))
        own, coupling, rest = gram[:, :6, :6], gram[:, :6, 6:], gram[:, 6:, 6:]
        scale = own.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
        value, vector = torch.linalg.eigh(own * scale[:, :, None] * scale[:, None])
        known = value > OPEN * value[:, -1:].clamp_min(1e-300)
        eliminated, _ = torch.linalg.solve_ex(own, coupling)
        # A corner or two, or corners in a heap, leave a pose open: it takes no part along what they do not tell. Rounding hides
        # that, and a pose solved for all the same makes numbers of any size and sign.
        if (open_ones := ~known.all(1)).any():
            along = scale[open_ones, :, None] * vector[open_ones]
            inverse = torch.where(known, 1 / value, 0.0)[open_ones]
            eliminated[open_ones] = along @ (inverse[..., None] * (along.mT @ coupling[open_ones]))
        reduced = rest - coupling.mT @ eliminated
        return Groups(reduced[:, :-1, :-1], -reduced[:, :-1, -1])

    def retract(self, state: CameraAndBoards, kept: Tensor, eliminated: Tensor) -> CameraAndBoards:
        """Parameters and board terms move along their columns, poses by exp(delta) T."""
        camera, terms = kept[: self.basis.shape[1]], kept[self.basis.shape[1] :]
        model = state.model.with_parameters(state.model.parameters + self.basis @ camera)
        return CameraAndBoards(model, Pose.exp(eliminated) @ state.cam_from_board, state.shape.moved(self.free_terms @ terms))

    def gauge(self, state: CameraAndBoards) -> Float[Tensor, "q 0"]:
        """None: the boards fix the frame and the scale."""
        return torch.zeros(self.structure.kept_size, 0, dtype=torch.float64)

    def solve(
        self,
        start: CameraAndBoards,
        loss: Loss | None = None,
        *,
        max_iterations: int = 100,
        tolerance: float = 1e-12,
        callback: Callable[[Progress], None] | None = None,
    ) -> Solution[CameraAndBoards]:
        """Levenberg-Marquardt from `start`."""
        return solve(self, start, loss, max_iterations=max_iterations, tolerance=tolerance, callback=callback)


def whitened(residual_px: Float[Tensor, "n 2"], weight: Float[Tensor, " n"] | None) -> Float[Tensor, "n 2"]:
    """Residuals times the weights of their corners, where there are any."""
    return residual_px if weight is None else residual_px * weight[:, None]


def robust_scale_px(residual_px: Float[Tensor, "n 2"], many_unknowns_share: float, unknowns: int = 0) -> float:
    """Standard deviation per axis of the undisturbed part of the residuals, from their median absolute value.

    A robust fit of many `unknowns` brings as many residuals near zero, which say nothing of the noise: where that is more than
    `many_unknowns_share` of all, the median is that of the others (R. A. Maronna et al., Robust Statistics, 2006, section 4.4.2).
    """
    size = residual_px.abs().flatten()
    if unknowns > many_unknowns_share * len(size):
        size = size.sort().values[min(unknowns, len(size) - 1) :]
    return NORMAL_MAD * float(size.median())
