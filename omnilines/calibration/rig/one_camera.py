"""One camera of a rig as if it had been calibrated alone."""

import numpy as np

from omnilines.calibration.board_shape import AS_DRAWN
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.result import RigCalibration, RigMember
from omnilines.calibration.rig.views import views_of
from omnilines.records import Corners


def one_camera(result: RigCalibration, member: RigMember) -> tuple[CameraCalibration, Corners]:
    """A camera of the rig in the form of a camera calibrated alone, with its corners."""
    own = np.array([view.camera == member.name for view in result.views[: len(result.corners.view_names)]])
    views = np.flatnonzero(own)
    rows = np.isin(result.corners.view, views)
    single = CameraCalibration(
        member.model,
        member.covariance,
        member.rms_px_per_axis,
        member.rms_px_per_point,
        result.residual_px[rows],
        result.kept[rows],
        tuple(result.views[v] for v in views),
        member.min_angle_deg,
        member.max_angle_deg,
        result.iterations,
        (),
        AS_DRAWN,
        {},
        member.interval_95,
        member.rms_px_per_axis,
        line_delay=member.line_delay,
    )
    return single, views_of(result.corners, views, rows)
