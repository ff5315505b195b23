"""Files of aniposelib, Caliscope and MC-Calib: rigs of OpenCV's cameras."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from camera_models import Calibration, InputError, OpenCVFisheye, Pinhole
from camera_models.formats import read, write
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose

POINTS = np.random.default_rng(1).normal(size=(50, 3)) * 0.3 + [0, 0, 2.0]
ANIPOSE = """
[cam_0]
name = "left"
size = [ 1440, 1080,]
matrix = [ [ 1850.5, 0.0, 719.5,], [ 0.0, 1849.0, 539.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.03, 0.01, 1e-3, -2e-3, 0.002,]
rotation = [ 0.1, -0.2, 0.3,]
translation = [ 0.5, -0.7, 1.8,]

[cam_1]
name = "right"
size = [ 1440, 1080,]
fisheye = true
matrix = [ [ 700.0, 0.0, 720.0,], [ 0.0, 701.0, 540.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.03, 0.01, 1e-3, -2e-3,]
rotation = [ -0.2, -0.1, 0.05,]
translation = [ -0.2, 0.1, 0.3,]

[metadata]
adjusted = true
error = 1.6
"""
# As the README of MC-Calib shows it: a pinhole and a fisheye, the second to the right of the first.
MC_CALIB = """%YAML:1.0
---
nb_camera: 2
camera_0:
   camera_matrix: !!opencv-matrix
      rows: 3
      cols: 3
      dt: d
      data: [ 690.5, 0., 651.1, 0., 689.2, 267.4, 0., 0., 1. ]
   distortion_vector: !!opencv-matrix
      rows: 1
      cols: 5
      dt: d
      data: [ -0.0556, 0.1269, -2.5e-04, 1.2e-03, -0.0678 ]
   distortion_type: 0
   camera_group: 0
   img_width: 1280
   img_height: 512
   camera_pose_matrix: !!opencv-matrix
      rows: 4
      cols: 4
      dt: d
      data: [ 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1. ]
camera_1:
   camera_matrix: !!opencv-matrix
      rows: 3
      cols: 3
      dt: d
      data: [ 334.7, 0., 632.7, 0., 334.1, 266.5, 0., 0., 1. ]
   distortion_vector: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 0.0118, -5.2e-03, 2.6e-03, 0. ]
   distortion_type: 1
   camera_group: 0
   img_width: 1280
   img_height: 512
   camera_pose_matrix: !!opencv-matrix
      rows: 4
      cols: 4
      dt: d
      data: [ 1., 0., 0., 19.84, 0., 1., 0., 0.06, 0., 0., 1., 1.86, 0., 0., 0., 1. ]
"""


def rig() -> Calibration:
    pose = Pose.exp(torch.tensor([0.1, -0.2, 0.3, 0.4, 0.5, -0.6], dtype=torch.float64))
    cameras = {"left": Pinhole.examples()[0], "right": OpenCVFisheye.examples()[0]}
    return Calibration(cameras, rig={"left": RigCamera(Pose.identity()), "right": RigCamera(pose)})


def test_anipose_poses_and_coefficients_are_those_of_opencv(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE)
    content = read(path)
    assert list(content.calibration) == ["left", "right"]
    left, right = content.calibration.values()
    matrices = [
        np.array([[1850.5, 0, 719.5], [0, 1849.0, 539.5], [0, 0, 1]]),
        np.array([[700, 0, 720], [0, 701, 540], [0, 0, 1.0]]),
    ]
    rotation, translation = np.array([0.1, -0.2, 0.3]), np.array([0.5, -0.7, 1.8])
    turned = POINTS @ cv2.Rodrigues(rotation)[0].T + translation
    by_opencv = cv2.projectPoints(POINTS, rotation, translation, matrices[0], np.array([-0.03, 0.01, 1e-3, -2e-3, 0.002]))[0][
        :, 0
    ]
    np.testing.assert_allclose(left.project(turned)[0], by_opencv, atol=1e-9)
    by_fisheye = cv2.fisheye.projectPoints(
        POINTS[:, None], np.zeros(3), np.zeros(3), matrices[1], np.array([-0.03, 0.01, 1e-3, -2e-3])
    )
    np.testing.assert_allclose(right.project(POINTS)[0], by_fisheye[0][:, 0], atol=1e-9)
    # From the world over the first camera to the second, as straight to it.
    second = content.calibration.rig["right"].cam_from_rig
    straight = POINTS @ cv2.Rodrigues(np.array([-0.2, -0.1, 0.05]))[0].T + [-0.2, 0.1, 0.3]
    np.testing.assert_allclose(turned @ second.rotation.numpy().T + second.translation.numpy(), straight, atol=1e-12)
    assert any("frame of its own" in note for note in content.notes)


def test_anipose_sorts_its_tables_by_name(tmp_path: Path) -> None:
    cameras = {f"c{index}": Pinhole.examples()[0] for index in range(11)}
    poses = {name: RigCamera(Pose.identity()) for name in cameras}
    write(tmp_path / "calibration.toml", Calibration(cameras, rig=poses))
    tables = [line for line in (tmp_path / "calibration.toml").read_text().splitlines() if line.startswith("[")]
    assert tables == sorted(tables) and len(tables) == 11


def test_caliscope_keeps_errors_numbers_and_cameras_without_a_pose(tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    path.write_text(
        "[cameras.3]\ncam_id = 3\nsize = [640, 480]\nrotation_count = 1\nerror = 0.25\nmatrix = [[500.0, 0.0, 320.0], "
        "[0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]\ndistortions = [[0.1, 0.0, 0.0, 0.0, 0.0]]\nfisheye = false\n"
        "rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\ntranslation = [[0.1], [0.2], [0.3]]\n"
        "\n[cameras.7]\ncam_id = 7\nsize = [640, 480]\nmatrix = [[500.0, 0.0, 320.0], "
        "[0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]\ndistortions = [0.1, 0.0, 0.0, 0.0, 0.0]\n"
    )
    content = read(path)
    assert list(content.calibration) == ["3", "7"] and not content.calibration.rig
    assert content.calibration.estimates["3"].rms_px_per_point == 0.25
    assert any("which camera 7 has not" in note for note in content.notes)
    assert any("rotation_count" in note for note in content.notes)
    write(tmp_path / "again_camera_array.toml", content.calibration)
    assert list(read(tmp_path / "again_camera_array.toml").calibration) == ["3", "7"]


def test_mc_calib_poses_stand_in_the_frame_of_the_first_camera(tmp_path: Path) -> None:
    path = tmp_path / "calibrated_cameras_data.yml"
    path.write_text(MC_CALIB)
    content = read(path)
    assert content.notes == ()
    first, second = content.calibration.values()
    assert isinstance(first, Pinhole) and isinstance(second, OpenCVFisheye)
    np.testing.assert_allclose(content.calibration.rig["cam1"].cam_from_rig.centre, [19.84, 0.06, 1.86], atol=1e-12)
    path.write_text(MC_CALIB.replace("nb_camera: 2", "nb_camera: 3"))
    with pytest.raises(InputError, match=r"must hold nb_camera = 3 cameras, found others"):
        read(path)
    apart = MC_CALIB.replace("camera_group: 0", "camera_group: 1", 1)
    path.write_text(apart)
    assert not read(path).calibration.rig and "several groups" in read(path).notes[0]


@pytest.mark.parametrize("name", ["calibration.toml", "camera_array.toml", "calibrated_cameras_data.yml"])
def test_opencv_itself_reads_what_is_written_as_the_tools_do(name: str, tmp_path: Path) -> None:
    """The pose of the second camera, by the rules of each tool."""
    given = rig()
    write(tmp_path / name, given)
    pose = given.rig["right"].cam_from_rig
    if name.endswith(".yml"):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_READ)
        matrix = storage.getNode("camera_1").getNode("camera_pose_matrix").mat()
        np.testing.assert_allclose(matrix[:3, 3], pose.centre, atol=1e-12)
        np.testing.assert_allclose(matrix[:3, :3], pose.rotation.T, atol=1e-12)
        return
    data = tomllib.loads((tmp_path / name).read_text())
    table = data["cam_1"] if "cam_1" in data else data["cameras"]["1"]
    np.testing.assert_allclose(cv2.Rodrigues(np.array(table["rotation"]))[0], pose.rotation, atol=1e-12)
    np.testing.assert_allclose(table["translation"], pose.translation, atol=1e-12)
    assert table["fisheye"] is True and len(table["distortions"]) == 4
