"""Each camera of a rig by itself: calibrated anew, or begun from a calibration that is held or refined."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from omnilines.calibration.diagnose import angles_off_axis, refuse_parallel_boards
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.intervals import stated_variance_px2
from omnilines.calibration.options import AUTO
from omnilines.calibration.refine import BoardProblem, CameraAndBoards, whitened
from omnilines.calibration.robust import Settled, settle
from omnilines.calibration.screening import smooth_corners
from omnilines.calibration.select import select_model
from omnilines.calibration.single import calibrate_camera, robust_camera
from omnilines.calibration.start import CameraKind
from omnilines.calibration.views import board_points, corner_weights, require_views, unusable_views, views_lost
from omnilines.least_squares import Progress
from omnilines.least_squares.variance import variance_factor
from omnilines.records import Corners

LEAST_SIGMA_PX = 1e-4
"""Corners are never weighted as better than this: of exact ones, rounding alone would decide the weights."""


OUTSIDE = 0.1
"""Share of corners outside the field of view of a given calibration from which it is not that of this camera."""


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


@dataclass(frozen=True, eq=False)
class AloneCamera:
    """A camera and its board poses without the help of the others, by a robust fit."""

    model: CameraModel
    basis: Float[Tensor, "p q"]
    """Directions of the parameters that the rig refines."""
    views: Int[np.ndarray, " w"]
    """Views of the rig's table that have a pose."""
    cam_from_board: Pose
    sigma_px: float
    """Standard deviation of a corner per axis (of mean weight), from the residuals and their degrees of freedom."""
    rms_px_per_point: float
    refusals: Mapping[int, str]
    """Views without a pose, and why."""


def alone_camera(
    corners: Corners, numbers: Int[np.ndarray, " v"], setup: CameraSetup, loss: str, callback: Callable[[Progress], None] | None
) -> AloneCamera:
    """One camera from its own corners; `numbers` are its views in the rig's table.

    Raises InputError for too few views and GeometryError where they leave the camera open.
    """
    refusals = unusable_views(corners)
    usable = [v for v in range(len(corners.view_names)) if v not in refusals]
    if setup.start is None:
        require_views(len(usable), len(corners.view_names), refusals)
    elif not usable:
        raise InputError("At least one view with enough corners for a pose was expected, found none; add photos of the board.")
    rows: Bool[np.ndarray, " n"] = np.isin(corners.view, usable)
    points, weight = board_points(corners, rows, usable), corner_weights(corners, rows)
    settled = _settled(corners, points, weight, setup, loss, callback)
    kept = settled.kept
    if loss == "none":
        problem = BoardProblem(points, settled.state.model.calibration_basis()[:, : 0 if setup.hold else None], weight)
        settled, kept = replace(settled, state=problem.solve(settled.state).state), torch.ones_like(kept)
    fitting = rows.copy()
    fitting[rows] = kept.numpy()
    refusals |= views_lost(corners, rows, fitting)
    stays = torch.tensor([v not in refusals for v in usable])
    good = torch.nonzero(stays).flatten().tolist()
    poses = settled.state.cam_from_board[good]
    if setup.start is None:
        require_views(len(good), len(corners.view_names), refusals)
        refuse_parallel_boards(poses)
    elif not good:
        raise GeometryError(
            f"Boards that the given calibration fits were expected, found none among {len(usable)} views; give another "
            "calibration or calibrate anew."
        )
    kept = kept & stays[points.view]
    residual = settled.state.residual_px(points)[kept]
    basis = settled.state.model.calibration_basis()
    if setup.hold:
        basis = basis[:, :0]
    return AloneCamera(
        settled.state.model,
        basis,
        numbers[[usable[v] for v in good]],
        poses,
        _sigma_px(
            whitened(residual, None if weight is None else weight[kept]),
            len(good),
            basis.shape[1],
            stated_variance_px2(corners, np.ones(len(corners), dtype=bool)),
        ),
        float(residual.square().sum(-1).mean().sqrt()),
        {int(numbers[v]): reason for v, reason in refusals.items()},
    )


def _settled(
    corners: Corners,
    points: BoardPoints,
    weight: Float[Tensor, " n"] | None,
    setup: CameraSetup,
    loss: str,
    callback: Callable[[Progress], None] | None,
) -> Settled:
    """The robust fit from the given calibration or from none."""
    if setup.start is not None:
        return _begun(points, weight, setup.start, setup.hold, loss)
    if setup.model == AUTO:
        chosen = select_model(corners, setup.image_size, loss=loss, mirror=setup.mirror).result
        return _begun(points, weight, chosen.model, False, loss)
    settled = robust_camera(
        points, CameraKind(setup.image_size, setup.model, setup.mirror, setup.options), loss, weight, callback, least_passes=2
    )
    model = settled.state.model
    if type(model).rivals is CameraModel.rivals or not model.rivals(float(angles_off_axis(model, points.pixels).max())):
        return settled
    # Of several minima that the model may be in, the plain least squares of a camera alone finds the best.
    best = calibrate_camera(corners, setup.image_size, setup.model, loss=loss, mirror=setup.mirror, options=setup.options)
    return _begun(points, weight, best.model, False, loss)


def _begun(points: BoardPoints, weight: Float[Tensor, " n"] | None, model: CameraModel, hold: bool, loss: str) -> Settled:
    """Boards resected by a known camera, which is refined with them unless it is held."""
    smooth, _ = smooth_corners(points)
    clean = points.chosen(smooth)
    _, seen = model.unproject(clean.pixels)
    outside = int((~seen).sum())
    if outside > OUTSIDE * len(seen):
        raise GeometryError(
            f"Corners where the given calibration sees were expected, found {outside} of {len(seen)} outside its field of view; "
            "give another calibration or calibrate anew."
        )
    clean = clean.chosen(seen)
    bearings, _ = model.unproject(clean.pixels)
    basis = model.calibration_basis()
    start = CameraAndBoards(model, resect_boards(clean, bearings))
    return settle(points, clean, start, "cauchy" if loss == "none" else loss, weight, basis=basis[:, :0] if hold else basis)


def _sigma_px(residual: Float[Tensor, "n 2"], views: int, estimated: int, stated_px2: float | None) -> float:
    """Corners are never taken to be better than they are stated to be: what a detector leaves unmodelled is alike in neighbours,
    so that residuals do not show all of it, and many corners do not average it out."""
    freedom = max(1, residual.numel() - 6 * views - estimated)
    return max(math.sqrt(variance_factor(float(residual.square().sum()), freedom, stated_px2).value), LEAST_SIGMA_PX)
