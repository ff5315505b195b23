"""Files of ROS's camera_calibration and its messages, as their documents say."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tool_files import RAYS, put

from camera_models import InputError, OpenCVFisheye
from camera_models.formats import read

OST = """image_width: 640
image_height: 480
camera_name: rgb_Astra_Orbbec
camera_matrix:
  rows: 3
  cols: 3
  data: [526.6908296825479, 0, 312.3333507245396, 0, 525.7542623070541, 246.2279496394374, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.01864117263397289, -0.0807953154457166, 0.0006701578887838996, -0.001800282263098739, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [516.2001953125, 0, 310.3634868958034, 0, 0, 514.0494995117188, 246.8852026000968, 0, 0, 0, 1, 0]
"""
# A dumped message of ROS 2, and a file of the fisheye calibrator of ROS melodic, which has `camera_model` for `distortion_model`.
MESSAGE = """header: {frame_id: pylon_camera}
height: 1200
width: 1920
distortion_model: equidistant
d: [-0.01, 0.02, -0.003, 0.0004]
k: [1133.11191, 4.26466, 960.73323, 0.0, 1128.01793, 600.81623, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [1133.11191, 4.26466, 960.73323, 0.0, 0.0, 1128.01793, 600.81623, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 1
binning_y: 1
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
"""


def test_ros_files_and_messages(tmp_path: Path) -> None:
    content = read(put(tmp_path / "ost.yaml", OST))
    ((name, camera),) = content.calibration.items()
    assert name == "rgb_Astra_Orbbec" and camera.image_size == (640, 480)
    assert content.notes == ("Not kept: the rectification (rectification_matrix, projection_matrix).",)
    matrix = np.array([[526.6908296825479, 0, 312.3333507245396], [0, 525.7542623070541, 246.2279496394374], [0, 0, 1]])
    coefficients = np.array([0.01864117263397289, -0.0807953154457166, 0.0006701578887838996, -0.001800282263098739, 0])
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    near = np.hypot(*RAYS[:, :2].T) < 0.8
    np.testing.assert_allclose(camera.project(RAYS[near])[0], expected[near], atol=1e-9)
    content = read(put(tmp_path / "message.yaml", MESSAGE))
    (camera,) = content.calibration.values()
    assert isinstance(camera, OpenCVFisheye) and camera.image_size == (1920, 1200)
    assert content.notes == ("The skew of 4.26466 px in the camera matrix is not kept: ROS and OpenCV do not use it.",)
    matrix, coefficients = (
        np.array([[1133.11191, 0, 960.73323], [0, 1128.01793, 600.81623], [0, 0, 1]]),
        np.array([-0.01, 0.02, -0.003, 0.0004]),
    )
    expected = cv2.fisheye.projectPoints(RAYS[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(camera.project(RAYS)[0], expected, atol=1e-9)


def test_ros_variants(tmp_path: Path) -> None:
    melodic = (
        OST.replace("distortion_model: plumb_bob", "camera_model: fisheye")
        .replace("cols: 5", "cols: 4")
        .replace(", 0]\nrect", "]\nrect")
    )
    (camera,) = read(put(tmp_path / "a.yaml", melodic)).calibration.values()
    assert isinstance(camera, OpenCVFisheye) and camera.named_parameters()["k3"] == 0.0006701578887838996
    stereo = OST.replace("310.3634868958034, 0,", "310.3634868958034, -61.944,")
    assert read(put(tmp_path / "b.yaml", stereo)).notes[1] == "Not kept: the baseline in the projection matrix, 0.12 m."
    rational = (
        OST.replace("plumb_bob", "rational_polynomial")
        .replace("cols: 5", "cols: 8")
        .replace(", 0]\nrect", ", 0.1, 0.2, 0.3, 0.4]\nrect")
    )
    (camera,) = read(put(tmp_path / "c.yaml", rational)).calibration.values()
    values = camera.named_parameters()
    assert [values[key] for key in ("k3", "k4", "k5", "k6", "p1")] == [0.1, 0.2, 0.3, 0.4, 0.0006701578887838996]
    for old, new, message in (
        ("plumb_bob", "thin_prism", "found thin_prism"),
        (", 0]\nrect", ", 0, 0.5]\nrect", "must have 5 coefficients, found more that are not zero"),
        ("[526.6908296825479", "[0.0", "that of a calibrated camera, found fx = 0"),
        ("[526.6908296825479", "[-400", "must have fx and fy above 0, found -400 and 525.754; correct it"),
        ("camera_matrix", "intrinsics", "A ROS file has a camera_matrix .*, found none among image_width, .*intrinsics"),
        ("image_width: 640", "image_width: 0", "must be at least 1 x 1 pixels"),
    ):
        with pytest.raises(InputError, match=message):
            read(put(tmp_path / "bad.yaml", OST.replace(old, new)), "ros")


def test_what_ros_prints_of_a_topic_is_one_document(tmp_path: Path) -> None:
    """`rostopic echo` ends a message with a line of ---."""
    (camera,) = read(put(tmp_path / "message.yaml", MESSAGE)).calibration.values()
    (printed,) = read(put(tmp_path / "printed.yaml", MESSAGE + "---\n")).calibration.values()
    assert printed.named_parameters() == camera.named_parameters()
    with pytest.raises(InputError, match="expected to hold one document of YAML, found 2 set apart by ---; keep one"):
        read(put(tmp_path / "two.yaml", f"{MESSAGE}---\n{MESSAGE}---\n"))
