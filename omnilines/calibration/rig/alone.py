"""Each camera of a rig by itself: calibrated anew, or begun from a calibration that is held or refined."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError, model_class
from camera_models.pose import Pose
from omnilines.calibration.diagnose import angles_off_axis, refuse_parallel_boards
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.intervals import stated_variance_px2
from omnilines.calibration.options import AUTO
from omnilines.calibration.refine import BoardProblem, CameraAndBoards, whitened
from omnilines.calibration.rig.near import CornerNoise
from omnilines.calibration.robust import RobustFit, RobustTask, robust_fit
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.select import select_model
from omnilines.calibration.single import calibrate_camera, robust_camera
from omnilines.calibration.start import CameraKind
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.views import board_points, corner_weights, require_views, stated_rms_px, unusable_views, views_lost
from omnilines.least_squares import Progress
from omnilines.records import Corners


@dataclass(frozen=True)
class CameraSetup:
    """What is to be calibrated of one camera of a rig, and what is known of it."""

    image_size: tuple[int, int]
    model: str = "scaramuzza"
    """A camera model, or AUTO; without meaning where there is a `start`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    start: CameraModel | None = None
    """An existing calibration to begin from."""
    hold: bool = False
    """Whether the intrinsics of `start` are held."""
    mirror: bool = False
    chosen: str = ""
    """Why the model was chosen before, one sentence."""

    @property
    def variant_open(self) -> bool:
        """Whether it is open how many of its model's terms a camera has."""
        if self.start is not None:
            return False
        return self.model == AUTO or model_class(self.model).variant_options().isdisjoint(self.options)


@dataclass(frozen=True, eq=False)
class AloneCamera:
    """A camera and its board poses without the help of the others, by a robust fit."""

    model: CameraModel
    basis: Float[Tensor, "p q"]
    """Directions of the parameters that the rig refines."""
    views: Int[np.ndarray, " w"]
    """Views of the rig's table that have a pose."""
    cam_from_board: Pose
    noise: CornerNoise
    rms_px_per_point: float
    kept: Bool[np.ndarray, " n"]
    """Of its corners, those that fit."""
    refusals: Mapping[int, str]
    """Views without a pose, and why."""
    chosen: str = ""
    """Why its model was chosen, one sentence; empty where it was named."""


def alone_camera(
    corners: Corners,
    numbers: Int[np.ndarray, " v"],
    setup: CameraSetup,
    loss: str,
    thresholds: CalibrationThresholds,
    *,
    callback: Callable[[Progress], None] | None,
) -> AloneCamera:
    """One camera from its own corners; `numbers` are its views in the rig's table.

    Raises InputError for too few views and GeometryError where they leave the camera open.
    """
    least_views, least_corners = thresholds.views.least_views, thresholds.views.least_corners
    refusals = unusable_views(corners, least_corners)
    usable = [v for v in range(len(corners.view_names)) if v not in refusals]
    if setup.start is None:
        require_views(len(usable), len(corners.view_names), refusals, least_views)
    elif not usable:
        raise InputError("At least one view with enough corners for a pose was expected, found none; add photos of the board.")
    rows: Bool[np.ndarray, " n"] = np.isin(corners.view, usable)
    points, weight = board_points(corners, rows, usable), corner_weights(corners, rows)
    stated_px = stated_rms_px(corners, rows)
    chosen = setup.chosen
    if setup.start is None and setup.model == AUTO:
        selection = select_model(
            corners, setup.image_size, loss=loss, mirror=setup.mirror, thresholds=thresholds, callback=callback
        )
        fit = _begun(points, weight, selection.result.model, loss, thresholds, stated_px=stated_px)
        chosen = selection.reason
    else:
        fit = _robust(corners, points, weight, setup, loss, stated_px=stated_px, thresholds=thresholds, callback=callback)
    state, kept = fit.state, fit.kept
    if loss == "none":
        problem = BoardProblem(points, state.model.calibration_basis()[:, : 0 if setup.hold else None], weight)
        state, kept = problem.solve(state).state, torch.ones_like(kept)
    fitting = rows.copy()
    fitting[rows] = kept.numpy()
    refusals |= views_lost(corners, rows, fitting, least_corners)
    stays = torch.tensor([v not in refusals for v in usable])
    good = torch.nonzero(stays).flatten().tolist()
    poses = state.cam_from_board[good]
    if setup.start is None:
        require_views(len(good), len(corners.view_names), refusals, least_views)
        refuse_parallel_boards(poses, thresholds.degeneracy.parallel_deg)
    elif not good:
        raise GeometryError(
            f"Boards that the given calibration fits were expected, found none among {len(usable)} views; give another "
            "calibration or calibrate anew."
        )
    kept = kept & stays[points.view]
    residual = state.residual_px(points)[kept]
    basis = state.model.calibration_basis()
    if setup.hold:
        basis = basis[:, :0]
    stated = stated_variance_px2(corners, np.ones(len(corners), dtype=bool), thresholds.noise.corner_floor_px)
    squares = whitened(residual, None if weight is None else weight[kept]).square().sum()
    freedom = max(1, residual.numel() - 6 * len(good) - basis.shape[1])
    return AloneCamera(
        model=state.model,
        basis=basis,
        views=numbers[[usable[v] for v in good]],
        cam_from_board=poses,
        noise=CornerNoise.of(float(squares), freedom, stated, thresholds.noise.significance),
        rms_px_per_point=float(residual.square().sum(-1).mean().sqrt()),
        kept=fitting & np.isin(corners.view, [usable[v] for v in good]),
        refusals={int(numbers[v]): reason for v, reason in refusals.items()},
        chosen=chosen,
    )


