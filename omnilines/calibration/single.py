"""One camera from views of a plane board: start from rays, fit robustly, refine by plain least squares, say how certain."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.diagnose import angles_off_axis, refuse_parallel_boards
from omnilines.calibration.finish import LastFit, camera_result
from omnilines.calibration.flipped import flipped_views
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.photo_changes import unlike_views
from omnilines.calibration.redundancy import IN_PIXELS, basis_without, redundant_parameter
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.robust import RobustFit, RobustTask, robust_fit
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.start import CameraKind, ranked_starts
from omnilines.calibration.table_doubts import refuse_other_squares, size_notes
from omnilines.calibration.terms import without_unsupported_terms
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.variants import supported_fit
from omnilines.calibration.views import UsableCorners, board_points, corner_weights, require_views, views_lost
from omnilines.least_squares import Outcome, Progress, Solution
from omnilines.records import Corners


def calibrate_camera(
    corners: Corners,
    image_size: tuple[int, int],
    model: str = "scaramuzza",
    *,
    loss: str = "cauchy",
    mirror: bool = False,
    options: Mapping[str, Any] | None = None,
    refine_board: tuple[str, ...] = (),
    thresholds: CalibrationThresholds = CalibrationThresholds(),
    callback: Callable[[Progress], None] | None = None,
) -> CameraCalibration:
    """Calibrate without any guess of focal length or centre.

    With `loss` "none" every corner counts and plain least squares is minimised. With "huber" or "cauchy" the loss is scaled
    by the residuals, corners beyond `robust.reject_sigma` and views with fewer than half of their corners left are rejected, and
    the kept corners are fitted again by plain least squares. `options` go to the model (`degree`, `coefficients`). Without a
    `degree` that of a polynomial is chosen by held-out views (`calibration.variants`); without `coefficients`, distortion that
    they do not support is held at 0 (`calibration.terms`). `refine_board` names what is estimated of the board
    (`options.REFINABLE`).

    Raises InputError for too few views and GeometryError for degenerate sets.
    """
    usable = UsableCorners.of(corners, thresholds.views)
    kind = CameraKind(image_size, model, mirror, options)
    return calibrate_from_fit(
        usable,
        robust_camera(usable.points, usable.weight, kind, loss, thresholds, stated_px=usable.stated_px, callback=callback),
        loss=loss,
        refine_board=refine_board,
        hold_unsupported=kind.variant_open,
        thresholds=thresholds,
        callback=callback,
    )


def calibrate_from_fit(
    usable: UsableCorners,
    fit: RobustFit,
    *,
    loss: str = "cauchy",
    refine_board: tuple[str, ...] = (),
    hold_unsupported: bool = True,
    thresholds: CalibrationThresholds = CalibrationThresholds(),
    callback: Callable[[Progress], None] | None = None,
) -> CameraCalibration:
    """The rest of `calibrate_camera`: from the robust fit of all usable corners to plain least squares of those that it keeps."""
    corners, rows, refusals = usable.corners, usable.rows, dict(usable.refusals)
    shape = BoardShape.to_refine(refine_board, usable.points.board)
    parallel_deg = thresholds.degeneracy.parallel_deg
    refuse_parallel_boards(fit.state.cam_from_board, parallel_deg)
    if loss != "none" and not shape.plain:
        # Corners are judged by the board that is estimated: as drawn, it would reject good ones and keep wrong ones.
        smooth, _ = smooth_corners(usable.points, thresholds.screening)
        clean = usable.points.chosen(smooth)
        task = RobustTask(usable.points, clean, usable.weight, loss, thresholds.robust, usable.stated_px, callback)
        fit = robust_fit(task, replace(fit.state, shape=shape))
    kept = fit.kept if loss != "none" else torch.ones_like(fit.kept)
    fitting = rows.copy()
    fitting[rows] = kept.numpy()
    lost = views_lost(corners, rows, fitting, thresholds.views.least_corners)
    refusals |= lost
    if loss != "none":
        refusals |= _unlike(usable, fit, list(lost), thresholds) | _flipped(usable, fit, thresholds)
    good = [k for k, v in enumerate(usable.views) if v not in refusals]
    require_views(len(good), len(corners.view_names), refusals, thresholds.views.least_views)
    views = [usable.views[k] for k in good]
    final_rows = fitting & np.isin(corners.view, views)
    final = LastFit(
        corners=corners,
        rows=final_rows,
        views=views,
        points=board_points(corners, final_rows, views),
        weight=corner_weights(corners, final_rows),
        refusals=refusals,
        limit_px=fit.limit_px if loss != "none" else None,
        thresholds=thresholds,
    )
    start = CameraAndBoards(fit.state.model, fit.state.cam_from_board[good], shape if loss == "none" else fit.state.shape)
    basis = start.model.calibration_basis()
    problem = BoardProblem(final.points, basis, final.weight, shape)
    minima = refine_with_rivals(problem, start, thresholds.noise.tied_variances, callback)
    solution = minima[0]
    refuse_parallel_boards(solution.state.cam_from_board, parallel_deg)
    refuse_other_squares(problem, solution.state, thresholds.doubt, callback)
    notes: tuple[str, ...] = size_notes(final.points.board, thresholds.doubt)
    held = None
    if solution.outcome is Outcome.DEGENERATE:
        direction = basis @ solution.weakest_direction[: basis.shape[1]]
        held = redundant_parameter(solution.state.model, direction, final.points.pixels)
    if held is not None:
        name, value = list(solution.state.model.named_parameters().items())[held]
        notes += (
            f"The other parameters can make up for any small change of {name}: it is held at {value:.4g}, without a sigma.",
        )
        basis = basis_without(basis, held)
        solution = BoardProblem(final.points, basis, final.weight, shape).solve(solution.state, callback=callback)
    every = solution.state.model.parameters
    if held is None and hold_unsupported and solution.outcome is Outcome.CONVERGED:
        solution, held_terms = without_unsupported_terms(problem, solution, thresholds.held_out)
        notes += held_terms
    return camera_result(final, solution, basis, (problem, minima), notes, every)


def _unlike(usable: UsableCorners, fit: RobustFit, lost: Sequence[int], thresholds: CalibrationThresholds) -> dict[int, str]:
    """Of the views that do not fit, those whose photos were cropped or zoomed, and what is to be said of them."""
    smooth, _ = smooth_corners(usable.points, thresholds.screening)
    better, significance = thresholds.doubt.fits_better, thresholds.degeneracy.misfit_significance
    own = [usable.views.index(view) for view in lost if view in usable.views]
    found = unlike_views(usable.points.chosen(smooth), fit.state, own, better, significance)
    return {usable.views[k]: how for k, how in found.items()}


def _flipped(usable: UsableCorners, fit: RobustFit, thresholds: CalibrationThresholds) -> dict[int, str]:
    """Views that are of flipped photos, and what is to be said of them."""
    smooth, _ = smooth_corners(usable.points, thresholds.screening)
    least_px, better = thresholds.noise.corner_floor_px, thresholds.doubt.fits_better
    significance = thresholds.degeneracy.misfit_significance
    found = flipped_views(usable.points.chosen(smooth), fit.state, least_px, better, significance)
    return {usable.views[k]: f"beside the others it looks {how}; flip or turn it back" for k, how in found.items()}


def robust_camera(
    points: BoardPoints,
    weight: Float[Tensor, " n"] | None,
    kind: CameraKind,
    loss: str,
    thresholds: CalibrationThresholds,
    *,
    stated_px: float,
    callback: Callable[[Progress], None] | None = None,
    least_passes: int = 3,
) -> RobustFit:
    """The robust fit from the best start and, as long as the fit is poor, from the next ones; the one with the least scale.

    `stated_px` is what is stated of corners of weight 1, 0 where nothing is.
    """
    # Plain least squares needs a robust fit too, to come near its minimum.
    robust_loss = "cauchy" if loss == "none" else loss
    smooth, in_order = smooth_corners(points, thresholds.screening)
    clean = points.chosen(smooth)
    task = RobustTask(points, clean, weight, robust_loss, thresholds.robust, stated_px, callback)
    found: list[RobustFit] = []
    for start in ranked_starts(clean, in_order, kind, thresholds)[: thresholds.start.most_starts]:
        found.append(robust_fit(task, start.state, least_passes=least_passes))
        if found[-1].scale_px <= thresholds.start.good_fit_share * max(kind.image_size):
            break
    best = min(found, key=lambda fit: fit.scale_px)
    if best.state.model.NESTED_VARIANTS and kind.variant_open:
        return supported_fit(task, best, thresholds, least_passes)
    return best


def refine_with_rivals(
    problem: BoardProblem,
    start: CameraAndBoards,
    tied_variances: float,
    callback: Callable[[Progress], None] | None,
) -> list[Solution[CameraAndBoards]]:
    """Plain least squares from `start`, and from every other minimum that the model names: first the best of them, and of those
    that the data do not tell apart (chi-square up to `tied_variances`) the one with the smallest shape parameters."""
    points = problem.points
    solution = problem.solve(start, max_iterations=300, callback=callback)
    found = [solution]
    poses = solution.state.cam_from_board
    reach = float(angles_off_axis(solution.state.model, points.pixels).max())
    for rival in solution.state.model.rivals(reach):
        found.append(problem.solve(CameraAndBoards(rival, poses, start.shape), max_iterations=300, callback=callback))
    best = min(candidate.cost for candidate in found)
    variance = best / max(1, 2 * len(points.view) - 6 * points.views - problem.structure.kept_size)
    tied = [candidate for candidate in found if candidate.cost <= best + tied_variances * variance]
    taken = min(tied, key=lambda candidate: _shape(candidate.state.model))
    return [taken, *(candidate for candidate in found if candidate is not taken)]


def _shape(model: CameraModel) -> float:
    """Length of the vector of the parameters that have no unit of length."""
    return math.hypot(*(value for name, value in model.named_parameters().items() if name not in IN_PIXELS))
