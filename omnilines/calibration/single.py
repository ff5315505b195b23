"""One camera from views of a plane board: start from rays, fit robustly, refine by plain least squares, say how certain."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from camera_models.formats.camera_doubts import model_doubts
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.diagnose import (
    angles_off_axis,
    coverage_notes,
    refuse_open_camera,
    refuse_parallel_boards,
    refuse_unexplained,
    rejection_notes,
    supported_angles_deg,
    tilt_notes,
)
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.intervals import SHARE, camera_intervals, linear_intervals, noise_notes, stated_variance_px2
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.redundancy import IN_PIXELS, basis_without, redundant_parameter
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.robust import RobustFit, RobustTask, robust_fit
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.start import CameraKind, ranked_starts
from omnilines.calibration.table_doubts import misfit_notes, refuse_disorder, refuse_other_squares, size_notes
from omnilines.calibration.terms import without_unsupported_terms
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.uncertainty import view_leverage
from omnilines.calibration.variants import supported_fit
from omnilines.calibration.views import UsableCorners, board_points, corner_weights, require_views, view_results, views_lost
from omnilines.least_squares import Outcome, Progress, Solution
from omnilines.least_squares.variance import variance_factor
from omnilines.records import Corners, ViewResult

CURVED = (
    "Parameters make up for one another along a curved valley, where standard deviations of single ones do not hold: their 95 "
    "percent intervals are those of the profile likelihood. The projection uncertainty holds all the same."
)


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera with everything that the report and the files need."""

    model: CameraModel
    covariance: Float[np.ndarray, "p p"]
    """Of the parameters in their order, scaled by the stated noise of the corners where the residuals bear it out, else by the
    residuals."""
    rms_px_per_axis: float
    rms_px_per_point: float
    residual_px: Float[np.ndarray, "n 2"]
    """Projected minus observed pixel of every corner; NaN for corners of views that were not used."""
    kept: Bool[np.ndarray, " n"]
    """Corners that the estimate rests on."""
    views: tuple[ViewResult, ...]
    min_angle_deg: float
    max_angle_deg: float
    """How far from the bearing of the centre pixel the data reach."""
    iterations: int
    notes: tuple[str, ...]
    board: BoardShape
    board_sigma: Mapping[str, float]
    """One standard deviation of each board term that was estimated."""
    interval_95: Float[np.ndarray, "p 2"]
    """Lowest and highest value of each parameter, which hold it in 95 of 100 cases."""
    corner_sigma_px: float
    """Standard deviation of a corner per axis (root mean square) that the covariance rests on."""
    curved: bool = False
    """Whether the covariance does not hold so far from the estimate, so that intervals are those of the profile likelihood."""
    line_delay: LineDelay | None = None
    """Of a rolling shutter that was recognised or estimated."""

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """`interval_95` by name."""
        return {name: (low, high) for name, (low, high) in zip(self.sigma, self.interval_95.tolist(), strict=True)}

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return dict(zip(self.model.PARAMETER_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def board_terms(self) -> dict[str, float]:
        """The estimated board terms."""
        terms = dict(zip(self.board.names, self.board.terms.tolist(), strict=True))
        return {name: terms[name] for name in self.board_sigma}


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
        robust_camera(usable.points, usable.weight, kind, loss, thresholds, callback=callback),
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
    kept = fit.kept if loss != "none" else torch.ones_like(fit.kept)
    fitting = rows.copy()
    fitting[rows] = kept.numpy()
    refusals |= views_lost(corners, rows, fitting, thresholds.views.least_corners)
    good = [k for k, v in enumerate(usable.views) if v not in refusals]
    require_views(len(good), len(corners.view_names), refusals, thresholds.views.least_views)
    views = [usable.views[k] for k in good]
    final_rows = fitting & np.isin(corners.view, views)
    final = _Final(
        corners=corners,
        rows=final_rows,
        views=views,
        points=board_points(corners, final_rows, views),
        weight=corner_weights(corners, final_rows),
        refusals=refusals,
        limit_px=fit.limit_px if loss != "none" else None,
        thresholds=thresholds,
    )
    start = CameraAndBoards(fit.state.model, fit.state.cam_from_board[good], shape)
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
    elif hold_unsupported and solution.outcome is Outcome.CONVERGED:
        solution, held_terms = without_unsupported_terms(problem, solution, thresholds.held_out)
        notes += held_terms
    return _result(final, solution, basis, (problem, minima), notes)


def robust_camera(
    points: BoardPoints,
    weight: Float[Tensor, " n"] | None,
    kind: CameraKind,
    loss: str,
    thresholds: CalibrationThresholds,
    *,
    callback: Callable[[Progress], None] | None = None,
    least_passes: int = 3,
) -> RobustFit:
    """The robust fit from the best start and, as long as the fit is poor, from the next ones; the one with the least scale."""
    # Plain least squares needs a robust fit too, to come near its minimum.
    robust_loss = "cauchy" if loss == "none" else loss
    smooth, in_order = smooth_corners(points, thresholds.screening)
    clean = points.chosen(smooth)
    task = RobustTask(
        points=points, clean=clean, weight=weight, loss=robust_loss, thresholds=thresholds.robust, callback=callback
    )
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


@dataclass(frozen=True)
class _Final:
    """What the last fit rests on."""

    corners: Corners
    rows: Bool[np.ndarray, " n"]
    views: list[int]
    points: BoardPoints
    weight: Float[Tensor, " m"] | None
    refusals: Mapping[int, str]
    limit_px: float | None
    """Beyond which corners were rejected."""
    thresholds: CalibrationThresholds


def _result(
    final: _Final,
    solution: Solution[CameraAndBoards],
    basis: Float[Tensor, "p q"],
    floor: tuple[BoardProblem, Sequence[Solution[CameraAndBoards]]],
    notes: tuple[str, ...],
) -> CameraCalibration:
    """`floor` is the problem along all columns and its minima, first the one that `solution` refines."""
    state, model, corners, thresholds = solution.state, solution.state.model, final.corners, final.thresholds
    unit = _unit_covariance(final, solution, basis)
    stated = stated_variance_px2(corners, final.rows, thresholds.noise.corner_floor_px)
    factor = variance_factor(solution.cost, _freedom(final, solution), stated, thresholds.noise.significance)
    variance, q = factor.value, basis.shape[1]
    covariance = basis @ unit[:q, :q] @ basis.mT * variance
    covariance = 0.5 * (covariance + covariance.mT)
    squared, count = np.sum(state.residual_px(final.points).numpy() ** 2), len(final.points.view)
    rough = misfit_notes(math.sqrt(squared / (2 * count)), model.image_size, math.sqrt(stated or 0.0), thresholds.doubt)
    if rough:
        refuse_disorder(smooth_corners(final.points, thresholds.screening)[1])
    notes = rough + tuple(f"{one[0].upper()}{one[1:]}." for one in model_doubts(model)) + notes
    refuse_unexplained(final.points, state.residual_px(final.points), thresholds.degeneracy.unexplained_share)
    refuse_open_camera(model, covariance, final.points.pixels, state.cam_from_board, thresholds.degeneracy)
    residual = np.full((len(corners), 2), np.nan)
    everywhere = np.isin(corners.view, final.views)
    residual[everywhere] = state.residual_px(board_points(corners, everywhere, final.views)).numpy()
    problem, minima = floor
    curved = camera_intervals(problem, minima[0], minima[1:], factor)
    intervals = linear_intervals(model.parameters, covariance, factor.sigmas(SHARE)) if curved is None else curved
    low, high = supported_angles_deg(model, final.points.pixels)
    leverage = view_leverage(final.points, state, basis, final.weight, unit)
    notes += noise_notes(factor, stated, thresholds.noise) + (() if curved is None else (CURVED,))
    views = view_results(
        corners,
        final.rows,
        final.views,
        residual,
        state.cam_from_board,
        refusals=final.refusals,
        leverage=leverage,
        limit_px=final.limit_px,
        many_rejected_share=thresholds.views.many_rejected_share,
    )
    return CameraCalibration(
        model=model,
        covariance=covariance.numpy(),
        rms_px_per_axis=float(math.sqrt(squared / (2 * count))),
        rms_px_per_point=float(math.sqrt(squared / count)),
        residual_px=residual,
        kept=final.rows,
        views=views,
        min_angle_deg=low,
        max_angle_deg=high,
        iterations=solution.iterations,
        notes=notes + _data_notes(final, solution, everywhere, leverage),
        board=state.shape,
        board_sigma=dict(zip(state.shape.free_names, (unit.diagonal()[q:] * variance).sqrt().tolist(), strict=True)),
        interval_95=intervals.numpy(),
        corner_sigma_px=math.sqrt(variance),
        curved=curved is not None,
    )


def _data_notes(
    final: _Final, solution: Solution[CameraAndBoards], everywhere: Bool[np.ndarray, " n"], leverage: Float[Tensor, " v"]
) -> tuple[str, ...]:
    """What is to be said of corners, views, and how the fit ended; `everywhere` are all corners of the views used."""
    state, model, corners, thresholds = solution.state, solution.state.model, final.corners, final.thresholds
    notes = _rejected_corners(final)
    notes += coverage_notes(model, final.points.pixels, model.image_size)
    notes += tilt_notes(state.cam_from_board, thresholds.degeneracy.one_axis_deg)
    seen, kept = torch.as_tensor(corners.pixels[everywhere]), torch.as_tensor(final.rows[everywhere])
    notes += rejection_notes(model, seen, kept, thresholds.degeneracy)
    if float(leverage.max()) > thresholds.views.leverage_share:
        name = corners.view_names[final.views[int(leverage.argmax())]]
        notes += (
            f"The calibration hangs on view {name}: it decides {100 * float(leverage.max()):.0f} percent of the parameters; add "
            "photos like it.",
        )
    if solution.outcome is not Outcome.CONVERGED:
        notes += (solution.outcome.value,)
    return notes


def _rejected_corners(final: _Final) -> tuple[str, ...]:
    """How many corners of the views used were rejected, and why."""
    used = np.isin(final.corners.view, final.views)
    lost = used & ~final.rows
    if final.limit_px is None or not lost.any():
        return ()
    views = len(np.unique(final.corners.view[lost]))
    return (
        f"{lost.sum()} of {used.sum()} corners, in {views} views, were rejected: they lie more than {final.limit_px:.2g} px "
        f"({final.thresholds.robust.reject_sigma:g} robust standard deviations) from where the camera sees them.",
    )


def _freedom(final: _Final, solution: Solution[CameraAndBoards]) -> int:
    return 2 * len(final.points.view) - len(solution.gauge) - 6 * len(final.views)


def _unit_covariance(final: _Final, solution: Solution[CameraAndBoards], basis: Tensor) -> Float[Tensor, "k k"]:
    """Covariance of the camera along its basis and of the free board terms for corners of unit variance. Raises GeometryError
    where the data leave a direction open."""
    if solution.outcome is Outcome.DEGENERATE or _freedom(final, solution) <= 0:
        refuse_parallel_boards(solution.state.cam_from_board, final.thresholds.degeneracy.nearly_parallel_deg)
        raise GeometryError(
            f"The corners of {len(final.views)} views were expected to determine the camera, found that they leave "
            f"{_weakest_name(solution, basis)} open; add photos with the board at other tilts and nearer to the rim."
        )
    return solution.kept_covariance()


def _weakest_name(solution: Solution[CameraAndBoards], basis: Tensor) -> str:
    model, q = solution.state.model, basis.shape[1]
    camera = (basis @ solution.weakest_direction[:q]).abs() / model.parameters.abs().clamp_min(1e-12)
    board = (solution.state.shape.free @ solution.weakest_direction[q:]).abs()
    return (model.PARAMETER_NAMES + solution.state.shape.names)[int(torch.argmax(torch.cat([camera, board])))]


def with_remarks(result: CameraCalibration, remarks: Mapping[str, tuple[str, ...]]) -> CameraCalibration:
    """The result with more remarks on its views, by view name."""
    views = tuple(replace(view, remarks=view.remarks + remarks.get(view.name, ())) for view in result.views)
    return replace(result, views=views)