def _robust(
    corners: Corners,
    points: BoardPoints,
    weight: Float[Tensor, " n"] | None,
    setup: CameraSetup,
    loss: str,
    *,
    stated_px: float,
    thresholds: CalibrationThresholds,
    callback: Callable[[Progress], None] | None,
) -> RobustFit:
    """The robust fit of the model named, from the given calibration or from none."""
    if setup.start is not None:
        return _begun(points, weight, setup.start, loss, thresholds, stated_px=stated_px, hold=setup.hold)
    kind = CameraKind(setup.image_size, setup.model, setup.mirror, setup.options)
    fit = robust_camera(points, weight, kind, loss, thresholds, stated_px=stated_px, callback=callback, least_passes=2)
    model = fit.state.model
    if type(model).rivals is CameraModel.rivals or not model.rivals(float(angles_off_axis(model, points.pixels).max())):
        return fit
    # Of several minima that the model may be in, the plain least squares of a camera alone finds the best.
    best = calibrate_camera(
        corners, setup.image_size, setup.model, loss=loss, mirror=setup.mirror, options=setup.options, thresholds=thresholds
    )
    return _begun(points, weight, best.model, loss, thresholds, stated_px=stated_px)


def _begun(
    points: BoardPoints,
    weight: Float[Tensor, " n"] | None,
    model: CameraModel,
    loss: str,
    thresholds: CalibrationThresholds,
    *,
    stated_px: float,
    hold: bool = False,
) -> RobustFit:
    """Boards resected by a known camera, which is refined with them unless it is held."""
    smooth, _ = smooth_corners(points, thresholds.screening)
    clean = points.chosen(smooth)
    _, seen = model.unproject(clean.pixels)
    outside = int((~seen).sum())
    if outside > thresholds.rig.outside_share * len(seen):
        raise GeometryError(
            f"Corners where the given calibration sees were expected, found {outside} of {len(seen)} outside its field of view; "
            "give another calibration or calibrate anew."
        )
    clean = clean.chosen(seen)
    bearings, _ = model.unproject(clean.pixels)
    basis = model.calibration_basis()
    start = CameraAndBoards(model, resect_boards(clean, bearings))
    task = RobustTask(points, clean, weight, "cauchy" if loss == "none" else loss, thresholds.robust, stated_px)
    return robust_fit(task, start, basis=basis[:, :0] if hold else basis)
