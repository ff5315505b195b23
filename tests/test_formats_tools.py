"""Files of Kalibr, Basalt and mrcal: what their documents say, beside their own code where it is at hand (OpenCV, SciPy)."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tool_files import RAYS, put, rig_pair

from camera_models import Calibration, DoubleSphere, ExtendedUnified, InputError, Pinhole, Unified
from camera_models.formats import read, write

# The chain.yaml of Kalibr's wiki, "yaml formats": both cameras also with the pose of the IMU.
CAMCHAIN = """
cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  T_cam_imu:
  - [0.01779318, 0.99967549,-0.01822936, 0.07008565]
  - [-0.9998017, 0.01795239, 0.00860714,-0.01771023]
  - [0.00893160, 0.01807260, 0.99979678, 0.00399246]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.121e-05
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: omni
  intrinsics: [0.80065662, 833.006, 830.345, 373.850, 253.749]
  distortion_model: radtan
  distortion_coeffs: [-0.33518750, 0.13211436, 0.00055967, 0.00057686]
  T_cn_cnm1:
  - [ 0.99998854, 0.00216014, 0.00427195,-0.11003785]
  - [-0.00221074, 0.99992702, 0.01187697, 0.00045792]
  - [-0.00424598,-0.01188627, 0.99992034,-0.00064487]
  - [0.0, 0.0, 0.0, 1.0]
  T_cam_imu:
  - [ 0.01567142, 0.99978002,-0.01393948,-0.03997419]
  - [-0.99966203, 0.01595569, 0.02052137,-0.01735854]
  - [ 0.02073927, 0.01361317, 0.99969223, 0.00326019]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.681e-05
  rostopic: /cam1/image_raw
  resolution: [752, 480]
