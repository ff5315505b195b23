"""From the joint fit of a rig to its result: covariance of everything, links, views, notes."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel, GeometryError
from camera_models.pose import Pose
from omnilines.calibration.diagnose import supported_angles_deg
from omnilines.calibration.intervals import SHARE, linear_intervals
from omnilines.calibration.rig.against_alone import against_alone
from omnilines.calibration.rig.given import other_than_given
from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.links import Link, links, weakest_link
from omnilines.calibration.rig.misfits import rig_misfits
from omnilines.calibration.rig.notes import rig_notes
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.own_fit import own_fit
from omnilines.calibration.rig.result import TWIST_NAMES, RigCalibration, RigMember
from omnilines.calibration.rig.systematic import moved_by_radial_shifts
from omnilines.calibration.rig.unmodelled import rig_unmodelled
from omnilines.least_squares import Outcome
from omnilines.records import ViewResult


def rig_result(outcome: RigOutcome) -> RigCalibration:
    """Everything about the rig. Raises GeometryError where the corners leave it open."""
    data, fit, solution = outcome.data, outcome.fit, outcome.solution
    _refuse_open(outcome)
    kept_covariance, frame_covariance = _of_estimates(outcome)
    names, covariance = _covariance(outcome, kept_covariance)
    count = len(data.cameras)
    parameters = sum(len(model.parameters) for model in solution.state.models)
    poses = torch.zeros(6 * count, 6 * count, dtype=torch.float64)
    poses[6:, 6:] = covariance[parameters : parameters + 6 * (count - 1), parameters : parameters + 6 * (count - 1)]
    residual = np.full((len(data.views.corners), 2), np.nan)
    residual[fit.rows] = solution.state.residual_px(fit.points).numpy()
    kept = np.zeros(len(residual), dtype=bool)
    kept[fit.rows] = fit.kept.numpy()
    found = _links(outcome, residual, kept, poses)
    weakest = weakest_link(found, count)
    terms, clocks = solution.state.shape.free.shape[1], len(_free_delays(data)) + len(_free_clocks(data))
    first, last = parameters + 6 * (count - 1), len(covariance) - terms - clocks
    free = covariance[first:last, first:last]
    boards = torch.zeros(len(data.boards), 6, 6, dtype=torch.float64)
    if len(free):
        boards[1:] = torch.stack([free[k : k + 6, k : k + 6] for k in range(0, len(free), 6)])
    blocks, rig_from_target, frame_covariance = _targets(outcome, frame_covariance)
    members = _members(outcome, covariance, poses, residual, kept)
    used, against = residual[kept], against_alone(outcome, covariance)
    reach_rad = [(math.radians(member.min_angle_deg), math.radians(member.max_angle_deg)) for member in members]
    # Where a model does not follow its lens, or is another's, that pulls at everything else.
    follow = all(member.misfit is None and member.other is None for member in members)
    other = rig_unmodelled(outcome, covariance, reach_rad) if follow else None
    left_out = {data.views.cameras[c]: reason for c, reason in outcome.failures.items()}
    return RigCalibration(
        members=members,
        names=names,
        covariance=covariance.numpy(),
        boards=tuple(data.views.boards[b] for b in data.boards),
        target_from_board=solution.state.target_from_board,
        board_covariance=boards.numpy(),
        frames=tuple(_block_name(data, block) for block in blocks.tolist()),
        rig_from_target=rig_from_target,
        frame_covariance=frame_covariance.numpy(),
        corners=replace(data.views.corners, board_m=data.board_m),
        in_one_frame=data.views.tied is not None,
        residual_px=residual,
        kept=kept,
        views=_views(outcome, residual, kept),
        links=found,
        weakest=weakest,
        left_out=left_out,
        left_out_alone=outcome.singles,
        rms_px_per_axis=float(np.sqrt((used**2).mean())),
        rms_px_per_point=float(np.sqrt((used**2).sum(-1).mean())),
        board=solution.state.shape,
        board_sigma=dict(zip(data.shape.free_names, covariance.diagonal()[last : last + terms].sqrt().tolist(), strict=True)),
        iterations=solution.iterations,
        notes=rig_notes(outcome, members, weakest, left_out, against, other),
        line_delays=outcome.line_delays,
        against_alone=against,
        one_pose_rms_px=outcome.one_pose_rms_px,
        unmodelled=other,
    )


def _refuse_open(outcome: RigOutcome) -> None:
    if outcome.solution.outcome is not Outcome.DEGENERATE and outcome.freedom > 0:
        return
    solution = outcome.solution
    weight = solution.reduced.matrix.diagonal().clamp_min(0).sqrt()
    column = int((solution.weakest_direction.abs() * weight).argmax()) if len(weight) else 0
    raise GeometryError(
        f"The corners of {len(outcome.fit.views)} views were expected to determine the rig, found that they leave "
        f"{_column_names(outcome)[column]} open; add frames in which two cameras see the board, at other tilts and places."
    )


def _column_names(outcome: RigOutcome) -> list[str]:
    """For people: what each kept column of the problem moves most."""
    data, names = outcome.data, []
    cameras = [data.views.cameras[c] for c in data.cameras]
    for camera, model, basis in zip(cameras, outcome.solution.state.models, data.bases, strict=True):
        names += [f"{model.PARAMETER_NAMES[int(column.abs().argmax())]} of {camera}" for column in basis.mT]
    names += [f"{twist} of {camera}" for camera in cameras[1:] for twist in TWIST_NAMES]
    if data.views.tied is None:
        names += [f"{twist} of board {data.views.boards[b]}" for b in data.boards[1:] for twist in TWIST_NAMES]
    names += [f"{term} of the board" for term in data.shape.free_names]
    names += [f"the line delay of {cameras[k]}" for k in _free_delays(data)]
    return names + [f"the time offset of {cameras[k]}" for k in _free_clocks(data)]


def _free_delays(data: RigData) -> list[int]:
    return [] if data.readout is None else np.flatnonzero(data.readout.free).tolist()


def _free_clocks(data: RigData) -> list[int]:
    return [] if data.runs is None else np.flatnonzero(data.runs.free).tolist()


def _targets(outcome: RigOutcome, covariance: Float[Tensor, "r e e"]) -> tuple[np.ndarray, Pose, Float[Tensor, "f 6 6"]]:
    """The instants of the rig, where the target is in them, and the covariance of its left perturbation, from that of the
    eliminated blocks. Where cameras have clocks of their own, an instant is that of its earliest view, by the first one."""
    data, points, state = outcome.data, outcome.fit.points, outcome.solution.state
    blocks, first = np.unique(points.instant.numpy(), return_index=True)
    some = replace(
        points,
        camera=points.camera[first],
        instant=points.instant[first],
        frame=points.frame[first],
        board=points.board[first],
        times=None if data.runs is None else data.runs.times(outcome.fit.views[first], None),
    )
    along = state.along(some)
    if along is None:
        return blocks, state.rig_from_target[some.frame], covariance[some.frame]
    return blocks, state.target(some), along.by_run @ covariance[some.frame] @ along.by_run.mT


def _of_estimates(outcome: RigOutcome) -> tuple[Float[Tensor, "q q"], Float[Tensor, "f e e"]]:
    """Covariance of the kept columns of the problem and of its eliminated blocks: the noise of the corners as the residuals
    show it, how much frames contradict each other and, of corners found in photos, what they have in common."""
    solution = outcome.solution
    kept = outcome.kept_covariance
    frames = solution.eliminated_covariance() * outcome.certain_factor.value
    if outcome.frame_spread is not None and outcome.frame_factors is not None:
        kept = kept + outcome.frame_spread
        frames = frames * float(outcome.frame_factors.median()) ** 2
    if outcome.data.views.corners.sigma_px is not None:
        problem = outcome.data.problem(outcome.fit.points.chosen(outcome.fit.kept))
        by_kept, by_frames = moved_by_radial_shifts(problem, solution, outcome.thresholds.noise.radial_shift_px)
        kept = kept + by_kept.mT @ by_kept
        frames = frames + (by_frames[..., :, None] * by_frames[..., None, :]).sum(0)
    return kept, frames


def _covariance(outcome: RigOutcome, kept: Float[Tensor, "q q"]) -> tuple[tuple[str, ...], Float[Tensor, "k k"]]:
    """Of all parameters, camera poses and free boards, and what each row is."""
    data = outcome.data
    names: list[str] = []
    cameras = [data.views.cameras[c] for c in data.cameras]
    for camera, model in zip(cameras, outcome.solution.state.models, strict=True):
        names += [f"{camera}.{name}" for name in model.PARAMETER_NAMES]
    names += [f"{camera}.{name}" for camera in cameras[1:] for name in TWIST_NAMES]
    if data.views.tied is None:
        names += [f"{data.views.boards[b]}.{name}" for b in data.boards[1:] for name in TWIST_NAMES]
    names += [f"board.{name}" for name in data.shape.free_names]
    names += [f"{cameras[k]}.line_delay_s" for k in _free_delays(data)]
    names += [f"{cameras[k]}.time_offset_s" for k in _free_clocks(data)]
    rest = len(names) - sum(len(basis) for basis in data.bases)
    spread = torch.block_diag(*data.bases, torch.eye(rest, dtype=torch.float64))
    covariance = spread @ kept @ spread.mT
    return tuple(names), 0.5 * (covariance + covariance.mT)


def _links(
    outcome: RigOutcome, residual: Float[np.ndarray, "n 2"], kept: np.ndarray, poses: Float[Tensor, "k k"]
) -> tuple[Link, ...]:
    views, corners = outcome.data.views, outcome.data.views.corners
    member = np.full(len(views.cameras), -1)
    member[list(outcome.data.cameras)] = np.arange(len(outcome.data.cameras))
    of_row = corners.view[kept]
    # A corner is known by its board and its place there, to a tenth of a micrometre.
    place = np.column_stack([views.board[of_row], np.rint(outcome.data.board_m[kept] * 1e7).astype(np.int64)])
    return links(
        member[views.camera[of_row]],
        views.frame[of_row],
        place,
        residual[kept],
        cam_from_rig=outcome.solution.state.cam_from_rig,
        covariance=poses,
    )


def _members(
    outcome: RigOutcome,
    covariance: Float[Tensor, "k k"],
    poses: Float[Tensor, "m m"],
    residual: Float[np.ndarray, "n 2"],
    kept: np.ndarray,
) -> tuple[RigMember, ...]:
    data, state = outcome.data, outcome.solution.state
    corners, found, low = data.views.corners, [], 0
    sigmas = outcome.certain_factor.sigmas(SHARE)
    fits = [own_fit(outcome, c) for c in data.cameras]
    misfits = rig_misfits(fits, outcome.thresholds.degeneracy.misfit_significance)
    free, others = _free_clocks(data), other_than_given(fits, outcome.held, outcome.thresholds)
    clocks = {k: place - len(free) for place, k in enumerate(free)}
    for k, c in enumerate(data.cameras):
        model, name = state.models[k], data.views.cameras[c]
        high = low + len(model.parameters)
        own = kept & (data.views.camera[corners.view] == c)
        squares = float((residual[own] ** 2).sum())
        low_deg, high_deg = supported_angles_deg(model, _extremes(model, torch.as_tensor(corners.pixels[own])))
        found.append(
            RigMember(
                name=name,
                model=model,
                covariance=covariance[low:high, low:high].numpy(),
                cam_from_rig=state.cam_from_rig[k],
                pose_covariance=poses[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].numpy(),
                rms_px_per_axis=math.sqrt(squares / (2 * own.sum())),
                rms_px_per_point=math.sqrt(squares / own.sum()),
                alone_rms_px_per_point=outcome.alone_rms_px[k],
                worse=k in outcome.worse,
                min_angle_deg=low_deg,
                max_angle_deg=high_deg,
                sign_source=outcome.sign_sources.get(c),
                held=k in outcome.held,
                interval_95=linear_intervals(model.parameters, covariance[low:high, low:high], sigmas).numpy(),
                time_offset_s=float(state.path.offset_s[k]) if k in clocks and state.path is not None else None,
                time_offset_sigma_s=math.sqrt(float(covariance[clocks[k], clocks[k]])) if k in clocks else None,
                line_delay=next((found for found in outcome.line_delays if found.camera == name and found.modelled), None),
                chosen=outcome.alone[c].chosen,
                misfit=misfits[k],
                other=others[k],
            )
        )
        low = high
    return tuple(found)


def _extremes(model: CameraModel, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "m 2"]:
    """The tenth of the pixels that is nearest to the centre and the tenth that is farthest from it."""
    order = torch.argsort((pixels - model.centre_px).norm(dim=-1))
    some = -(-len(order) // 10)
    return pixels[torch.cat([order[:some], order[-some:]])]


def _block_name(data: RigData, block: int) -> str:
    if not data.views.moving:
        return data.views.frames[block]
    frame, board = divmod(block, len(data.views.boards))
    return f"{data.views.frames[frame]} {data.views.boards[board]}"


def _views(outcome: RigOutcome, residual: Float[np.ndarray, "n 2"], kept: np.ndarray) -> tuple[ViewResult, ...]:
    """What became of every view of the table."""
    data = outcome.data
    views, corners = data.views, data.views.corners
    count = len(corners.view_names)
    seen = np.bincount(corners.view, minlength=count)
    used = np.bincount(corners.view[kept], minlength=count)
    squares = np.bincount(corners.view[kept], (residual[kept] ** 2).sum(-1), count)
    place = {int(v): k for k, v in enumerate(outcome.fit.views)}
    poses = outcome.solution.state.cam_from_board(outcome.fit.points)
    anew = np.bincount(corners.view, (data.board_m != corners.board_m).any(-1), count) > 0
    found = []
    for v, (name, image) in enumerate(zip(corners.view_names, corners.images, strict=True)):
        camera, frame = views.cameras[views.camera[v]], views.frames[views.frame[v]]
        if v not in place or not used[v]:
            reason = _reason(outcome, v)
            found.append(
                ViewResult(
                    name=name,
                    image=image,
                    used=False,
                    reason=reason,
                    corners_used=0,
                    corners_rejected=int(seen[v]),
                    camera=camera,
                    frame=frame,
                )
            )
            continue
        remarks: tuple[str, ...] = ()
        if anew[v]:
            remarks = ("its corners are numbered otherwise than the other cameras say; they were numbered anew",)
        if seen[v] - used[v] > outcome.thresholds.views.many_rejected_share * seen[v]:
            remarks += (f"{seen[v] - used[v]} of {seen[v]} corners rejected: they are not where the rig sees them",)
        rms = float(np.sqrt(squares[v] / used[v]))
        pose = poses[place[v]]
        rejected = int(seen[v] - used[v])
        found.append(
            ViewResult(
                name=name,
                image=image,
                used=True,
                reason=None,
                corners_used=int(used[v]),
                corners_rejected=rejected,
                rms_px_per_point=rms,
                cam_from_board=pose,
                camera=camera,
                leverage=None,
                remarks=remarks,
                frame=frame,
            )
        )
    return tuple(found)


def _reason(outcome: RigOutcome, view: int) -> str:
    camera = int(outcome.data.views.camera[view])
    if camera in outcome.failures:
        return f"its camera is not of the rig: {outcome.failures[camera]}"
    if view in outcome.reasons:
        return outcome.reasons[view]
    if view in outcome.alone[camera].refusals:
        return outcome.alone[camera].refusals[view]
    return "its board is tied to no other board of the rig"
