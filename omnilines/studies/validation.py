"""What `omnilines validate` compares: the calibrated camera and the rebuilt board lines against the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calib_patterns import Pattern
from camera_models import Calibration, CameraModel, GeometryError
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.calibration.board_lines import SAME_LINE_M, BoardLines, board_lines
from omnilines.calibration.thresholds import NoiseThresholds, RobustThresholds
from omnilines.evaluation.cameras import BearingErrors, LineErrors, ParameterErrors, bearing_errors, line_errors, parameter_errors
from omnilines.files import write_corners
from omnilines.files.sets import claimed
from omnilines.least_squares.variance import NORMAL_MAD
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.rendered import RenderedTargets
from omnilines.pipelines.scene import SCENE_FILES, Scene, refined_calibration
from omnilines.records import Check, Corners, ImagePoses

BEARING_LIMIT_DEG = 0.02
BEARING_LIMIT_PX = 0.1
"""The same limit for small images, in pixels of the mean angular size of the image circle: at 190 degrees over 960 px both are
0.02 degrees; below that size the pixel decides."""
LOST_SHARE = 0.05
"""Of the photos may be without a found target, rounded up."""
LINE_LIMIT_PX = 0.25
"""RMS distance of the lines' ends, in pixels where the board is: whatever is stated of the corners, more is too much."""
SCALE_LIMIT_PX = 0.1
"""By which the lines may be too long or too short over the whole board, in the same pixels."""
WORST_Z = 4.5
COST = "whitened"
VALIDATION_FILES = ("corners.csv", *SCENE_FILES)
"""Of the line adjustment: the one whose covariance is stated."""
REJECTION_ROUNDS = 10
"""At most so often are corners set aside that do not agree with the lines; each round may bring another corner to an end."""
ASIDE_SHARE = 0.05
"""Of the corners may be set aside, rounded up."""


