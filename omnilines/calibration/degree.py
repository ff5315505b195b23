"""How many coefficients the polynomial of a camera needs: as many as views that the fit has not seen support.

A polynomial that is too stiff for its lens leaves misfit that grows towards the rim, and would reject the corners there as if
they were wrong. So the highest degree is fitted too; of both fits the one that all corners are nearest to says which corners are
good, and on these the degrees are compared by their held-out error.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import Scaramuzza
from omnilines.calibration.diagnose import grows_beyond
from omnilines.calibration.held_out import HeldOut, held_out
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.robust import Settled, nearest_fit, settle
from omnilines.calibration.views import LEAST_CORNERS
from omnilines.least_squares import Progress

LEAST_DEGREE, MOST_DEGREE = 3, 8
LEAST_VIEWS = 5
"""Fewer views do not tell degrees or models apart."""
RISEN = 1.1
"""A held-out error greater than the least by this factor will not fall again with fewer coefficients."""
SAMPLES = 200


@dataclass(frozen=True)
class CommonCorners:
    """The corners that cameras are compared by: those that one robust fit keeps, of views that it fits."""

    rows: Bool[Tensor, " n"]
    views: list[int]
    points: BoardPoints
    weight: Float[Tensor, " m"] | None

    @staticmethod
    def of(points: BoardPoints, weight: Float[Tensor, " n"] | None, kept: Bool[Tensor, " n"]) -> "CommonCorners":
        """Views with half of their corners and as many as a pose needs."""
        left = points.chosen(kept).counts
        good = (2 * left >= points.counts) & (left >= LEAST_CORNERS)
        views = torch.nonzero(good).flatten().tolist()
        rows = kept & good[points.view]
        chosen = points.chosen(kept).of_views(views)
        return CommonCorners(rows, views, chosen, None if weight is None else weight[rows])


def settle_degree(
    points: BoardPoints,
    clean: BoardPoints,
    settled: Settled,
    loss: str,
    weight: Float[Tensor, " n"] | None,
    callback: Callable[[Progress], None] | None,
    least_passes: int,
) -> Settled:
    """The robust fit with the degree that held-out views support, from one with another degree.

    Of fewer than LEAST_VIEWS views that fit, the degree is left as it is. The arguments are those of `robust.settle`.
    """
    model = settled.state.model
    assert isinstance(model, Scaramuzza)
    radii = (clean.pixels - model.centre_px).norm(dim=-1)
    rho_px = torch.linspace(float(radii.min()), float(radii.max()), SAMPLES, dtype=torch.float64)
    richest = replace(settled.state, model=model.of_degree(MOST_DEGREE, rho_px))
    rich = settle(points, clean, richest, loss, weight, callback, least_passes=2)
    judge = nearest_fit((settled, rich), points, weight)
    common = CommonCorners.of(points, weight, judge.kept)
    if len(common.views) < LEAST_VIEWS:
        return settled
    chosen = _supported(common, judge.state, rho_px)
    if chosen.degree == model.degree:
        return settled
    return settle(points, clean, replace(judge.state, model=chosen), loss, weight, callback, least_passes=least_passes)


def _supported(common: CommonCorners, state: CameraAndBoards, rho_px: Float[Tensor, " k"]) -> Scaramuzza:
    """The polynomial of the least degree that predicts views as well as the best."""
    model, poses = state.model, state.cam_from_board[common.views]
    assert isinstance(model, Scaramuzza)
    tried: list[tuple[Scaramuzza, HeldOut]] = []
    for degree in range(model.degree, LEAST_DEGREE - 1, -1):
        start = CameraAndBoards(model.of_degree(degree, rho_px), poses)
        problem = BoardProblem(common.points, start.model.calibration_basis(), common.weight)
        found = problem.solve(start, tolerance=1e-2).state
        assert isinstance(found.model, Scaramuzza)
        tried.append((found.model, held_out(problem, found)))
        if tried[-1][1].rms_px > RISEN * min(error.rms_px for _, error in tried):
            break
    growing = [trial for trial in tried if grows_beyond(trial[0], common.points.pixels)] or tried
    best = min(growing, key=lambda trial: trial[1].rms_px)
    return next(found for found, error in reversed(growing) if error.as_good_as(best[1]))
