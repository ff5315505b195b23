"""Extrinsics of a rig that are written in another way are told by poses of photos of one instant; frames have to link cameras."""

import pytest
import torch

from camera_models import InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.rig import rig_of_photos
from omnilines.geometry.rig_readings import refuse_rig_reading
from omnilines.records import ImagePoses

MOUNTED = Pose.exp(torch.tensor([[0.02, 1.0, -0.05, -0.3, 0.04, 0.08]], dtype=torch.float64))
CAMERAS = ("left", "right")


def rough(scale: float = 0.02, pairs: int = 6) -> Pose:
    noise = scale * torch.randn(pairs, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Pose.exp(noise) @ MOUNTED[torch.zeros(pairs, dtype=torch.long)]


def written(pose: Pose, pairs: int = 6) -> Pose:
    return pose[torch.zeros(pairs, dtype=torch.long)]


@pytest.mark.parametrize("scale", [1e-4, 0.02, 0.2])
def test_a_rig_that_rough_poses_bear_out_is_taken(scale: float) -> None:
    refuse_rig_reading(rough(scale), written(MOUNTED))


def test_other_readings_are_named() -> None:
    turn, move = MOUNTED.rotation, MOUNTED.translation
    wrong = {
        "inverted": MOUNTED.inverse(),
        "centre for t": Pose(turn, MOUNTED.centre),
        "transposed": Pose(turn.mT, move),
        "millimetres": Pose(turn, 1000 * move),
        "centimetres": Pose(turn, 100 * move),
        "apart by their poses": Pose(turn, 0 * move),
    }
    for says, pose in wrong.items():
        with pytest.raises(InputError, match=says):
            refuse_rig_reading(rough(), written(pose))


def photos(frames: tuple[str, ...], cameras: tuple[str, ...]) -> ImagePoses:
    images = tuple(f"{k}.png" for k in range(len(frames)))
    at = Pose.stack([MOUNTED[0] if name == "right" else Pose.identity() for name in cameras])
    return ImagePoses(images, at, cameras=cameras, frames=frames)


def test_a_rig_is_refined_where_frames_link_its_cameras() -> None:
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(MOUNTED[0])}
    linked = photos(("0", "0", "1"), ("left", "right", "left"))
    assert rig_of_photos(linked, CAMERAS, rig, True, 20.0)[0] is not None
    for apart in (photos(("0", "1"), CAMERAS), photos(("0", "1"), ("right", "right"))):
        with pytest.raises(InputError, match="camera right shares with left"):
            rig_of_photos(apart, CAMERAS, rig, True, 20.0)
        mounted, poses = rig_of_photos(apart, CAMERAS, rig, False, 20.0)
        assert mounted is None and len(poses) == 2