"""
# data/euroc_ds_calib.json of Basalt: a stereo pair whose cameras stand 110 mm apart along x.
BASALT = {
    "value0": {
        "T_imu_cam": [
            {
                "px": -0.016774788924641534, "py": -0.068938940687127, "pz": 0.005139123188382424,
                "qx": -0.007239825785317818, "qy": 0.007541278561558601, "qz": 0.7017845426564943, "qw": 0.7123125505904486,
            },
            {
                "px": -0.01507436282032619, "py": 0.0412627204046637, "pz": 0.00316287258752953,
                "qx": -0.0023360576185881625, "qy": 0.013000769689092388, "qz": 0.7024677108343111, "qw": 0.7115930283929829,
            },
        ],
        "intrinsics": [
            {
                "camera_type": "ds",
                "intrinsics": {
                    "fx": 349.7560023050409, "fy": 348.72454229977037, "cx": 365.89440762590149, "cy": 249.32995565708704,
                    "xi": -0.2409573942178872, "alpha": 0.566996899163044,
                },
            },
            {
                "camera_type": "eucm",
                "intrinsics": {"fx": 460.76, "fy": 459.42, "cx": 365.90, "cy": 249.36, "alpha": 0.5903, "beta": 1.1323},
            },
        ],
        "resolution": [[752, 480], [752, 480]],
        "calib_accel_bias": [0.0017, 0.15, 0.067, 0, 0, 0, 0, 0, 0],
        "imu_update_rate": 200.0,
        "cam_time_offset_ns": 0,
    }
}  # fmt: skip


# Kalibr


def test_kalibr_chain_goes_from_the_camera_before_to_this_one(tmp_path: Path) -> None:
    """T_cn_cnm1 and the two T_cam_imu of the documented chain say the same, to the accuracy of its example."""
    path = put(tmp_path / "camchain.yaml", CAMCHAIN)
    rotation, translation = rig_pair(path)
    np.testing.assert_allclose(translation, [-0.11003785, 0.00045792, -0.00064487], atol=1e-12)
    over_imu = put(
        tmp_path / "imu.yaml", "".join(CAMCHAIN.split("  T_cn_cnm1:\n")[0:1]) + "  T_cam_imu:" + CAMCHAIN.split("T_cam_imu:")[2]
    )
    again = rig_pair(over_imu)
    np.testing.assert_allclose(rotation, again[0], atol=2e-6)
    np.testing.assert_allclose(translation, again[1], atol=2e-6)
    assert np.abs(rotation - again[0].T).max() > 1e-3


def test_kalibr_chain_of_three(tmp_path: Path) -> None:
    turn = Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix()
    step = [[*row, shift] for row, shift in zip(turn.tolist(), (0.2, 0.0, -0.1), strict=True)] + [[0.0, 0.0, 0.0, 1.0]]
    camera = "camera_model: ds, intrinsics: [-0.2, 0.57, 350, 349, 366, 249], resolution: [752, 480]"
    camera += ", distortion_model: none, distortion_coeffs: []"
    text = f"cam0: {{{camera}}}\n" + "".join(f"cam{k}: {{{camera}, T_cn_cnm1: {step}}}\n" for k in (1, 2))
    calibration = read(put(tmp_path / "chain.yaml", text)).calibration
    assert isinstance(calibration["cam2"], DoubleSphere)
    assert calibration["cam2"].named_parameters() == {"fx": 350, "fy": 349, "cx": 366, "cy": 249, "xi": -0.2, "alpha": 0.57}
    matrix = np.array(step)
    pose = calibration.rig["cam2"].cam_from_rig
    np.testing.assert_allclose(pose.rotation, (matrix @ matrix)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(pose.translation, (matrix @ matrix)[:3, 3], atol=1e-12)


def test_kalibr_cameras_project_as_opencv_does(tmp_path: Path) -> None:
    calibration = read(put(tmp_path / "camchain.yaml", CAMCHAIN)).calibration
    assert calibration["cam0"].image_size == (752, 480)
    zero = np.zeros(3)
    matrix = np.array([[461.629, 0, 362.680], [0, 460.152, 246.049], [0, 0, 1]])
    coefficients = np.array([-0.27695497, 0.06712482, 0.00087538, 0.00011556])
    near = RAYS[np.hypot(*RAYS[:, :2].T) < 0.7]
    expected = cv2.projectPoints(near, zero, zero, matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(calibration["cam0"].project(near)[0], expected, atol=1e-9)
    matrix = np.array([[833.006, 0, 373.850], [0, 830.345, 253.749], [0, 0, 1]])
    coefficients = np.array([[-0.33518750, 0.13211436, 0.00055967, 0.00057686]])
    expected = cv2.omnidir.projectPoints(near[:, None], zero, zero, matrix, 0.80065662, coefficients)[0].reshape(-1, 2)
    np.testing.assert_allclose(calibration["cam1"].project(near)[0], expected, atol=1e-9)
    equidistant = CAMCHAIN.split("cam1:")[0].replace("radtan", "equidistant")
    (camera,) = read(put(tmp_path / "equi.yaml", equidistant)).calibration.values()
    matrix = np.array([[461.629, 0, 362.680], [0, 460.152, 246.049], [0, 0, 1]])
    coefficients = np.array([-0.27695497, 0.06712482, 0.00087538, 0.00011556])
    expected = cv2.fisheye.projectPoints(near[:, None], zero, zero, matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(camera.project(near)[0], expected, atol=1e-9)


def test_kalibr_says_what_it_leaves(tmp_path: Path) -> None:
    notes = read(put(tmp_path / "camchain.yaml", CAMCHAIN)).notes
    assert notes == ("Not kept of cam0, cam1: T_cam_imu, timeshift_cam_imu.",)
    refused = {
        "distortion_model: radtan": ("distortion_model: fov", "found pinhole-fov"),
        "0.00011556]": ("0.00011556, 0.1]", "must have 8 parameters, found 9"),
        "- [0.0, 0.0, 0.0, 1.0]": ("- [0.0, 0.0, 0.0, 2.0]", "last row of T_cn_cnm1 of cam1 must be 0 0 0 1"),
        "0.99998854": ("0.5", "must be orthonormal and right-handed"),
        "cam1:": ("cam2:", "The key cam1 is missing"),
    }
    for old, (new, message) in refused.items():
        with pytest.raises(InputError, match=message):
            read(put(tmp_path / "bad.yaml", CAMCHAIN.replace(old, new)), "kalibr")
    plain = (
        CAMCHAIN.split("cam1:")[0].replace("radtan", "none").replace("[-0.27695497, 0.06712482, 0.00087538, 0.00011556]", "[]")
    )
    (camera,) = read(put(tmp_path / "plain.yaml", plain)).calibration.values()
    assert camera.named_parameters()["k1"] == 0


# Basalt


def test_basalt_poses_take_the_camera_to_the_imu(tmp_path: Path) -> None:
    """Quaternion order and direction: only the right ones leave the cameras side by side, 110 mm apart along x."""
    path = put(tmp_path / "calibration.json", json.dumps(BASALT))
    rotation, translation = rig_pair(path)
    assert abs(translation[0] + 0.110) < 1e-3 and np.abs(translation[1:]).max() < 2e-3
    frames = []
    for pose in BASALT["value0"]["T_imu_cam"]:
        frame = np.eye(4)
        frame[:3, :3] = Rotation.from_quat([pose[key] for key in ("qx", "qy", "qz", "qw")]).as_matrix()
        frame[:3, 3] = [pose[key] for key in ("px", "py", "pz")]
        frames.append(frame)
    wanted = np.linalg.inv(frames[1]) @ frames[0]
    np.testing.assert_allclose(rotation, wanted[:3, :3], atol=1e-12)
    np.testing.assert_allclose(translation, wanted[:3, 3], atol=1e-12)
    content = read(path)
    assert content.notes[0] == "Not kept of the file: calib_accel_bias."
    assert (
        "camera cam0 stands at (-0.0167748, -0.0689389, 0.00513912) m" in content.notes[1]
        and "that pose is not kept" in content.notes[1]
    )
    assert isinstance(content.calibration["cam0"], DoubleSphere) and isinstance(content.calibration["cam1"], ExtendedUnified)
    assert content.calibration["cam1"].named_parameters()["beta"] == 1.1323


def test_basalt_gets_every_key_that_it_reads(tmp_path: Path) -> None:
    """Its own reader (cereal) refuses a file in which one of them is absent."""
    model = Pinhole.examples()[1]
    write(tmp_path / "a.json", Calibration({"cam0": model}))
    value = json.loads((tmp_path / "a.json").read_text())["value0"]
    assert set(value) == {
        "T_imu_cam", "intrinsics", "resolution", "calib_accel_bias", "calib_gyro_bias", "imu_update_rate", "accel_noise_std",
        "gyro_noise_std", "accel_bias_std", "gyro_bias_std", "cam_time_offset_ns", "vignette",
    }  # fmt: skip
    assert [len(value[key]) for key in ("calib_accel_bias", "calib_gyro_bias", "accel_noise_std")] == [9, 12, 3]
    assert value["T_imu_cam"] == [{"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "px": 0.0, "py": 0.0, "pz": 0.0}]
    (camera,) = value["intrinsics"]
    assert camera["camera_type"] == "pinhole-radtan8"
    # At the radius rpmax of the plane z = 1 the projection folds back.
    radius = camera["intrinsics"]["rpmax"]
    if radius > 0:
        edge = [
            np.hypot(*(model.project(np.array([r, 0, 1.0]))[0] - model.centre_px.numpy()))
            for r in (0.99 * radius, 0.999 * radius)
        ]
        assert edge[1] > edge[0] and not model.project(np.array([1.001 * radius, 0, 1.0]))[1]


# mrcal


def test_mrcal_extrinsics_take_the_reference_to_the_camera(tmp_path: Path) -> None:
    left = """# generated with mrcal
    { 'lensmodel': 'LENSMODEL_OPENCV8',
      # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
      'intrinsics': [1766.0712405930, 1765.8925266865, 1944.0664501036, 1064.5231421210, 2.1648025156, -1.1851581377,
                     -0.0000931342, 0.0007782462, -0.2351910903, 2.4460295029, -0.6697132481, -0.6284355415],
      # extrinsics are rt_fromref
      'extrinsics': [0,0,0,0,0,0],
      'imagersize': [3840,2160]
    }
    """
    # An older file of mrcal's tests, with other keys.
    right = """{
    'distortion_model':  'DISTORTION_OPENCV8',
    'intrinsics': [ 1761, 1761, 1965, 1087, -0.02, 0.03, 0.0002, 0.0005, 0.0196, 0.01, -0.05, 0.04,],
    'extrinsics': [ 2e-1, 1e-1, -1e-2,  2., 2, -2.5, ],
    'imagersize': [ 4000, 2200 ],
    'optimization_inputs': b'P)h>@6aWAK2mk',
    }"""
    put(tmp_path / "left.cameramodel", left), put(tmp_path / "right.cameramodel", right)
    content = read(tmp_path)
    assert list(content.calibration) == ["left", "right"] and content.calibration["right"].image_size == (4000, 2200)
    assert content.notes == ("right.cameramodel: Not kept: optimization_inputs.",)
    rotation, translation = rig_pair(tmp_path)
    np.testing.assert_allclose(rotation, cv2.Rodrigues(np.array([0.2, 0.1, -0.01]))[0], atol=1e-12)
    np.testing.assert_allclose(translation, [2.0, 2.0, -2.5], atol=1e-12)
    matrix = np.array([[1766.0712405930, 0, 1944.0664501036], [0, 1765.8925266865, 1064.5231421210], [0, 0, 1]])
    coefficients = np.array(
        [2.1648025156, -1.1851581377, -0.0000931342, 0.0007782462, -0.2351910903, 2.4460295029, -0.6697132481, -0.6284355415]
    )
    near = RAYS[np.hypot(*RAYS[:, :2].T) < 0.6]
    expected = cv2.projectPoints(near, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(content.calibration["left"].project(near)[0], expected, atol=1e-9)
    alone = read(tmp_path / "right.cameramodel")
    assert not alone.calibration.rig and "that pose is not kept" in alone.notes[1]


def test_mrcal_stereographic_is_the_unified_model(tmp_path: Path) -> None:
    """q = f 2 tan(theta / 2) + c, also behind the camera."""
    text = "{'lensmodel': 'LENSMODEL_STEREOGRAPHIC', 'intrinsics': [300., 301., 500., 400.], 'imagersize': [1001, 801]}"
    (camera,) = read(put(tmp_path / "a.cameramodel", text)).calibration.values()
    assert isinstance(camera, Unified)
    theta, phi = np.radians([0.1, 30.0, 89.0, 120.0]), np.array([0.0, 1.0, 2.0, 4.0])
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    radius = 2 * np.tan(theta / 2)
    expected = np.stack([300 * radius * np.cos(phi) + 500, 301 * radius * np.sin(phi) + 400], -1)
    np.testing.assert_allclose(camera.project(rays)[0], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("LENSMODEL_OPENCV12", [0.0, 0.1], r"found 0.0, 0.1; convert it to LENSMODEL_OPENCV8"),
        ("LENSMODEL_CAHVOR", [], "found LENSMODEL_CAHVOR; convert it to one of these with mrcal"),
        ("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170", [], "found LENSMODEL_SPLINED"),
        ("LENSMODEL_OPENCV5", [], "must have 9 parameters, found 12"),
    ],
)
def test_mrcal_models_without_a_counterpart(tmp_path: Path, name: str, values: list[float], message: str) -> None:
    intrinsics = [1e3, 1e3, 5e2, 4e2, *[0.01] * 8, *values]
    text = str({"lensmodel": name, "intrinsics": intrinsics, "extrinsics": [0.0] * 6, "imagersize": [1001, 801]})
    with pytest.raises(InputError, match=message):
        read(put(tmp_path / "a.cameramodel", text))


def test_mrcal_without_thin_prism_terms(tmp_path: Path) -> None:
    text = str(
        {
            "lensmodel": "LENSMODEL_OPENCV12",
            "intrinsics": [1e3, 1e3, 5e2, 4e2, *[0.01] * 8, *[0.0] * 4],
            "extrinsics": [0.0] * 6,
            "imagersize": [1001, 801],
        }
    )
    (camera,) = read(put(tmp_path / "a.cameramodel", text)).calibration.values()
    assert camera.named_parameters()["k6"] == 0.01
    with pytest.raises(InputError, match="not a Python dict of plain values"):
        read(put(tmp_path / "b.cameramodel", "{'imagersize': __import__('os').getcwd(), 'intrinsics': 0}"))


# ROS


# COLMAP


# CamOdoCal

MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters:
   xi: 0.80065662
distortion_parameters:
   k1: -0.33518750
   k2: 0.13211436
   p1: 0.00055967
   p2: 0.00057686
projection_parameters:
   gamma1: 833.006
   gamma2: 830.345
   u0: 373.850
   v0: 253.749
"""
KANNALA_BRANDT = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: camera
image_width: 640
image_height: 512
projection_parameters:
   k2: -0.0612
   k3: -0.0037
   k4: 0.0273
   k5: -0.0302
   mu: 413.3
   mv: 413.7
   u0: 305.9
   v0: 259.4
