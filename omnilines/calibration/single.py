"""Calibration of one camera: corners in; intrinsics, board poses and their uncertainty out."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError, model_class
from camera_models.pose import Pose
from omnilines.calibration.diagnose import (
    NEARLY_PARALLEL_DEG,
    angles_off_axis,
    coverage_notes,
    refuse_open_camera,
    refuse_parallel_boards,
    supported_angles_deg,
)
from omnilines.calibration.initialise import (
    BoardPoints,
    centre_candidates,
    equidistant_start,
    radial_start,
    resect_boards,
)
from omnilines.calibration.refine import CameraAndBoards, refine, robust_scale_px
from omnilines.least_squares import Loss, Outcome, Progress, Solution
from omnilines.records import Corners, ViewResult

LEAST_VIEWS = 3
LEAST_CORNERS = 6
"""Corners a view must have: fewer do not determine its radial start."""
HALF_ANGLES_DEG = (25.0, 45.0, 70.0, 90.0, 110.0)
"""Equidistant lenses tried beside the closed-form start, by the angle at the farthest corner."""
GOOD_START = 0.005
"""A closed-form start with a typical residual below this share of the image's longer side needs no alternatives."""
IN_PIXELS = ("fx", "fy", "cx", "cy", "skew")
TIED = 9.0
"""Minima whose sums of squares differ by less than this many variances (three standard deviations) fit equally well."""
DETECTOR_FLOOR_PX = 0.01
"""Corners found in photos are never taken to be better than this when uncertainty is stated. On rendered boards without noise the
detector is still off by some 0.004 px, neighbours alike, which residuals do not show: over 28 rendered sets the squared errors
of the parameters were 1.5 times what residuals of 0.006 px promise."""
REJECT_SIGMA = 4.5
"""Corners farther than this many robust standard deviations (of the norm) are rejected."""


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera with everything that the report and the files need."""

    model: CameraModel
    covariance: Float[np.ndarray, "p p"]
    """Of the parameters in their order, scaled by the residuals."""
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

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return dict(zip(self.model.PARAMETER_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def board_points(corners: Corners, rows: Bool[np.ndarray, " n"], views: list[int]) -> BoardPoints:
    """The chosen rows as tensors, their views renumbered to positions in `views`."""
    place = np.full(len(corners.view_names), -1)
    place[views] = np.arange(len(views))
    return BoardPoints(
        torch.as_tensor(place[corners.view[rows]]),
        len(views),
        torch.as_tensor(corners.board_m[rows]),
        torch.as_tensor(corners.pixels[rows]),
    )


def calibrate_camera(
    corners: Corners,
    image_size: tuple[int, int],
    model: str = "scaramuzza",
    *,
    loss: str = "cauchy",
    mirror: bool = False,
    options: Mapping[str, Any] | None = None,
    callback: Callable[[Progress], None] | None = None,
) -> CameraCalibration:
    """Calibrate without any guess of focal length or centre.

    With `loss` "none" every corner counts and plain least squares is minimised. With "huber" or "cauchy" the loss is bent at the
    scale of the data, corners beyond REJECT_SIGMA and views with fewer than half of their corners left are rejected, and the
    kept corners are fitted again by plain least squares. `options` go to the model (`degree`, `coefficients`).

    Raises InputError for too few views and GeometryError for degenerate sets.
    """
    refusals = _unusable_views(corners)
    usable = [v for v in range(len(corners.view_names)) if v not in refusals]
    _require_views(len(usable), len(corners.view_names), refusals)
    rows = np.isin(corners.view, usable)
    points = board_points(corners, rows, usable)
    weight = _weights(corners, rows)
    rough = refine(points, _best_start(points, image_size, model, mirror, dict(options or {})), Loss("cauchy", 1.0), weight)
    refuse_parallel_boards(rough.state.cam_from_board)
    state, kept = rough.state, torch.ones(len(points.view), dtype=torch.bool)
    if loss != "none":
        state, kept = _reject(points, state, loss, weight, callback)
    bad = torch.nonzero(_share_kept(points, kept) < 0.5).flatten().tolist()
    for v in bad:
        refusals[usable[v]] = "more than half of its corners do not fit the camera (wrong detection or numbering)"
    good = [v for v in range(points.views) if v not in bad]
    _require_views(len(good), len(corners.view_names), refusals)
    final_rows = rows.copy()
    final_rows[rows] = kept.numpy() & ~np.isin(points.view.numpy(), bad)
    final_points = board_points(corners, final_rows, [usable[v] for v in good])
    start = CameraAndBoards(state.model, state.cam_from_board[good])
    solution = _refine_with_rivals(final_points, start, _weights(corners, final_rows), callback)
    refuse_parallel_boards(solution.state.cam_from_board)
    return _result(corners, final_points, final_rows, [usable[v] for v in good], solution, refusals, loss)


def _unusable_views(corners: Corners) -> dict[int, str]:
    counts = np.bincount(corners.view, minlength=len(corners.view_names))
    refusals = {}
    for v, count in enumerate(counts):
        board = corners.board_m[corners.view == v]
        if count < LEAST_CORNERS:
            refusals[v] = f"only {count} corners, at least {LEAST_CORNERS} are needed"
        elif np.linalg.matrix_rank(board[:, :2] - board[:, :2].mean(0), tol=1e-9) < 2:
            refusals[v] = "all its corners lie on one line of the board"
        elif np.any(board[:, 2] != 0):
            refusals[v] = "its corners do not lie in the plane z = 0 of the board"
    return refusals


def _require_views(found: int, total: int, refusals: Mapping[int, str]) -> None:
    if found < LEAST_VIEWS:
        why = f" ({len(refusals)} of {total} dropped, the first because {next(iter(refusals.values()))})" if refusals else ""
        raise InputError(
            f"Too few views: a calibration needs at least {LEAST_VIEWS}, found {found}{why}; "
            "add photos of the board at other angles."
        )


def _weights(corners: Corners, rows: Bool[np.ndarray, " n"]) -> Tensor | None:
    """Inverse standard deviations relative to their rms, so that residuals stay pixels; None where none are given."""
    if corners.sigma_px is None:
        return None
    sigma = torch.as_tensor(corners.sigma_px[rows])
    return (sigma**2).mean().sqrt() / sigma


def _best_start(
    points: BoardPoints, image_size: tuple[int, int], model: str, mirror: bool, options: dict[str, Any]
) -> CameraAndBoards:
    """The start with the least robust residual: the closed form at each centre candidate and, where none of these comes near
    the corners, a few equidistant lenses."""
    centres = centre_candidates(points, image_size)
    found = []
    for centre in centres:
        start = radial_start(points, centre)
        if start is not None:
            _refuse_wide_angles(float(start.theta[-1]), model)
            found.append(_start_from(points, (start.rho_px, start.theta), centre, image_size, model, mirror, options))
    if not found or min(score for score, _ in found) > math.log1p(GOOD_START * max(image_size)):
        for centre in centres:
            reach = float((points.pixels - centre).norm(dim=-1).max())
            for angle in HALF_ANGLES_DEG:
                curve = equidistant_start(points, centre, math.radians(angle), reach)
                found.append(_start_from(points, curve, centre, image_size, model, mirror, options))
    return min(found, key=lambda scored: scored[0])[1]


def _start_from(
    points: BoardPoints,
    curve: tuple[Tensor, Tensor],
    centre: Tensor,
    image_size: tuple[int, int],
    model: str,
    mirror: bool,
    options: dict[str, Any],
) -> tuple[float, CameraAndBoards]:
    """The model nearest to a radial curve with boards resected by it, and its score: the mean of log(1 + residual)."""
    camera = model_class(model).from_radial_curve(*curve, centre, image_size, mirror=mirror, **options)
    bearings, seen = camera.unproject(points.pixels)
    state = CameraAndBoards(camera, resect_boards(points, bearings))
    error = state.residual_px(points).norm(dim=-1)
    # A corner that the start cannot even see is as bad as the image is large.
    error = torch.where(seen & torch.isfinite(error), error, float(max(image_size)))
    return float(torch.log1p(error).mean()), state


def _refuse_wide_angles(angle: float, model: str) -> None:
    limit = model_class(model).LARGEST_ANGLE
    # The closed form is good to a degree or two.
    if angle > limit + math.radians(2):
        raise GeometryError(
            f"Camera model {model} holds angles below {math.degrees(limit):.0f} degrees off axis, found corners at about "
            f"{math.degrees(angle):.0f} degrees; use --model scaramuzza or opencv-fisheye."
        )


def _reject(
    points: BoardPoints, state: CameraAndBoards, loss: str, weight: Tensor | None, callback: Callable[[Progress], None] | None
) -> tuple[CameraAndBoards, Tensor]:
    """Refine with a loss bent at the scale of the data until the set of kept corners settles."""
    kept = torch.ones(len(points.view), dtype=torch.bool)
    for _ in range(5):
        residual = state.residual_px(points)
        scale = max(robust_scale_px(residual if weight is None else residual * weight[:, None]), 1e-6)
        state = refine(points, state, Loss(loss, 2 * scale), weight, callback).state
        residual = state.residual_px(points)
        residual = residual if weight is None else residual * weight[:, None]
        scale = max(robust_scale_px(residual), 1e-6)
        now = residual.norm(dim=-1) <= REJECT_SIGMA * scale
        if bool((now == kept).all()):
            break
        kept = now
    return state, kept


def _refine_with_rivals(
    points: BoardPoints, start: CameraAndBoards, weight: Tensor | None, callback: Callable[[Progress], None] | None
) -> Solution[CameraAndBoards]:
    """Plain least squares from `start`, and from every other minimum that the model names; the best of them, and of those that
    the data do not tell apart (chi-square up to TIED) the one with the smallest shape parameters."""
    solution = refine(points, start, weight=weight, callback=callback, max_iterations=300)
    poses = solution.state.cam_from_board
    reach = float(angles_off_axis(solution.state.model, points.pixels).max())
    others = [
        refine(points, CameraAndBoards(rival, poses), weight=weight, callback=callback, max_iterations=300)
        for rival in solution.state.model.rivals(reach)
    ]
    found = [solution, *others]
    best = min(candidate.cost for candidate in found)
    variance = best / max(1, 2 * len(points.view) - 6 * points.views - start.model.calibration_basis().shape[1])
    tied = [candidate for candidate in found if candidate.cost <= best + TIED * variance]
    return min(tied, key=lambda candidate: _shape(candidate.state.model))


def _shape(model: CameraModel) -> float:
    """Length of the vector of the parameters that have no unit of length."""
    return math.hypot(*(value for name, value in model.named_parameters().items() if name not in IN_PIXELS))


def _share_kept(points: BoardPoints, kept: Tensor) -> Tensor:
    return points.mean_by_view(kept.to(torch.float64)[:, None])[:, 0]


def _result(
    corners: Corners,
    points: BoardPoints,
    rows: Bool[np.ndarray, " n"],
    views: list[int],
    solution: Solution[CameraAndBoards],
    refusals: Mapping[int, str],
    loss: str,
) -> CameraCalibration:
    state = solution.state
    model = state.model
    basis = model.calibration_basis()
    freedom = 2 * len(points.view) - basis.shape[1] - 6 * len(views)
    if solution.outcome is Outcome.DEGENERATE or freedom <= 0:
        refuse_parallel_boards(state.cam_from_board, NEARLY_PARALLEL_DEG)
        raise GeometryError(
            f"The corners of {len(views)} views were expected to determine the camera, found that they leave "
            f"{_weakest_name(solution, basis, model)} open; add photos with the board at other tilts and nearer to the rim."
        )
    variance = solution.cost / freedom
    if corners.sigma_px is not None:
        variance = max(variance, DETECTOR_FLOOR_PX**2)
    covariance = basis @ solution.kept_covariance() @ basis.mT * variance
    covariance = 0.5 * (covariance + covariance.mT)
    refuse_open_camera(model, covariance, points.pixels, state.cam_from_board)
    residual = np.full((len(corners), 2), np.nan)
    everywhere = np.isin(corners.view, views)
    residual[everywhere] = state.residual_px(board_points(corners, everywhere, views)).numpy()
    squared = np.sum(residual[rows] ** 2)
    low, high = supported_angles_deg(model, points.pixels)
    notes = coverage_notes(model, points.pixels, model.image_size)
    if solution.outcome is not Outcome.CONVERGED:
        notes += (solution.outcome.value,)
    return CameraCalibration(
        model,
        covariance.numpy(),
        float(math.sqrt(squared / (2 * rows.sum()))),
        float(math.sqrt(squared / rows.sum())),
        residual,
        rows,
        _view_results(corners, rows, views, residual, state.cam_from_board, refusals),
        low,
        high,
        solution.iterations,
        notes,
    )


def _weakest_name(solution: Solution[CameraAndBoards], basis: Tensor, model: CameraModel) -> str:
    direction = (basis @ solution.weakest_direction).abs() / model.parameters.abs().clamp_min(1e-12)
    return model.PARAMETER_NAMES[int(torch.argmax(direction))]


def _view_results(
    corners: Corners,
    rows: Bool[np.ndarray, " n"],
    views: list[int],
    residual: Float[np.ndarray, "n 2"],
    poses: Pose,
    refusals: Mapping[int, str],
) -> tuple[ViewResult, ...]:
    results = []
    for v, (name, image) in enumerate(zip(corners.view_names, corners.images, strict=True)):
        seen = corners.view == v
        result = ViewResult(name, image, v in views, refusals.get(v), 0, int(seen.sum()))
        if v in views:
            used = seen & rows
            rms = float(np.sqrt(np.mean(np.sum(residual[used] ** 2, -1))))
            result = replace(
                result,
                corners_used=int(used.sum()),
                corners_rejected=int((seen & ~rows).sum()),
                rms_px_per_point=rms,
                cam_from_board=poses[views.index(v)],
            )
        results.append(result)
    return tuple(results)
