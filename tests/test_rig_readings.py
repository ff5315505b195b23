"""Extrinsics of a rig that are written in another way are told by poses of photos of one instant; frames have to link cameras."""

from dataclasses import replace

import pytest
import torch

from camera_models import Calibration, InputError, OpenCVFisheye
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.rig import rig_of_photos
from omnilines.geometry.rig_readings import refuse_rig_reading
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.rig_of_poses import rig_by_poses
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


LENS = OpenCVFisheye([300.0, 302.0, 319.5, 239.5, 0.01, -0.004, 0.002, 0.0], (640, 480))
OFF = Pose.exp(torch.tensor([0.01, -0.004, 0.003, 0.005, 0.0, 0.002], dtype=torch.float64))


def instants_of(place: Pose, noise: float) -> ImagePoses:
    """Five of a pair whose right camera is at a place, but for noise (rad, m)."""
    random = torch.Generator().manual_seed(2)
    at = Pose.exp(torch.randn(5, 6, generator=random, dtype=torch.float64))
    moved = Pose.exp(noise * torch.randn(5, 6, generator=random, dtype=torch.float64)) @ Pose.stack([place] * 5) @ at
    poses = Pose(torch.cat([at.rotation, moved.rotation]), torch.cat([at.translation, moved.translation]))
    names = tuple(f"{name}/{k}.png" for name in CAMERAS for k in range(5))
    return ImagePoses(names, poses, tuple(name.split("/")[0] for name in names), None, tuple(name[-5] for name in names))


def test_a_rig_begins_where_poses_of_its_photos_put_it_and_held_poses_stay_as_given() -> None:
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(MOUNTED[0])}
    calibration = Calibration(dict.fromkeys(CAMERAS, LENS), rig=rig)
    elsewhere = instants_of(OFF @ MOUNTED[0], 1e-4)
    for refine, says in (
        (("lines",), "its own pose has it"),
        (("lines", "poses"), "held together"),
        (("lines", "poses", "rig"), "refined from where they put it"),
    ):
        found, (note,) = rig_by_poses(elsewhere, calibration, SceneOptions(refine=refine))
        assert says in note and "right 0.6" in note and "(± 0.004) degrees" in note
        if "rig" not in refine:
            assert found is calibration
            continue
        apart = (found.rig["right"].cam_from_rig @ MOUNTED[0].inverse() @ OFF.inverse()).log()
        assert float(apart.abs().max()) < 3e-4
        torch.testing.assert_close(found.rig["left"].cam_from_rig.rotation, torch.eye(3, dtype=torch.float64))
    # Extrinsics in another reading are refused before poses are believed, and photos of no camera of the rig too.
    inverted = replace(calibration, rig={**rig, "right": RigCamera(MOUNTED[0].inverse())})
    with pytest.raises(InputError, match="inverted"):
        rig_by_poses(elsewhere, inverted, SceneOptions(refine=("lines", "poses", "rig")))
    with pytest.raises(InputError, match="camera of every photo of a rig"):
        rig_by_poses(replace(elsewhere, cameras=("up",) * 10), calibration, SceneOptions())
    # Poses that are as far off each other as off the rig do not contradict it.
    for near in (instants_of(MOUNTED[0], 0.01), instants_of(MOUNTED[0], 0.0)):
        assert rig_by_poses(near, calibration, SceneOptions(refine=("lines", "poses", "rig"))) == (calibration, ())


def test_held_poses_are_those_of_the_rig_only_where_they_follow_it() -> None:
    """They were moved to where the rig has them, beside a table that said otherwise."""
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(MOUNTED[0])}
    for place, follows in ((MOUNTED[0], True), (OFF @ MOUNTED[0], False)):
        table = instants_of(place, 0.0)
        mounted, poses = rig_of_photos(table, CAMERAS, rig, False, 20.0, held=True)
        assert (mounted is not None) == follows
        if not follows:
            assert poses is table.cam_from_world
        assert rig_of_photos(table, CAMERAS, rig, False, 20.0)[0] is not None
