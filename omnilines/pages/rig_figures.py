"""What the calibration of a rig tells as figures: summaries for the terminal and the page, and data for `--json`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models.pose import Pose
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.rig.given import OtherThanGiven
from omnilines.calibration.rig.links import Link, translation_covariance
from omnilines.calibration.rig.result import RigCalibration, RigMember
from omnilines.pages.calibration import calibration_verdict, line_delay_data, misfit_data, unmodelled_data
from omnilines.pages.limits import rig_advice
from omnilines.pages.next_views import SHOOT_NEXT, next_views_data, next_views_summary
from omnilines.pages.uncertainty_map import UncertaintyMap
from omnilines.pipelines.calibrate_rig import RigResult
from omnilines.records import Summary
from omnilines.report.numbers import figure, with_sigma

PARAMETERS_OF = "Parameters of "
"""What the titles of the tables of parameters begin with."""


def rig_summaries(calibrated: RigResult) -> tuple[Summary, ...]:
    """The figures, where the cameras are, what ties them together, the parameters of each, and what to shoot next."""
    result = calibrated.fit
    used, one_pose = [view for view in result.views if view.used], result.one_pose_rms_px
    rows = (
        ("cameras", ", ".join(member.name for member in result.members)),
        ("left out", ", ".join(result.left_out) or "none"),
        ("frames", str(len(result.frames))),
        ("views used", f"{len(used)} of {len(result.views)}"),
        ("corners used", f"{int(result.kept.sum())} of {len(result.kept)}"),
        ("rms_px_per_axis", figure(result.rms_px_per_axis, ".4f")),
        ("rms_px_per_point", figure(result.rms_px_per_point, ".4f")),
        *(() if one_pose is None else (("with one pose of the board a frame", f"{figure(one_pose, '.4f')} px per point"),)),
        ("weakest link", "none" if result.weakest is None else _names(result, result.weakest)),
    )
    advice = rig_advice(result, dict(calibrated.next_views))
    title = "Calibration of the rig" if len(result.members) > 1 else "Calibration"
    summaries = [Summary(title, rows, result.notes, verdict=_verdict(result), advice=advice)]
    cameras = tuple((member.name, _camera_text(member)) for member in result.members)
    summaries.append(Summary("Cameras: RMS px per point in the rig, alone; field of view", cameras))
    places = tuple((member.name, _place_text(member)) for member in result.members[1:])
    if places:
        summaries.append(Summary(f"Cameras in the frame of {result.members[0].name} ± one standard deviation", places))
        summaries.append(Summary("Pairs that see the target at once", tuple(link_row(result, link) for link in result.links)))
    clocks = tuple((member.name, _clock_text(member)) for member in result.members if member.time_offset_s is not None)
    if clocks:
        summaries.append(Summary(f"Clocks ahead of that of {result.members[0].name} ± one standard deviation", clocks))
    rolling = tuple((delay.camera, f"{delay.text}, {delay.order}") for delay in result.line_delays if delay.modelled)
    if rolling:
        summaries.append(Summary("Rolling shutters: line delay ± one standard deviation", rolling))
    if len(result.boards) > 1:
        boards = tuple((name, _board_text(result, k)) for k, name in enumerate(result.boards))
        summaries.append(Summary(f"Boards in the frame of {result.boards[0]} ± one standard deviation", boards))
    if result.board_terms:
        terms = tuple((name, with_sigma(value, result.board_sigma[name])) for name, value in result.board_terms.items())
        summaries.append(Summary("How the board differs from its drawing ± one standard deviation", terms))
    for member in result.members:
        summaries.append(Summary(f"{PARAMETERS_OF}{member.name} ± one standard deviation", _parameters(member)))
    for name, views in calibrated.next_views.items():
        summaries.append(next_views_summary(views, f"{SHOOT_NEXT} with {name}"))
    return tuple(summaries)


def _names(result: RigCalibration, link: Link) -> str:
    return f"{result.members[link.first].name} - {result.members[link.second].name}"


def _camera_text(member: RigMember) -> str:
    text = f"{member.model.NAME}{' (held)' if member.held else ''}: {member.rms_px_per_point:.4f}, "
    text += f"{member.alone_rms_px_per_point:.4f}; {member.min_angle_deg:.1f} to {member.max_angle_deg:.1f} degrees off axis"
    return text + (f"; sign of a0: {member.sign_source}" if member.sign_source else "")


def _place_text(member: RigMember) -> str:
    centre = member.cam_from_rig.centre.tolist()
    sigma = np.sqrt(np.diag(centre_covariance(member.cam_from_rig, member.pose_covariance))).tolist()
    angle = math.degrees(float(member.cam_from_rig.log()[:3].norm()))
    turn = math.degrees(float(np.sqrt(np.linalg.eigvalsh(member.pose_covariance[:3, :3])[-1].clip(0))))
    xyz = _millimetres(centre, sigma)
    return f"centre {xyz}; turned by {with_sigma(angle, turn, 'degrees')}"


def _verdict(result: RigCalibration) -> str:
    """How well it is known where the cameras stand; of one alone, how well it is known."""
    others = result.members[1:]
    if not others:
        one = result.members[0]
        median, largest = UncertaintyMap.of(one).stated_figures if one.covariance.any() else (math.nan, math.nan)
        known = calibration_verdict(median, largest, (one.min_angle_deg, one.max_angle_deg))
        return f"Only {one.name} could be calibrated. {known}" if result.left_out else known
    spread = [max(0.0, np.linalg.eigvalsh(centre_covariance(one.cam_from_rig, one.pose_covariance))[-1]) for one in others]
    turn = [max(0.0, np.linalg.eigvalsh(one.pose_covariance[:3, :3])[-1]) for one in others]
    least, against = others[int(np.argmax(spread))], result.against_alone
    if against.unknown:
        return (
            f"{len(result.members)} cameras: where they stand is not known, as {against.rejected} of {against.fitted} views "
            "that fit their camera alone do not fit the rig."
        )
    lost = [member for member in result.members if member.misfit is not None]
    doubts = [f"the {member.follows} does not follow the lens of {member.name}." for member in lost]
    doubts += [f"the calibration held of {member.name} is not that of its photos." for member in result.members if member.other]
    doubts += against.notes
    doubt = f" But: {doubts[0]}" if doubts else ""
    return (
        f"{len(result.members)} cameras: each is known to stand within {figure(1e3 * math.sqrt(max(spread)), '.2g')} mm and "
        f"{figure(math.degrees(math.sqrt(max(turn))), '.2g')} degrees (one standard deviation, {least.name} least).{doubt}"
    )


def _clock_text(member: RigMember) -> str:
    assert member.time_offset_s is not None and member.time_offset_sigma_s is not None
    return with_sigma(1e3 * member.time_offset_s, 1e3 * member.time_offset_sigma_s, "ms")


def centre_covariance(pose: Pose, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "3 3"]:
    """Of the camera centre C = -R' t, from that of the left perturbation (rotation, translation): d C = -R' v."""
    back = -pose.rotation.numpy().T
    return back @ covariance[3:, 3:] @ back.T


def _board_text(result: RigCalibration, board: int) -> str:
    pose = result.target_from_board[board]
    spread = translation_covariance(pose, torch.as_tensor(result.board_covariance[board]))
    return _millimetres(pose.translation.tolist(), spread.diagonal().clamp_min(0).sqrt().tolist())


def _millimetres(place_m: Sequence[float], sigma_m: Sequence[float]) -> str:
    return ", ".join(with_sigma(1e3 * value, 1e3 * spread) for value, spread in zip(place_m, sigma_m, strict=True)) + " mm"


def link_row(result: RigCalibration, link: Link) -> tuple[str, str]:
    """The two cameras, and what ties them together."""
    turn = figure(link.rotation_sigma_deg, ".2g", "degrees")
    apart = with_sigma(1e3 * link.baseline_m, 1e3 * link.baseline_sigma_m, "mm")
    text = (
        f"{link.corners} common corners in {link.frames} frames; {link.rms_px_per_point:.4f} px; apart {apart}; rotation to "
        f"{turn}, translation to {figure(1e3 * link.translation_sigma_m, '.2g', 'mm')}"
    )
    return _names(result, link) + (" (weakest)" if link is result.weakest else ""), text


def _parameters(member: RigMember) -> tuple[tuple[str, str], ...]:
    sigma = member.sigma
    return tuple((name, with_sigma(value, sigma[name])) for name, value in member.model.named_parameters().items())


def rig_data(calibrated: RigResult) -> dict[str, Any]:
    """What `--json` prints; see docs/formats.md."""
    result = calibrated.fit
    return {
        "cameras": {member.name: _camera_data(member, result.line_delays) for member in result.members},
        "left_out": dict(result.left_out),
        "next_views": {name: next_views_data(views) for name, views in calibrated.next_views.items()},
        "rms_px_per_axis": result.rms_px_per_axis,
        "rms_px_per_point": result.rms_px_per_point,
        "one_pose_rms_px_per_point": result.one_pose_rms_px,
        "unmodelled": None if result.unmodelled is None else unmodelled_data(result.unmodelled),
        "frames": len(result.frames),
        "links": [
            {
                "cameras": [result.members[link.first].name, result.members[link.second].name],
                "frames": link.frames,
                "corners": link.corners,
                "rms_px_per_point": link.rms_px_per_point,
                "baseline_m": link.baseline_m,
                "baseline_sigma_m": link.baseline_sigma_m,
                "rotation_sigma_deg": link.rotation_sigma_deg,
                "translation_sigma_m": link.translation_sigma_m,
                "weakest": link is result.weakest,
            }
            for link in result.links
        ],
        "boards": {
            name: {
                "rotation_wxyz": result.target_from_board[k].quaternion.tolist(),
                "translation_m": result.target_from_board[k].translation.tolist(),
                "sigma": np.sqrt(np.diag(result.board_covariance[k])).tolist(),
            }
            for k, name in enumerate(result.boards)
        },
        "board": {name: {"value": v, "sigma": result.board_sigma[name]} for name, v in result.board_terms.items()},
        "views": [
            {
                "image": view.image,
                "camera": view.camera,
                "frame": view.frame,
                "used": view.used,
                "reason": view.reason,
                "rms_px_per_point": view.rms_px_per_point,
                "remarks": list(view.remarks),
            }
            for view in result.views
        ],
        "notes": list(result.notes),
    }


def _other_data(other: OtherThanGiven) -> dict[str, float]:
    return {"focal_share": other.focal_share, "moved_px": other.moved_px, "sigma_px": other.sigma_px, "p": other.chance}


def _camera_data(member: RigMember, delays: Sequence[LineDelay]) -> dict[str, Any]:
    pose = member.cam_from_rig
    return {
        "model": member.model.NAME,
        "image_size": list(member.model.image_size),
        "parameters": member.model.named_parameters(),
        "sigma": member.sigma,
        "interval_95": dict(zip(member.sigma, member.interval_95.tolist(), strict=True)),
        "held": member.held,
        "sign_source": member.sign_source,
        "rms_px_per_axis": member.rms_px_per_axis,
        "rms_px_per_point": member.rms_px_per_point,
        "alone_rms_px_per_point": member.alone_rms_px_per_point,
        "misfit": None if member.misfit is None else misfit_data(member.misfit),
        "other_than_given": None if member.other is None else _other_data(member.other),
        "min_angle_deg": member.min_angle_deg,
        "max_angle_deg": member.max_angle_deg,
        "cam_from_rig": {
            "rotation_wxyz": pose.quaternion.tolist(),
            "translation_m": pose.translation.tolist(),
            "sigma": np.sqrt(np.diag(member.pose_covariance)).tolist(),
        },
        "time_offset_s": member.time_offset_s,
        "time_offset_sigma_s": member.time_offset_sigma_s,
        "line_delay": line_delay_data(next((found for found in delays if found.camera == member.name), None)),
    }
