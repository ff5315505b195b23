"""From the last fit of a camera to its result: covariance, intervals, and what is to be said of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from camera_models.formats.camera_doubts import model_doubts
from camera_models.wording import rounded
from omnilines.calibration.by_views import stated_covariance
from omnilines.calibration.diagnose import (
    coverage_notes,
    lost_rim,
    refuse_open_camera,
    refuse_parallel_boards,
    refuse_unexplained,
    supported_angles_deg,
    tilt_notes,
)
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.intervals import (
    SHARE,
    camera_intervals,
    linear_intervals,
    noise_notes,
    reaching_to,
    stated_variance_px2,
)
from omnilines.calibration.model_misfit import ModelMisfit, model_misfit
from omnilines.calibration.photo_changes import PhotoChange, photo_change
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.table_doubts import misfit_notes, refuse_disorder
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.uncertainty import view_leverage
from omnilines.calibration.unmodelled import unmodelled
from omnilines.calibration.views import board_points, view_results
from omnilines.least_squares import Outcome, Solution
from omnilines.least_squares.variance import variance_factor
from omnilines.records import Corners, ViewResult

CURVED = (
    "Parameters make up for one another along a curved valley, where standard deviations of single ones do not hold: their 95 "
    "percent intervals are those of the profile likelihood."
)
PROJECTION_HOLDS = " The projection uncertainty holds all the same."


@dataclass(frozen=True)
class LastFit:
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


def camera_result(
    final: LastFit,
    solution: Solution[CameraAndBoards],
    basis: Float[Tensor, "p q"],
    floor: tuple[BoardProblem, Sequence[Solution[CameraAndBoards]]],
    notes: tuple[str, ...],
    every: Float[Tensor, " p"],
) -> CameraCalibration:
    """`floor` is the problem along all columns and its minima, first the one that `solution` refines; `every` are the parameters
    with all terms free, also where `solution` holds some at 0.

    Intervals are about `every`: which terms are held follows from the same noise as the rest, so intervals of the same length
    about the estimate would hold less than they say. They reach to the estimate where they would not hold it.
    """
    state, model, corners, thresholds = solution.state, solution.state.model, final.corners, final.thresholds
    unit, q = _unit_covariance(final, solution, basis), basis.shape[1]
    stated = stated_variance_px2(corners, final.rows, thresholds.noise.corner_floor_px)
    problem, minima = floor
    # Noise is what the fit with all terms leaves: its freedom is counted, also where terms were held afterwards.
    cost = min(solution.cost, minima[0].cost)
    factor = variance_factor(cost, _freedom(final, solution), stated, thresholds.noise.significance)
    groups = BoardProblem(final.points, basis, final.weight, state.shape).by_views(state)
    certain = stated_covariance(groups, unit, factor, cost, _freedom(final, solution), thresholds.noise.significance)
    covariance = basis @ certain.covariance[:q, :q] @ basis.mT
    covariance = 0.5 * (covariance + covariance.mT)
    squared, count = np.sum(state.residual_px(final.points).numpy() ** 2), len(final.points.view)
    rough = misfit_notes(math.sqrt(squared / (2 * count)), model.image_size, math.sqrt(stated or 0.0), thresholds.doubt)
    if rough:
        refuse_disorder(smooth_corners(final.points, thresholds.screening)[1])
    notes = rough + tuple(f"{one[0].upper()}{one[1:]}." for one in model_doubts(model, estimated=True)) + notes
    refuse_unexplained(final.points, state.residual_px(final.points), thresholds.degeneracy.unexplained_share)
    by_noise = basis @ unit[:q, :q] @ basis.mT * factor.value
    refuse_open_camera(model, by_noise, final.points.pixels, state.cam_from_board, thresholds.degeneracy)
    residual = np.full((len(corners), 2), np.nan)
    everywhere = np.isin(corners.view, final.views)
    residual[everywhere] = state.residual_px(board_points(corners, everywhere, final.views)).numpy()
    curved = camera_intervals(problem, minima[0], minima[1:], certain.factor)
    intervals = linear_intervals(every, covariance, certain.factor.sigmas(SHARE))
    if curved is not None:
        # The profile knows nothing of what leaving out views adds.
        before = (basis @ unit[:q, :q] @ basis.mT * certain.factor.value).diagonal().clamp_min(1e-300)
        wider = (covariance.diagonal() / before).clamp_min(1.0).sqrt()
        intervals = every[:, None] + (curved - every[:, None]) * wider[:, None]
    intervals = reaching_to(intervals, model.parameters)
    low, high = supported_angles_deg(model, final.points.pixels)
    leverage = view_leverage(final.points, state, basis, final.weight, unit)
    misfit = _misfit(final, model, residual)
    notes += () if misfit is None else (misfit.note(f"{model.NAME} model"),)
    change = _change(final, state, basis, stated) if misfit is None and certain.beyond_noise > 1 else None
    notes += noise_notes(factor, stated, thresholds.noise) + certain.note
    notes += () if change is None else (change.note,)
    other = None
    if misfit is None and change is None and _of_one_drawing(final, state):
        reach = math.radians(low), math.radians(high)
        other = unmodelled(final.points, state, basis, final.weight, covariance, reach, thresholds.degeneracy.misfit_significance)
        notes += () if other is None else (other.note,)
    if curved is not None:
        notes += (CURVED + (PROJECTION_HOLDS if misfit is None and not certain.note else ""),)
    views = _views(final, state, residual, leverage)
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
        notes=notes + _data_notes(final, solution, leverage),
        board=state.shape,
        board_sigma=dict(zip(state.shape.free_names, certain.covariance.diagonal()[q:].sqrt().tolist(), strict=True)),
        interval_95=intervals.numpy(),
        corner_sigma_px=math.sqrt(factor.value),
        beyond_noise=certain.beyond_noise,
        curved=curved is not None,
        misfit=misfit,
        unmodelled=other,
        change=change,
    )


def _of_one_drawing(final: LastFit, state: CameraAndBoards) -> bool:
    """Whether all views are of one plane board, taken to be as drawn."""
    one = final.corners.boards is None or len(set(final.corners.boards)) == 1
    return one and state.shape.plain and not bool(final.points.board[:, 2].any())


def _change(final: LastFit, state: CameraAndBoards, basis: Float[Tensor, "p q"], stated: float | None) -> PhotoChange | None:
    """Of photos of which the noise of corners is stated."""
    if stated is None:
        return None
    explained, one = final.thresholds.noise.explained, _of_one_drawing(final, state)
    return photo_change(final.points, state, basis, final.weight, math.sqrt(stated), explained, one)


def _misfit(final: LastFit, model: CameraModel, residual: Float[np.ndarray, "n 2"]) -> ModelMisfit | None:
    """Of the corners of the views used, rejected ones too: where a model does not follow, those are what it misses most."""
    corners, used = final.corners, np.isfinite(residual).all(1)
    centre_px, significance = model.centre_px.detach().numpy(), final.thresholds.degeneracy.misfit_significance
    return model_misfit(corners.view[used], corners.pixels[used], residual[used], centre_px, final.limit_px, significance)


def _views(
    final: LastFit, state: CameraAndBoards, residual: Float[np.ndarray, "n 2"], leverage: Float[Tensor, " v"]
) -> tuple[ViewResult, ...]:
    return view_results(
        final.corners,
        final.rows,
        final.views,
        residual,
        state.cam_from_board,
        refusals=final.refusals,
        leverage=leverage,
        limit_px=final.limit_px,
        many_rejected_share=final.thresholds.views.many_rejected_share,
    )


def _data_notes(final: LastFit, solution: Solution[CameraAndBoards], leverage: Float[Tensor, " v"]) -> tuple[str, ...]:
    """What is to be said of corners, views, and how the fit ended."""
    state, model, corners, thresholds = solution.state, solution.state.model, final.corners, final.thresholds
    notes = _rejected_corners(final, model)
    notes += coverage_notes(model, final.points.pixels, model.image_size)
    notes += tilt_notes(state.cam_from_board, thresholds.degeneracy.one_axis_deg)
    if float(leverage.max()) > thresholds.views.leverage_share:
        name = corners.view_names[final.views[int(leverage.argmax())]]
        notes += (
            f"The calibration hangs on view {name}: it decides {100 * float(leverage.max()):.0f} percent of the parameters; add "
            "photos like it.",
        )
    if solution.outcome is not Outcome.CONVERGED:
        notes += (solution.outcome.value,)
    return notes


def _rejected_corners(final: LastFit, model: CameraModel) -> tuple[str, ...]:
    """How many corners of the views used were rejected, why, and whether they are those at the rim."""
    used = np.isin(final.corners.view, final.views)
    lost = used & ~final.rows
    if final.limit_px is None or not lost.any():
        return ()
    views = len(np.unique(final.corners.view[lost]))
    radius_px = (torch.from_numpy(final.corners.pixels[used]) - model.centre_px.detach()).norm(dim=-1)
    rim = lost_rim(radius_px, torch.from_numpy(~lost[used]), final.thresholds.degeneracy.misfit_significance)
    return (
        f"{lost.sum()} of {used.sum()} corners, in {views} views, were rejected: they lie more than {rounded(final.limit_px)} px "
        f"({final.thresholds.robust.reject_sigma:g} robust standard deviations) from where the camera sees them.",
        *rim,
    )


def _freedom(final: LastFit, solution: Solution[CameraAndBoards]) -> int:
    return 2 * len(final.points.view) - len(solution.gauge) - 6 * len(final.views)


def _unit_covariance(final: LastFit, solution: Solution[CameraAndBoards], basis: Tensor) -> Float[Tensor, "k k"]:
    """Covariance of the camera along its basis and of the free board terms for corners of unit variance. Raises GeometryError
    where the data leave a direction open."""
    if solution.outcome is Outcome.DEGENERATE or _freedom(final, solution) <= 0:
        refuse_parallel_boards(solution.state.cam_from_board, final.thresholds.degeneracy.nearly_parallel_deg)
        # A polynomial of a high degree is open however many photos there are.
        lower = "".join(f"a lower `{name}` may do, or " for name in solution.state.model.variant)
        raise GeometryError(
            f"The corners of {len(final.views)} views were expected to determine the camera, found that they leave "
            f"{_weakest_name(solution, basis)} open; {lower}add photos with the board at other tilts and nearer to the rim."
        )
    return solution.kept_covariance()


def _weakest_name(solution: Solution[CameraAndBoards], basis: Tensor) -> str:
    model, q = solution.state.model, basis.shape[1]
    camera = (basis @ solution.weakest_direction[:q]).abs() / model.parameters.abs().clamp_min(1e-12)
    board = (solution.state.shape.free @ solution.weakest_direction[q:]).abs()
    return (model.PARAMETER_NAMES + solution.state.shape.names)[int(torch.argmax(torch.cat([camera, board])))]
