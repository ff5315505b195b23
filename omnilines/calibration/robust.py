"""From a rough start to the corners that can be trusted: a loss scaled by the residuals of the data, anew as the fit improves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards, robust_scale_px, whitened
from omnilines.calibration.thresholds import RobustThresholds
from omnilines.least_squares import Loss, Progress

PASSES = 12
CONVERGED = 0.05
"""Relative change of the scale below which, with the same corners kept, nothing more is to be gained."""
LEAST_SCALE_PX = 1e-6


@dataclass(frozen=True)
class RobustFit:
    """A robust fit: the state, the corners that are near enough to it, and the standard deviation per axis of those (of weighted
    residuals, pixels)."""

    state: CameraAndBoards
    kept: Bool[Tensor, " n"]
    scale_px: float
    limit_px: float
    """Length of the residual of a corner of ordinary weight beyond which it is rejected."""


@dataclass(frozen=True, eq=False)
class RobustTask:
    """What is fitted robustly."""

    points: BoardPoints
    clean: BoardPoints
    """The corners without gross error, from which views that do not fit are resected again."""
    weight: Float[Tensor, " n"] | None
    loss: str
    thresholds: RobustThresholds
    stated_px: float = 0.0
    """Root mean square of the corners' stated standard deviations, that of weight 1; 0 where none are stated."""
    callback: Callable[[Progress], None] | None = None

    def residual_px(self, state: CameraAndBoards) -> Float[Tensor, "n 2"]:
        """Weighted."""
        return whitened(state.residual_px(self.points), self.weight)

    def judged(self, state: CameraAndBoards, unknowns: int) -> RobustFit:
        """The scale of the residuals of a state, and the corners that are near enough."""
        residual = self.residual_px(state)
        share = self.thresholds.many_unknowns_share
        scale = max(robust_scale_px(residual, share, unknowns), LEAST_SCALE_PX)
        weight = torch.ones(len(residual), dtype=residual.dtype) if self.weight is None else self.weight
        residuals = residual.new_full((), scale)
        own = own_scale(residuals, residuals.clamp_max(self.stated_px), weight)
        limit = self.thresholds.reject_sigma
        return RobustFit(state, residual.norm(dim=-1) <= limit * own, scale, limit * scale)


def own_scale(scale: Float[Tensor, "*n"], noise: Float[Tensor, "*n"], weight: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """By which the weighted residual of each corner is judged.

    What residuals are larger by than corners are stated to be (a board that bends, a model that does not suit) is as large for
    all: with a corner of weight w that is stated to s / w the unweighted one is the root of (scale^2 - s^2) + s^2 / w^2.
    """
    return ((scale**2 - noise**2) * weight**2 + noise**2).sqrt()


def robust_fit(
    task: RobustTask, state: CameraAndBoards, *, basis: Float[Tensor, "p q"] | None = None, least_passes: int = 3
) -> RobustFit:
    """Refine with a loss scaled by the residuals until their scale and the set of kept corners converge.

    With a `basis` of no columns the camera is held. What is free of the board in the shape of the state is estimated too. Two
    passes are enough where another fit of all corners follows.
    """
    along = state.model.calibration_basis() if basis is None else basis
    problem = BoardProblem(task.points, along, task.weight, state.shape)
    unknowns = 6 * task.points.views + problem.structure.kept_size
    fit = task.judged(state, unknowns)
    for done in range(PASSES):
        scaled = Loss(task.loss, task.thresholds.loss_scale * fit.scale_px)
        # The first passes only have to bring the scale down.
        solution = problem.solve(fit.state, scaled, tolerance=1e-2 if done < 2 else 1e-4, callback=task.callback)
        before, fit = fit, task.judged(solution.state, unknowns)
        if done < 2:
            fit = _turned_over(task, fit, unknowns)
        if (
            done >= least_passes - 1
            and bool((fit.kept == before.kept).all())
            and fit.scale_px > (1 - CONVERGED) * before.scale_px
        ):
            break
    return fit


def _turned_over(task: RobustTask, fit: RobustFit, unknowns: int) -> RobustFit:
    """Views that do not fit are resected afresh with the camera as it is now: they may have started on the wrong side of their
    tilt. Where that brings their corners nearer it is kept."""
    points, clean = task.points, task.clean
    residual = task.residual_px(fit.state).norm(dim=-1)
    cost = points.mean_by_view(torch.log1p((residual / fit.scale_px) ** 2)[:, None])[:, 0]
    doubtful = points.mean_by_view(fit.kept.to(cost.dtype)[:, None])[:, 0] < 0.5
    if not bool(doubtful.any()):
        return fit
    bearings, _ = fit.state.model.unproject(clean.pixels)
    fresh = resect_boards(clean, bearings)
    again = task.residual_px(CameraAndBoards(fit.state.model, fresh, fit.state.shape)).norm(dim=-1)
    better = doubtful & (points.mean_by_view(torch.log1p((again / fit.scale_px) ** 2)[:, None])[:, 0] < cost)
    if not bool(better.any()):
        return fit
    old = fit.state.cam_from_board
    rotation = torch.where(better[:, None, None], fresh.rotation, old.rotation)
    translation = torch.where(better[:, None], fresh.translation, old.translation)
    return task.judged(CameraAndBoards(fit.state.model, Pose(rotation, translation), fit.state.shape), unknowns)


def nearest_fit(fits: Sequence[RobustFit], points: BoardPoints, weight: Float[Tensor, " n"] | None) -> RobustFit:
    """The fit that all corners are nearest to by one loss at one scale, the least of theirs.

    Neither the scale of a fit nor the corners it keeps can tell: a camera that is too stiff keeps corners that are wrong, since
    its scale is large, or fits well where it keeps only the middle of the image.
    """
    scale = min(fit.scale_px for fit in fits)

    def cost(fit: RobustFit) -> float:
        residual = whitened(fit.state.residual_px(points), weight)
        return float(torch.log1p(residual.square().sum(-1) / (2 * scale) ** 2).sum())

    return min(fits, key=cost)
