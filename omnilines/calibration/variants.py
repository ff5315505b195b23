"""How many coefficients the polynomial of a camera needs: as many as views that the fit has not seen support.

A polynomial that is too stiff for its lens leaves misfit that grows towards the rim, and would reject the corners there as if
they were wrong. So the last variant of the model, of the highest degree, is fitted too; of both fits the one that all corners are
nearest to says which corners are good, and on these the variants are compared by their held-out error.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.diagnose import grows_beyond
from omnilines.calibration.held_out import HeldOut, held_out
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.robust import RobustFit, RobustTask, nearest_fit, robust_fit
from omnilines.calibration.thresholds import CalibrationThresholds, HeldOutThresholds

SAMPLES = 200


@dataclass(frozen=True)
class CommonCorners:
    """The corners that cameras are compared by: those that one robust fit keeps, of views that it fits."""

    rows: Bool[Tensor, " n"]
    views: list[int]
    points: BoardPoints
    weight: Float[Tensor, " m"] | None

    @staticmethod
    def of(
        points: BoardPoints, weight: Float[Tensor, " n"] | None, kept: Bool[Tensor, " n"], least_corners: int
    ) -> "CommonCorners":
        """Views with half of their corners and as many as a pose needs."""
        left = points.chosen(kept).counts
        good = (2 * left >= points.counts) & (left >= least_corners)
        views = torch.nonzero(good).flatten().tolist()
        rows = kept & good[points.view]
        chosen = points.chosen(kept).of_views(views)
        return CommonCorners(rows, views, chosen, None if weight is None else weight[rows])


def supported_fit(task: RobustTask, fit: RobustFit, thresholds: CalibrationThresholds, least_passes: int) -> RobustFit:
    """The robust fit with the variant of its model that held-out views support, from one with another variant.

    Where too few views fit to compare them, the variant is left as it is.
    """
    model, points = fit.state.model, task.points
    radii = (task.clean.pixels - model.centre_px).norm(dim=-1)
    rho_px = torch.linspace(float(radii.min()), float(radii.max()), SAMPLES, dtype=torch.float64)
    richest = replace(fit.state, model=model.of_variant(model.VARIANTS[-1], rho_px))
    rich = robust_fit(task, richest, least_passes=2)
    judge = nearest_fit((fit, rich), points, task.weight)
    common = CommonCorners.of(points, task.weight, judge.kept, thresholds.views.least_corners)
    if len(common.views) < thresholds.held_out.least_views:
        return fit
    chosen = _supported(common, judge.state, rho_px, thresholds.held_out)
    if chosen.variant == model.variant:
        return fit
    return robust_fit(task, replace(judge.state, model=chosen), least_passes=least_passes)


def _supported(
    common: CommonCorners, state: CameraAndBoards, rho_px: Float[Tensor, " k"], thresholds: HeldOutThresholds
) -> CameraModel:
    """The variant with the fewest parameters that predicts views as well as the best, up to that of the state."""
    model, poses = state.model, state.cam_from_board[common.views]
    tried: list[tuple[CameraModel, HeldOut]] = []
    for variant in reversed(model.VARIANTS[: model.VARIANTS.index(model.variant) + 1]):
        start = CameraAndBoards(model.of_variant(variant, rho_px), poses)
        problem = BoardProblem(common.points, start.model.calibration_basis(), common.weight)
        found = problem.solve(start, tolerance=1e-2).state
        tried.append((found.model, held_out(problem, found)))
        if tried[-1][1].rms_px > thresholds.risen_factor * min(error.rms_px for _, error in tried):
            break
    growing = [trial for trial in tried if grows_beyond(trial[0], common.points.pixels, thresholds.beyond_factor)] or tried
    best = min(growing, key=lambda trial: trial[1].rms_px)
    return next(found for found, error in reversed(growing) if error.as_good_as(best[1], thresholds.no_worse_factor))