@dataclass(frozen=True)
class Validation:
    """The truth, what was estimated from the photo files, and the errors."""

    truth: RenderedTargets
    calibration: Calibration
    corners: Corners
    board: BoardLines
    scene: AdjustedScene
    bearings: BearingErrors
    bearing_limit_deg: float
    parameters: ParameterErrors
    lines: LineErrors
    corners_aside: int
    """Corners that the lines do not rest on, since the other photos disagree with them."""
    pixel_m: float
    """Mean size of a pixel at the median distance of the board."""
    notes: tuple[str, ...] = ()
    """What a person should know of the calibration, one sentence each."""

    @property
    def holds(self) -> bool:
        """Whether every check holds."""
        return all(check.holds for check in self.checks)

    @typed
    def save(self, folder: str | Path, inputs: Mapping[str, Any] = MappingProxyType({})) -> tuple[Path, ...]:
        """Write corners.csv and the line scene of the board, its calibration.yaml with `inputs` as what it was made from."""
        with claimed(folder, VALIDATION_FILES, by="validate") as out:
            write_corners(out / "corners.csv", self.corners)
            cameras = refined_calibration(self.scene, self.calibration)
            return (out / "corners.csv", *Scene(self.scene, self.board.segments, cameras, inputs).save(out))

    @typed
    def report(self, path: str | Path, photo_folder: str | Path | None = None, *, plots: str | Path | None = None) -> Path:
        """Write the page that shows all of it, with the photos where they are files in a folder; its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.validation import write_validation_page

        with claimed_report(path, plots):
            return write_validation_page(self, path, photo_folder)

    @property
    def model(self) -> CameraModel:
        """The calibrated camera."""
        return self.calibration["cam0"]

    @property
    def checks(self) -> tuple[Check, ...]:
        """What has to hold, each figure with its limit."""
        lost = math.ceil(LOST_SHARE * len(self.truth.poses))
        aside = math.ceil(ASIDE_SHARE * len(self.corners))
        return (
            _at_most("photos without a usable target", self.photos_lost, lost, "photos"),
            _at_most("bearing error, RMS over the pixels", self.bearings.rms_deg, self.bearing_limit_deg, "degrees"),
            _at_most("parameters, squared Mahalanobis distance", self.parameters.statistic, self.parameters.limit, ""),
            _at_most("worst parameter, standard deviations off", self.parameters.worst_z, WORST_Z, ""),
            _at_most("corners that fit no line", self.corners_aside, aside, "corners"),
            _at_most("lines, squared Mahalanobis distance", self.lines.statistic, self.lines.limit, ""),
            _at_most("distance of the lines' ends, RMS", self.lines.aligned.rms_m / self.pixel_m, LINE_LIMIT_PX, "px"),
            _at_most("scale of the lines, over the board", self.scale_off_px, SCALE_LIMIT_PX, "px"),
        )

    @property
    def scale_off_px(self) -> float:
        """By how much the lines, which the best similarity scales, are too long or too short over the diagonal of the board."""
        diagonal = np.linalg.norm(np.ptp(self.board.ends_m.reshape(-1, 3), axis=0))
        return abs(1.0 / self.lines.aligned.scale - 1.0) * float(diagonal) / self.pixel_m

    @property
    def photos_lost(self) -> int:
        """Photos that the calibration does not rest on."""
        return len(self.truth.poses) - sum(view.used for view in self.calibration.views)


def compare(truth: RenderedTargets, calibration: Calibration, corners: Corners) -> Validation:
    """Compare a calibration from rendered photos, and the lines of the board rebuilt with it, with the truth.

    Rows and columns of the board are segments between their outermost corners, the board is the world, and its calibrated poses
    are those of the photos. The lines are judged by the accuracy that the detector states for the corners: the residuals of the
    calibration would grow with what is wrong. `corners` have it (`sigma_px`) and their ids, as `detect` writes them. Raises
    GeometryError where the lines cannot be rebuilt.
    """
    estimated, covariance = calibration["cam0"], calibration.estimates["cam0"].covariance
    assert covariance is not None
    used = [view for view in calibration.views if view.used]
    basis = estimated.calibration_basis()
    freedom = 2 * sum(view.corners_used for view in used) - basis.shape[1] - 6 * len(used)
    board, scene, aside = _rebuild(calibration, truth, corners)
    pixel_deg = truth.fov_deg / min(truth.camera.image_size)
    return Validation(
        truth,
        calibration,
        corners,
        board,
        scene,
        bearing_errors(estimated, truth.camera, truth.max_angle_rad),
        max(BEARING_LIMIT_DEG, BEARING_LIMIT_PX * pixel_deg),
        parameter_errors(estimated, covariance, truth.camera, freedom),
        line_errors(scene.adjusted, scene.lines.ends_m, board.ends_m),
        aside,
        math.radians(pixel_deg) * _board_distance_m(truth, board),
    )


def _board_distance_m(truth: RenderedTargets, board: BoardLines) -> float:
    """Median, over the photos, of the distance of the middle of the board."""
    middle = torch.as_tensor(board.ends_m.mean((0, 1)))
    return float(truth.cam_from_board.transform(middle[None]).norm(dim=-1).median())


def _at_most(name: str, value: float | int, limit: float | int, unit: str) -> Check:
    return Check(name, float(value), float(limit), unit, bool(value <= limit))


def _rebuild(calibration: Calibration, truth: RenderedTargets, corners: Corners) -> tuple[BoardLines, AdjustedScene, int]:
    """The lines of the board from the corners of all photos with a pose, and how many corners were set aside.

    Every end point has the accuracy that the detector states for it. A corner is set aside where it does not agree with what the
    other photos say of its line, never for its place on the board: that is what is being checked. A line none of whose corners
    agree is wrong as a whole, and stays.
    """
    posed = {view.image: view.cam_from_board for view in calibration.views if view.cam_from_board is not None}
    poses = ImagePoses(tuple(posed), Pose.stack(list(posed.values())), ("cam0",) * len(posed))
    shown = np.isin(corners.view, [view for view, image in enumerate(corners.images) if image in posed])
    assert corners.ids is not None
    # The same corners at their true places: lines rest on pixels, only their grouping and the truth on the board.
    corners = replace(corners, board_m=truth.pattern.points_m[corners.ids])
    kept = shown.copy()
    for _ in range(REJECTION_ROUNDS):
        board, ends = _board_segments(corners, kept)
        scene = reconstruct_lines(board.segments, poses, calibration, cost=COST, loss="cauchy")
        rows = scene.table.rows
        off = np.abs(scene.residual_px) / _stated_px(corners)[ends[rows]]
        outlying = off > RobustThresholds().reject_sigma * NORMAL_MAD * np.nanmedian(off)
        if not outlying.any():
            break
        fewer = kept.copy()
        fewer[ends[rows][outlying]] = False
        if len(board_lines(corners, fewer).ends_m) < len(board.ends_m):
            break
        kept = fewer
    board, _ = _board_segments(corners, kept)
    scene = reconstruct_lines(board.segments, poses, calibration, cost=COST)
    _require_all(scene, truth.pattern)
    return board, scene, int((shown & ~kept).sum())


def _stated_px(corners: Corners) -> Float[np.ndarray, " n"]:
    """Standard deviation of each corner as the detector states it, and no better than detectors are."""
    assert corners.sigma_px is not None
    return np.maximum(corners.sigma_px, NoiseThresholds().corner_floor_px)


def _board_segments(corners: Corners, kept: Bool[np.ndarray, " n"]) -> tuple[BoardLines, Int[np.ndarray, "s 2"]]:
    """Rows and columns with the stated noise of their end points, and the corner that each end is."""
    board = board_lines(corners, kept)
    # The same rows and columns with the numbers of the corners in the place of the pixels.
    numbers = np.repeat(np.arange(len(corners), dtype=np.float64)[:, None], 2, axis=1)
    ends = board_lines(replace(corners, pixels=numbers), kept).segments.endpoints_px[..., 0].astype(np.int64)
    covariance = (_stated_px(corners)[ends] ** 2)[..., None, None] * np.eye(2)
    return replace(board, segments=replace(board.segments, covariance_px2=covariance)), ends


def _require_all(scene: AdjustedScene, pattern: Pattern) -> None:
    """Raise GeometryError unless every row and column of the pattern has become a line."""
    places = np.round(pattern.points_m / SAME_LINE_M)
    expected = len(np.unique(places[:, 0])) + len(np.unique(places[:, 1]))
    found = int(scene.lines.known.sum())
    if found < expected:
        raise GeometryError(
            f"All {expected} rows and columns of the board were expected to be rebuilt, found {found}; give more photos."
        )
