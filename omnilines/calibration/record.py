"""What `calibration.yaml` holds of a calibrated camera or rig."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from camera_models import Calibration, CameraEstimate
from camera_models.formats.calibration_data import RigCamera, ViewRecord
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.result import RigCalibration
from omnilines.provenance import provenance
from omnilines.records import ViewResult


def calibration_record(result: CameraCalibration, mirror: bool, inputs: Mapping[str, Any]) -> Calibration:
    """Of one camera; `inputs` are what it was made from."""
    estimate = CameraEstimate(
        sigma=result.sigma,
        covariance=result.covariance,
        max_angle_deg=result.max_angle_deg,
        min_angle_deg=result.min_angle_deg,
        rms_px_per_axis=result.rms_px_per_axis,
        rms_px_per_point=result.rms_px_per_point,
        sign_source=("mirror" if mirror else "assumed") if result.model.AXIS_SIGN_OPEN else None,
    )
    views = tuple(view_record(view) for view in result.views)
    inputs = {**inputs, **_delays([result.line_delay])}
    if result.board_terms:
        # The poses of the views are those of this board.
        inputs = {**inputs, "board": " ".join(f"{name}={value:.6g}" for name, value in result.board_terms.items())}
    return Calibration({"cam0": result.model}, {"cam0": estimate}, views=views, provenance=provenance(inputs))


def rig_record(result: RigCalibration, inputs: Mapping[str, Any]) -> Calibration:
    """Of a rig. Views of cameras that are not of the rig are left out."""
    estimates = {
        member.name: CameraEstimate(
            sigma=member.sigma,
            covariance=member.covariance,
            max_angle_deg=member.max_angle_deg,
            min_angle_deg=member.min_angle_deg,
            rms_px_per_axis=member.rms_px_per_axis,
            rms_px_per_point=member.rms_px_per_point,
            sign_source=member.sign_source,
        )
        for member in result.members
    }
    rig = {
        member.name: RigCamera(member.cam_from_rig, np.sqrt(np.diag(member.pose_covariance)), member.pose_covariance)
        for member in result.members
    }
    views = tuple(view_record(view) for view in result.as_given()[1] if view.camera in rig)
    models = {member.name: member.model for member in result.members}
    offsets = [
        f"{m.name}={m.time_offset_s:.9g}+-{m.time_offset_sigma_s:.2g}" for m in result.members if m.time_offset_s is not None
    ]
    inputs = {**inputs, **_delays([member.line_delay for member in result.members])}
    if offsets:
        inputs = {**inputs, "time_offset_s": " ".join(offsets)}
    if result.board_terms:
        # Poses and corners are those of this board.
        inputs = {**inputs, "board": " ".join(f"{name}={value:.6g}" for name, value in result.board_terms.items())}
    return Calibration(models, estimates, rig if len(rig) > 1 else {}, views, provenance(inputs))


def _delays(found: Sequence[LineDelay | None]) -> dict[str, str]:
    """The line delays that the poses of the views hold, for people and for tools that read them."""
    told = [
        f"{delay.camera}={delay.delay_s:.6g}+-{delay.sigma_s:.2g} ({delay.order})" for delay in found if delay and delay.modelled
    ]
    return {"line_delay_s": " ".join(told)} if told else {}


def view_record(view: ViewResult) -> ViewRecord:
    """Of one view."""
    return ViewRecord(
        view.image,
        view.camera,
        view.used,
        view.reason,
        view.corners_used,
        view.corners_rejected,
        view.rms_px_per_point,
        view.cam_from_board,
        view.frame,
        view.name if view.name != view.image else None,
    )
