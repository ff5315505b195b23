"""The calibrated rig: cameras, where they stand, how certain all of it is together, and what became of every view."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.model_misfit import ModelMisfit
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.against_alone import AgainstAlone
from omnilines.calibration.rig.given import OtherThanGiven
from omnilines.calibration.rig.links import Link
from omnilines.calibration.unmodelled import Unmodelled
from omnilines.records import Corners, ViewResult

TWIST_NAMES = ("rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "x_m", "y_m", "z_m")
"""Of the left perturbation of a pose."""


@dataclass(frozen=True, eq=False)
class RigMember:
    """One camera of a rig."""

    name: str
    model: CameraModel
    covariance: Float[np.ndarray, "p p"]
    """Of the parameters in their order."""
    cam_from_rig: Pose
    pose_covariance: Float[np.ndarray, "6 6"]
    """Of the left perturbation (rotation_rad, translation_m); zero for the rig frame."""
    rms_px_per_axis: float
    rms_px_per_point: float
    alone_rms_px_per_point: float
    """Of the camera calibrated by itself, with the board as the rig has it."""
    worse: bool
    """Whether its corners fit the rig worse than that, by more than chance."""
    min_angle_deg: float
    max_angle_deg: float
    sign_source: str | None
    held: bool
    interval_95: Float[np.ndarray, "p 2"]
    """Lowest and highest value of each parameter, which hold it in 95 of 100 cases."""
    time_offset_s: float | None = None
    """How far its clock is ahead of that of the first camera; None where that was not estimated."""
    time_offset_sigma_s: float | None = None
    """One standard deviation."""
    line_delay: LineDelay | None = None
    """Of its rolling shutter; None where that was not estimated."""
    chosen: str = ""
    """Why its model was chosen, one sentence; empty where it was named."""
    misfit: ModelMisfit | None = None
    """Where its model does not follow the lens, as its own corners show."""
    other: OtherThanGiven | None = None
    """Where its calibration is held and is not that of its photos."""

    @property
    def follows(self) -> str:
        """What follows its lens, or does not."""
        return "given calibration" if self.held else f"{self.model.NAME} model"

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return dict(zip(self.model.PARAMETER_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig with everything that the report and the files need."""

    members: tuple[RigMember, ...]
    """In the order of the table; the first is the rig frame."""
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "k k"]
    """Of all parameters, camera poses but the first, free boards and board terms, together; `names` says what each row is."""
    boards: tuple[str, ...]
    target_from_board: Pose
    board_covariance: Float[np.ndarray, "b 6 6"]
    frames: tuple[str, ...]
    """One for each pose of the target; with boards that move by themselves, frame and board."""
    rig_from_target: Pose
    frame_covariance: Float[np.ndarray, "f 6 6"]
    corners: Corners
    """With the coordinates as the rig numbers them, each board in its plane z = 0."""
    in_one_frame: bool
    """Whether the boards' coordinates were given in one common frame, that of the target."""
    residual_px: Float[np.ndarray, "n 2"]
    """Projected minus observed pixel; NaN for corners of views that were not used."""
    kept: Bool[np.ndarray, " n"]
    views: tuple[ViewResult, ...]
    links: tuple[Link, ...]
    weakest: Link | None
    left_out: Mapping[str, str]
    """Cameras that are not of the rig, and why."""
    left_out_alone: Mapping[str, CameraCalibration]
    """Those of them that could be calibrated by themselves."""
    rms_px_per_axis: float
    rms_px_per_point: float
    board: BoardShape
    board_sigma: Mapping[str, float]
    """One standard deviation of each board term that was estimated."""
    iterations: int
    notes: tuple[str, ...]
    against_alone: AgainstAlone
    """What of the cameras alone contradicts the rig."""
    line_delays: tuple[LineDelay, ...] = ()
    """Rolling shutters that were recognised or estimated."""
    one_pose_rms_px: float | None = None
    """Per point, with one pose of the board in each frame, where each view has a motion of its own, which `rms_px_per_point`
    does not hold."""
    unmodelled: Unmodelled | None = None
    """What neither the drawing of the board nor a camera's model holds, and all frames agree on; of the camera it moves most."""

    @property
    def board_terms(self) -> dict[str, float]:
        """The estimated board terms."""
        return {name: float(self.board.terms[self.board.names.index(name)]) for name in self.board_sigma}

    def member(self, name: str) -> RigMember:
        """The camera of this name."""
        return next(member for member in self.members if member.name == name)

    def as_given(self) -> tuple[Corners, tuple[ViewResult, ...]]:
        """Corners and views with boards in the frame in which they were given: where that is a common one, corners stand in it
        and `cam_from_board` is the pose of the whole target."""
        if not self.in_one_frame:
            return self.corners, self.views
        place = {name: k for k, name in enumerate(self.boards)}
        names = self.corners.boards or (self.boards[0],) * len(self.corners.view_names)
        board_m = self.corners.board_m.copy()
        for name, k in place.items():
            rows = np.array([own == name for own in names])[self.corners.view]
            board_m[rows] = self.target_from_board[k].transform(torch.as_tensor(board_m[rows])).numpy()
        views = tuple(
            view
            if view.cam_from_board is None
            else replace(view, cam_from_board=view.cam_from_board @ self._board(names, v).inverse())
            for v, view in enumerate(self.views)
        )
        return replace(self.corners, board_m=board_m), views

    def _board(self, names: Sequence[str], view: int) -> Pose:
        return self.target_from_board[self.boards.index(names[view])]
