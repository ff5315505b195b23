"""Structure from motion with a rig: one that is right, and one that photos contradict."""

import math
import re

import numpy as np
import pytest
import torch
from sfm_scenes import described, errors, places, run_on, world

from camera_models import Calibration, GeometryError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.posing import sfm
from omnilines.scenes import scene_camera

SECOND = Pose.exp(torch.tensor([0.1, math.pi / 2, 0.05, 0.25, 0.02, 0.1], dtype=torch.float64))
"""The right camera of a pair from the left one."""


def posed_pair(stated: Pose, monkeypatch, tmp_path, **asked):
    """What structure from motion finds of five instants of a pair, `stated` as the right camera's place, and the true poses."""
    camera, _ = scene_camera("scaramuzza", (800, 600), 0, 220.0)
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(stated)}
    calibration = Calibration(dict.fromkeys(rig, camera), {}, rig)
    points, words = world(700, 4)
    at = places(5, 6)
    names, poses, features = [], [], []
    for k in range(5):
        for name, cam_from_rig in (("left", Pose.identity()), ("right", SECOND)):
            names.append(f"{name}/{k}.png")
            poses.append(cam_from_rig @ at[k])
            features.append(described(camera, poses[-1], points, words, np.random.default_rng([len(names), 7])))
    camera_of, frame_of = {n: n.split("/")[0] for n in names}, {n: n.split("/")[1] for n in names}
    return run_on(features, monkeypatch, tmp_path, calibration, names, camera_of, frame_of=frame_of, **asked), poses


@pytest.mark.slow
def test_a_rig_moves_as_one_and_gives_the_scale(monkeypatch, tmp_path):
    found, poses = posed_pair(SECOND, monkeypatch, tmp_path)
    names = [f"{name}/{k}.png" for k in range(5) for name in ("left", "right")]
    assert found.poses.images == tuple(names)
    position, rotation = errors(found.poses, Pose.stack(poses), names, metric=True)
    assert position.max() < 0.01
    assert rotation.max() < 0.15
    assert "metres" in found.notes[0]
    relative = found.poses.cam_from_world[1] @ found.poses.cam_from_world[0].inverse()
    torch.testing.assert_close(relative.translation, SECOND.translation, rtol=0, atol=1e-9)
    assert found.poses.frames == tuple(f"{k}.png" for k in range(5) for _ in range(2))
    assert not any("do not agree with the rig" in note for note in found.notes)


@pytest.mark.slow
def test_a_rig_that_photos_contradict_is_named(monkeypatch, tmp_path):
    """Its right camera is turned by 0.6 degrees from where the calibration has it."""
    off = Pose.exp(torch.tensor([0.3, 0.4, 0.33, 0.0, 0.0, 0.0], dtype=torch.float64).deg2rad())
    found, _ = posed_pair(off @ SECOND, monkeypatch, tmp_path)
    (said,) = [note for note in found.notes if "do not agree with the rig" in note]
    (told,) = re.findall(r"They put right ([\d.]+) \(± ([\d.]+)\) degrees", said)
    turn_deg, sigma_deg = map(float, told)
    assert 0.3 < turn_deg < 0.7 and sigma_deg < 0.2 * turn_deg


@pytest.mark.slow
def test_a_rig_that_photos_contradict_is_found_anew_where_it_is_refined(monkeypatch, tmp_path):
    """Its right camera is turned by 2.5 degrees and 20 mm off; one that is right stays, to the last digit."""
    off = Pose.exp(torch.cat([torch.tensor([1.5, 2.0, 0.0]).double().deg2rad(), torch.tensor([0.012, 0.0, 0.016]).double()]))
    found, poses = posed_pair(off @ SECOND, monkeypatch, tmp_path, refine_rig=True)
    assert any("The rig is as photos tell" in note for note in found.notes)
    apart = (found.rig["right"] @ found.rig["left"].inverse() @ SECOND.inverse()).log()
    assert float(apart[:3].norm().rad2deg()) < 0.1
    mounted = found.poses.cam_from_world[1] @ found.poses.cam_from_world[0].inverse()
    torch.testing.assert_close(mounted.rotation, (found.rig["right"] @ found.rig["left"].inverse()).rotation, rtol=0, atol=1e-9)
    # The scale is that of the calibration, whose cameras are farther apart.
    names = [f"{name}/{k}.png" for k in range(5) for name in ("left", "right")]
    stretched = float((off @ SECOND).translation.norm() / SECOND.translation.norm())
    position, rotation = errors(found.poses, Pose.stack(poses).after_similarity(stretched, Pose.identity()), names, metric=True)
    assert position.max() < 0.02 and rotation.max() < 0.15
    right, _ = posed_pair(SECOND, monkeypatch, tmp_path, refine_rig=True)
    assert not right.rig


@pytest.mark.slow
def test_a_rig_that_is_no_better_leaves_the_poses_that_there_were(monkeypatch, tmp_path):
    """Its doubts do not ask for what was asked, and points that a moved rig loses are no error."""

    def lost(*_: object, **__: object) -> None:
        raise GeometryError("No points are left.")

    off = Pose.exp(torch.tensor([0.3, 0.4, 0.33, 0.0, 0.0, 0.0], dtype=torch.float64).deg2rad())
    monkeypatch.setattr(sfm, "matched_again", lost)
    found, _ = posed_pair(off @ SECOND, monkeypatch, tmp_path, refine_rig=True)
    assert not found.rig and len(found.poses) == 10
    (said,) = [note for note in found.notes if "do not agree with the rig" in note]
    assert "Calibrate the rig anew" in said and "`refine`" not in said
