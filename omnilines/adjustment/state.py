"""What an adjustment moves: lines, the poses of frames, the extrinsics of a rig and the cameras."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.geometry.line_chart import LineChart

AT_ONCE = 1 << 16
"""Observations whose normals are formed at once: charts and poses of all would take more memory than the arcs."""


@dataclass(frozen=True)
class Rig:
    """Cameras that are mounted together: the pose of a photo is cam_from_rig @ rig_from_world."""

    frame: Int[Tensor, " images"]
    """Instant of each photo."""
    camera: Int[Tensor, " images"]
    """Camera of each photo."""
    cam_from_rig: Pose
    """Of every camera; the first is the rig frame."""

    @property
    def frames(self) -> int:
        """Number of instants."""
        return int(self.frame.max()) + 1

    def has_baseline(self, photos: Int[Tensor, " n"]) -> bool:
        """Whether the cameras of these photos are mounted at several places, which gives lengths."""
        centres = self.cam_from_rig.centre[torch.unique(self.camera[photos])]
        return bool((centres - centres[0]).norm(dim=-1).max() > 0)


@dataclass(frozen=True)
class LinesAndPoses:
    """State of the adjustment. Without a rig every photo is a frame of its own."""

    rig_from_world: Pose
    """Of every frame; without a rig this is `cam_from_world` of every photo."""
    chart: LineChart
    rig: Rig | None = None
    models: tuple[CameraModel, ...] = ()
    """Of the calibration, in its order, where cameras are refined."""

    @property
    def cam_from_world(self) -> Pose:
        """Of every photo."""
        if self.rig is None:
            return self.rig_from_world
        return self.rig.cam_from_rig[self.rig.camera] @ self.rig_from_world[self.rig.frame]

    def normals(self, arcs: MatchedArcs) -> Float[Tensor, "n 3"]:
        """Projection-plane normal M of every observation, camera frame."""
        poses, rows = self.cam_from_world, zip(arcs.image.split(AT_ONCE), arcs.track.split(AT_ONCE), strict=True)
        return torch.cat([self.chart[track].projection_normal(poses[image])[0] for image, track in rows])


def moved_poses(poses: Pose, free: Int[Tensor, " f"], delta: Float[Tensor, "f 6"]) -> Pose:
    """exp(delta) T of the free poses; the others as they are."""
    moved = Pose.exp(delta) @ poses[free]
    rotation, translation = poses.rotation.clone(), poses.translation.clone()
    rotation[free], translation[free] = moved.rotation, moved.translation
    return Pose(rotation, translation)
