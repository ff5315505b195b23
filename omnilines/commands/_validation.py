"""What `omnilines validate` compares: the calibrated camera and the rebuilt board lines against the truth."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool

from camera_models import Calibration, CameraModel, GeometryError
from camera_models.pose import Pose
from omnilines.adjustment.scene import LineScene, reconstruct_lines
from omnilines.calibration.board_lines import BoardLines, board_lines
from omnilines.calibration.refine import robust_scale_px
from omnilines.calibration.single import REJECT_SIGMA
from omnilines.commands.render import RenderedTargets
from omnilines.evaluate import BearingErrors, LineErrors, ParameterErrors, bearing_errors, line_errors, parameter_errors
from omnilines.records import Check, Corners, ImagePoses

BEARING_LIMIT_DEG = 0.02
BEARING_LIMIT_PX = 0.1
"""The same limit for small images, in pixels of the mean angular size of the image circle: at 190 degrees over 960 px both are
0.02 degrees; below that size the pixel decides."""
LOST_SHARE = 0.05
"""Of the photos may be without a found target, rounded up."""
WORST_Z = 4.5
COST = "whitened"
"""Of the line adjustment: the one whose covariance is stated."""


@dataclass(frozen=True)
class Validation:
    """The truth, what was estimated from the photo files, and the errors."""

    truth: RenderedTargets
    calibration: Calibration
    corners: Corners
    board: BoardLines
    scene: LineScene
    bearings: BearingErrors
    bearing_limit_deg: float
    parameters: ParameterErrors
    lines: LineErrors

    @property
    def model(self) -> CameraModel:
        """The calibrated camera."""
        return self.calibration["cam0"]

    @property
    def checks(self) -> tuple[Check, ...]:
        """What has to hold, each figure with its limit."""
        lost = math.ceil(LOST_SHARE * len(self.truth.images))
        return (
            _at_most("photos without a usable target", self.photos_lost, lost, "photos"),
            _at_most("bearing error, RMS over the pixels", self.bearings.rms_deg, self.bearing_limit_deg, "degrees"),
            _at_most("parameters, squared Mahalanobis distance", self.parameters.statistic, self.parameters.limit, ""),
            _at_most("worst parameter, standard deviations off", self.parameters.worst_z, WORST_Z, ""),
            _at_most("lines, squared Mahalanobis distance", self.lines.statistic, self.lines.limit, ""),
        )

    @property
    def photos_lost(self) -> int:
        """Photos that the calibration does not rest on."""
        return len(self.truth.images) - sum(view.used for view in self.calibration.views)


def compare(truth: RenderedTargets, fov_deg: float, calibration: Calibration, corners: Corners) -> Validation:
    """Compare a calibration from rendered photos, and the lines of the board rebuilt with it, with the truth.

    Rows and columns of the board are segments between their outermost corners, the board is the world, and its calibrated poses
    are those of the photos. Raises GeometryError where the lines cannot be rebuilt.
    """
    estimated, covariance = calibration["cam0"], calibration.estimates["cam0"].covariance
    assert covariance is not None
    used = [view for view in calibration.views if view.used]
    basis = estimated.calibration_basis()
    freedom = 2 * sum(view.corners_used for view in used) - basis.shape[1] - 6 * len(used)
    board, scene = _rebuild(calibration, corners)
    lines = line_errors(scene.adjusted, scene.lines.ends_m, board.ends_m, 2 * len(scene.table.arcs) - 4 * len(scene.lines))
    pixel_deg = fov_deg / min(truth.model.image_size)
    return Validation(
        truth,
        calibration,
        corners,
        board,
        scene,
        bearing_errors(estimated, truth.model, truth.max_angle_rad),
        max(BEARING_LIMIT_DEG, BEARING_LIMIT_PX * pixel_deg),
        parameter_errors(estimated, covariance, truth.model, freedom),
        lines,
    )


def _at_most(name: str, value: float | int, limit: float | int, unit: str) -> Check:
    return Check(name, float(value), float(limit), unit, bool(value <= limit))


def _rebuild(calibration: Calibration, corners: Corners) -> tuple[BoardLines, LineScene]:
    """The lines of the board from the corners that the calibration rests on, weighted as the detector states their noise."""
    posed = {view.image: view.cam_from_board for view in calibration.views if view.cam_from_board is not None}
    poses = ImagePoses(tuple(posed), Pose.stack(list(posed.values())), ("cam0",) * len(posed))
    kept = _kept(calibration["cam0"], corners, poses)
    board = board_lines(corners, kept)
    segments = board.segments
    if corners.sigma_px is not None:
        # The same rows and columns with the standard deviations in the place of the pixels.
        spread = board_lines(replace(corners, pixels=np.repeat(corners.sigma_px[:, None], 2, axis=1)), kept).segments.endpoints_px
        segments = replace(segments, covariance_px2=spread[..., None] ** 2 * np.eye(2))
    scene = reconstruct_lines(segments, poses, calibration, cost=COST)
    if not scene.lines.known.all():
        unknown = [f"{track} ({status})" for track, status in zip(scene.lines.tracks, scene.lines.status, strict=True)]
        raise GeometryError(
            f"All rows and columns of the board were expected to be rebuilt, found {', '.join(unknown)}; give more photos."
        )
    return board, scene


def _kept(model: CameraModel, corners: Corners, poses: ImagePoses) -> Bool[np.ndarray, " n"]:
    """Corners of photos with a pose that fit the calibration, by the rule that it rejects others with."""
    place = np.array([poses.images.index(image) if image in poses.images else -1 for image in corners.images])[corners.view]
    posed = place >= 0
    own = poses.cam_from_world[torch.as_tensor(place[posed])]
    pixels, _ = model.project(own.transform(torch.as_tensor(corners.board_m[posed])[:, None])[:, 0])
    residual = pixels - torch.as_tensor(corners.pixels[posed])
    if corners.sigma_px is not None:
        residual = residual / torch.as_tensor(corners.sigma_px[posed])[:, None]
    kept = np.zeros(len(corners), dtype=bool)
    kept[posed] = (residual.norm(dim=-1) <= REJECT_SIGMA * robust_scale_px(residual)).numpy()
    return kept