mask: fisheye.png
"""


def test_camodocal_cameras_project_as_opencv_does(tmp_path: Path) -> None:
    near, zero = RAYS[np.hypot(*RAYS[:, :2].T) < 0.7], np.zeros(3)
    camera = read(put(tmp_path / "mei.yaml", MEI)).calibration["cam0"]
    matrix = np.array([[833.006, 0, 373.850], [0, 830.345, 253.749], [0, 0, 1]])
    coefficients = np.array([[-0.33518750, 0.13211436, 0.00055967, 0.00057686]])
    expected = cv2.omnidir.projectPoints(near[:, None], zero, zero, matrix, 0.80065662, coefficients)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(near)[0], expected, atol=1e-9)
    whole = put(tmp_path / "kb.yaml", KANNALA_BRANDT)
    content = read(whole)
    matrix = np.array([[413.3, 0, 305.9], [0, 413.7, 259.4], [0, 0, 1]])
    expected = cv2.fisheye.projectPoints(near[:, None], zero, zero, matrix, np.array([-0.0612, -0.0037, 0.0273, -0.0302]))[0]
    np.testing.assert_allclose(content.calibration["cam0"].project(near)[0], expected[:, 0], atol=1e-9)
    assert content.notes == ("Not kept of the file: mask.",)
    # Some write k2 to k5 as parameters of the distortion.
    moved = KANNALA_BRANDT.replace("projection_parameters:", "distortion_parameters:").replace(
        "   mu", "projection_parameters:\n   mu"
    )
    assert (
        read(put(tmp_path / "moved.yaml", moved)).calibration["cam0"].named_parameters()
        == content.calibration["cam0"].named_parameters()
    )


def test_camodocal_says_what_it_does_not_have(tmp_path: Path) -> None:
    for old, new, told in (
        ("MEI", "scaramuzza", "found scaramuzza"),
        ("   xi: 0.80065662", "   xj: 1.0", "The key xi is missing"),
        ("   u0: 373.850", "   u0: 373.850\n   k1: 0.1", "found k1 in two sections"),
        ("image_width: 752\n", "", "image_width and image_height"),
    ):
        with pytest.raises(InputError, match=told):
            read(put(tmp_path / "bad.yaml", MEI.replace(old, new)))
