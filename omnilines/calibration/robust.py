"""From a rough start to the corners that can be trusted: a loss bent at the scale of the data, tightened as the fit improves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards, robust_scale_px, whitened
from omnilines.least_squares import Loss, Progress

REJECT_SIGMA = 4.5
"""Corners farther than this many robust standard deviations (of the norm) are rejected."""
PASSES = 12
SETTLED = 0.05
"""Relative change of the scale below which, with the same corners kept, nothing more is to be gained."""
LEAST_SCALE_PX = 1e-6


@dataclass(frozen=True)
class Settled:
    """A robust fit: the state, the corners within REJECT_SIGMA of it, and the standard deviation per axis of those (of weighted
    residuals, pixels)."""

    state: CameraAndBoards
    kept: Bool[Tensor, " n"]
    scale_px: float

    @property
    def limit_px(self) -> float:
        """Length of a weighted residual beyond which a corner is rejected."""
        return REJECT_SIGMA * self.scale_px


def settle(
    points: BoardPoints,
    clean: BoardPoints,
    state: CameraAndBoards,
    loss: str,
    weight: Float[Tensor, " n"] | None,
    callback: Callable[[Progress], None] | None = None,
    basis: Float[Tensor, "p q"] | None = None,
    least_passes: int = 3,
) -> Settled:
    """Refine with a loss bent at twice the scale of the residuals until the scale and the set of kept corners settle.

    `clean` are the corners without gross error, from which views that do not fit are resected again. With a `basis` of no columns
    the camera is held. Two passes are enough where another fit of all corners follows.
    """
    problem = BoardProblem(points, state.model.calibration_basis() if basis is None else basis, weight)
    unknowns = 6 * points.views + problem.basis.shape[1]
    settled = _judge(points, state, weight, unknowns)
    for done in range(PASSES):
        bent = Loss(loss, 2 * settled.scale_px)
        # The first passes only have to bring the scale down.
        solution = problem.solve(settled.state, bent, tolerance=1e-2 if done < 2 else 1e-4, callback=callback)
        before, settled = settled, _judge(points, solution.state, weight, unknowns)
        if done < 2:
            settled = _turned_over(points, clean, settled, weight, unknowns)
        if (
            done >= least_passes - 1
            and bool((settled.kept == before.kept).all())
            and settled.scale_px > (1 - SETTLED) * before.scale_px
        ):
            break
    return settled


def _judge(points: BoardPoints, state: CameraAndBoards, weight: Float[Tensor, " n"] | None, unknowns: int) -> Settled:
    residual = whitened(state.residual_px(points), weight)
    scale = max(robust_scale_px(residual, unknowns), LEAST_SCALE_PX)
    return Settled(state, residual.norm(dim=-1) <= REJECT_SIGMA * scale, scale)


def _turned_over(
    points: BoardPoints, clean: BoardPoints, settled: Settled, weight: Float[Tensor, " n"] | None, unknowns: int
) -> Settled:
    """Views that do not fit are resected afresh with the camera as it is now: they may have started on the wrong side of their
    tilt. Where that brings their corners nearer it is kept."""
    residual = whitened(settled.state.residual_px(points), weight).norm(dim=-1)
    cost = points.mean_by_view(torch.log1p((residual / settled.scale_px) ** 2)[:, None])[:, 0]
    doubtful = points.mean_by_view(settled.kept.to(cost.dtype)[:, None])[:, 0] < 0.5
    if not bool(doubtful.any()):
        return settled
    bearings, _ = settled.state.model.unproject(clean.pixels)
    fresh = resect_boards(clean, bearings)
    state = CameraAndBoards(settled.state.model, fresh, settled.state.shape)
    again = whitened(state.residual_px(points), weight).norm(dim=-1)
    better = doubtful & (points.mean_by_view(torch.log1p((again / settled.scale_px) ** 2)[:, None])[:, 0] < cost)
    if not bool(better.any()):
        return settled
    old = settled.state.cam_from_board
    rotation = torch.where(better[:, None, None], fresh.rotation, old.rotation)
    translation = torch.where(better[:, None], fresh.translation, old.translation)
    state = CameraAndBoards(settled.state.model, Pose(rotation, translation), settled.state.shape)
    return _judge(points, state, weight, unknowns)


def nearest_fit(fits: Sequence[Settled], points: BoardPoints, weight: Float[Tensor, " n"] | None) -> Settled:
    """The fit that all corners are nearest to by one loss at one scale, the least of theirs.

    Neither the scale of a fit nor the corners it keeps can tell: a camera that is too stiff keeps corners that are wrong, since
    its scale is large, or fits well where it keeps only the middle of the image.
    """
    scale = min(fit.scale_px for fit in fits)

    def cost(fit: Settled) -> float:
        residual = whitened(fit.state.residual_px(points), weight)
        return float(torch.log1p(residual.square().sum(-1) / (2 * scale) ** 2).sum())

    return min(fits, key=cost)
