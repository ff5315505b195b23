"""The robust fit of a rig, and which views agree with it."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Int

from camera_models.pose import Pose
from omnilines.calibration.rig.adopt import adopted_views, renumbered
from omnilines.calibration.rig.alone import AloneCamera
from omnilines.calibration.rig.joint import RigData, RigFit, robust_rig_fit
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.start import RigStart, ViewNumberings
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import CalibrationThresholds
from omnilines.calibration.views import corner_weights
from omnilines.least_squares import Progress

ELSEWHERE = "its board is not where the other cameras see it (wrong frame, detection or numbering)"
MISFIT = "more than half of its corners do not fit the rig (wrong frame, detection or numbering)"


def rig_data(views: RigViews, start: RigStart, alone: Mapping[int, AloneCamera]) -> RigData:
    """The corners of the members as the joint fit takes them, numbered as the start says and weighed by their stated noise."""
    corners = views.corners
    relative = np.ones(len(corners))
    for c in start.cameras:
        own: Bool[np.ndarray, " n"] = views.camera[corners.view] == c
        weight = corner_weights(corners, own)
        if weight is not None:
            relative[own] = 1 / weight.numpy()
    members = [alone[c] for c in start.cameras]
    return _numbered(
        RigData(
            views=views,
            cameras=start.cameras,
            boards=start.boards,
            bases=tuple(own.basis for own in members),
            noise=tuple(own.noise for own in members),
            relative=relative,
            board_m=corners.board_m.copy(),
        ),
        start.board_from_numbered,
    )


def _numbered(data: RigData, motions: Mapping[int, Pose]) -> RigData:
    """The data with the corners of some views numbered as the rig says."""
    board_m, view = data.board_m.copy(), data.views.corners.view
    eye = torch.eye(3, dtype=torch.float64)
    for v, motion in motions.items():
        if not (bool((motion.rotation == eye).all()) and not bool(motion.translation.any())):
            board_m[view == v] = renumbered(data.views.corners.board_m[view == v], motion)
    return replace(data, board_m=board_m)


def fit_agreeing_views(
    data: RigData,
    start: RigStart,
    state: RigState,
    options: ViewNumberings,
    loss: str,
    *,
    thresholds: CalibrationThresholds,
    callback: Callable[[Progress], None],
) -> tuple[RigData, RigFit, dict[int, str]]:
    """The robust fit, first of the views that agree with the start, then with those that the fit predicts, once more those among
    them that were lost on the way; and why views of the rig were left out."""
    views, reasons, returned = data.views, dict[int, str](), np.zeros(0, dtype=int)
    chosen = np.array(sorted(start.board_from_numbered))
    handed = {data.cameras.index(int(views.camera[v])): bool(m.rotation[2, 2] < 0) for v, m in start.board_from_numbered.items()}
    found: dict[int, Pose] | None = None
    while True:
        fit = robust_rig_fit(data, chosen, state, loss, thresholds, callback=callback)
        state = fit.state
        lost = fit.views[(fit.share_kept < 0.5).numpy()] if loss != "none" else chosen[:0]
        reasons |= dict.fromkeys(lost.tolist(), MISFIT)
        first, found = found is None, {}
        if first:
            candidates = _candidates(data, np.setdiff1d(chosen, lost), chosen)
            squares = thresholds.rig.agreeing_squares
            found = adopted_views(data, state, options, handed, candidates.tolist(), agreeing_squares=squares)
            reasons |= dict.fromkeys(np.setdiff1d(candidates, list(found)).tolist(), ELSEWHERE)
        if not len(lost) and not found:
            misfits = [v for v, reason in reasons.items() if reason == MISFIT]
            back = _predicted(data, fit, np.setdiff1d(misfits, returned).astype(int), thresholds)
            if not len(back):
                return data, fit, reasons
            reasons = {v: reason for v, reason in reasons.items() if v not in back}
            chosen, returned = np.union1d(chosen, back), np.union1d(returned, back)
            continue
        data = _numbered(data, found)
        chosen = np.union1d(np.setdiff1d(chosen, lost), np.array(list(found), dtype=chosen.dtype))


def _predicted(
    data: RigData, fit: RigFit, lost: Int[np.ndarray, " l"], thresholds: CalibrationThresholds
) -> Int[np.ndarray, " b"]:
    """Of the lost views those in frames of the fit of which it has most corners where they are seen."""
    lost = lost[np.isin(data.views.block[lost], data.views.block[fit.views])]
    if not len(lost):
        return lost
    points, lost, _ = data.points(lost)
    off = (fit.state.residual_px(points) * points.weight[:, None]).norm(dim=-1)
    near = (off <= fit.scales.limits(points, thresholds.robust.reject_sigma)).to(torch.float64)
    share = torch.bincount(points.view, near) / torch.bincount(points.view)
    return lost[(share >= 0.5).numpy()]


def _candidates(data: RigData, good: Int[np.ndarray, " g"], tried: Int[np.ndarray, " t"]) -> Int[np.ndarray, " c"]:
    """Views not tried yet, of members, in frames where good views say where the target is."""
    views = data.views
    placed = np.isin(views.block, views.block[good])
    return np.setdiff1d(np.flatnonzero(placed & np.isin(views.camera, data.cameras) & np.isin(views.part, data.boards)), tried)
