"""Files that cv2.FileStorage writes, as OpenCV's samples do, on OpenCV's own functions."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from camera_models import Calibration, CameraEstimate, InputError, OpenCVFisheye, Pinhole, Unified
from camera_models.formats import format_of_file, read, write
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose

ZERO = np.zeros(3)
K = np.array([[600.0, 0.0, 320.5], [0.0, 605.0, 241.5], [0.0, 0.0, 1.0]])
BROWN = np.array([[-0.2, 0.05, 1e-3, -2e-3, 0.01]]).T
FISHEYE = np.array([[0.02, -0.004, 0.001, -0.0002]]).T
SKEW = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
RAYS = np.random.default_rng(0).normal(size=(100, 3)) * [0.3, 0.3, 0.0] + [0, 0, 1.0]


def put(path: Path, **values: Any) -> Path:
    """A file as the tool writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


def sample(**changed: Any) -> dict[str, Any]:
    """What the sample camera_calibration writes, in its order."""
    values = {
        "calibration_time": "Thu 01 Jan 2026", "nr_of_frames": 15, "image_width": 640, "image_height": 480, "board_width": 9,
        "board_height": 6, "square_size": 0.03, "flags": 0, "fisheye_model": 0, "camera_matrix": K,
        "distortion_coefficients": BROWN, "avg_reprojection_error": 0.31,
    }  # fmt: skip
    return {key: value for key, value in (values | changed).items() if value is not None}


def only(path: Path, **options: Any):
    (camera,) = read(path, **options).calibration.values()
    return camera


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json", ".yaml"])
def test_the_sample_of_opencv(suffix: str, tmp_path: Path) -> None:
    path = put(tmp_path / f"out_camera_data{suffix}", **sample())
    assert format_of_file(path).NAME == "opencv"
    content = read(path)
    camera = content.calibration["cam0"]
    assert isinstance(camera, Pinhole) and camera.image_size == (640, 480)
    assert content.calibration.estimates["cam0"].rms_px_per_point == 0.31
    assert content.notes == ("Not kept: calibration_time, nr_of_frames, board_width, board_height, square_size, flags.",)
    expected = cv2.projectPoints(RAYS, ZERO, ZERO, K, BROWN)[0][:, 0]
    np.testing.assert_allclose(camera.project(RAYS)[0], expected, atol=1e-9)


@pytest.mark.parametrize("size", [4, 5, 8, 12, 14])
def test_any_length_of_the_distortion(size: int, tmp_path: Path) -> None:
    full = np.zeros((size, 1))
    full[: min(size, 8), 0] = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.003, 0.0004][: min(size, 8)]
    camera = only(put(tmp_path / "a.yml", **sample(distortion_coefficients=full)))
    expected = cv2.projectPoints(RAYS, ZERO, ZERO, K, full)[0][:, 0]
    np.testing.assert_allclose(camera.project(RAYS)[0], expected, atol=1e-9)
    if size > 8:
        full[8] = 1e-3
        with pytest.raises(InputError, match=r"must have 8 coefficients, found 0.001, .* beyond"):
            read(put(tmp_path / "b.yml", **sample(distortion_coefficients=full)))


def test_what_tells_a_fisheye(tmp_path: Path) -> None:
    """The marker of the sample; four coefficients alone may be either and are refused."""
    camera = only(put(tmp_path / "a.yml", **sample(fisheye_model=1, distortion_coefficients=FISHEYE)))
    assert isinstance(camera, OpenCVFisheye)
    expected = cv2.fisheye.projectPoints(RAYS[:, None], ZERO, ZERO, K, FISHEYE)[0][:, 0]
    np.testing.assert_allclose(camera.project(RAYS)[0], expected, atol=1e-9)
    assert isinstance(only(put(tmp_path / "b.yml", **sample(fisheye_model=0, distortion_coefficients=FISHEYE))), Pinhole)
    with pytest.raises(InputError, match=r"add fisheye_model: 1 for cv2.fisheye or fisheye_model: 0 for Brown-Conrady"):
        read(put(tmp_path / "c.yml", **sample(fisheye_model=None, distortion_coefficients=FISHEYE)))
    assert isinstance(only(put(tmp_path / "d.yml", **sample(fisheye_model=None))), Pinhole)
    short = put(tmp_path / "e.yml", K=K, D=FISHEYE, fisheye_model=1, image_width=640, image_height=480)
    assert only(short).parameters.tolist() == camera.parameters.tolist()


def test_omnidir_with_its_skew(tmp_path: Path) -> None:
    matrix, d = K + 1.5 * SKEW, np.array([[-0.1, 0.02, 1e-3, -2e-3]])
    path = put(tmp_path / "out.xml", image_width=640, image_height=480, camera_matrix=matrix, distortion_coefficients=d, xi=1.3)
    camera = only(path)
    assert isinstance(camera, Unified)
    expected = cv2.omnidir.projectPoints(RAYS[:, None], ZERO, ZERO, matrix, 1.3, d)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(RAYS)[0], expected, atol=1e-9)
    for name in ("row.yml", "row.xml", "row.json"):
        again = put(tmp_path / name, image_width=640, image_height=480, K=matrix, D=d, xi=np.array([[1.3]]))
        assert only(again).parameters.tolist() == camera.parameters.tolist()


def test_the_skew_that_opencv_does_not_use(tmp_path: Path) -> None:
    content = read(put(tmp_path / "a.yml", **sample(camera_matrix=K + 2.5 * SKEW)))
    assert content.calibration["cam0"].named_parameters()["skew"] == 0.0
    assert content.notes[0] == "The skew of 2.5 px in the camera matrix of the camera is not kept: OpenCV takes it for zero."
    expected = cv2.projectPoints(RAYS, ZERO, ZERO, K + 2.5 * SKEW, BROWN)[0][:, 0]
    np.testing.assert_allclose(content.calibration["cam0"].project(RAYS)[0], expected, atol=1e-9)


def test_the_size_may_be_given(tmp_path: Path) -> None:
    path = put(tmp_path / "a.yml", camera_matrix=K, distortion_coefficients=BROWN)
    with pytest.raises(InputError, match=r"a.yml: The file was expected to hold the size of the image, .* give `image_size`"):
        read(path)
    assert only(path, image_size=(640, 480)).image_size == (640, 480)
    path.write_text(path.read_text() + "image_size: [ 320, 240 ]\n")
    assert only(path).image_size == (320, 240)


def test_the_stereo_sample_has_two_files(tmp_path: Path) -> None:
    """R and T take points of the first camera to the second, as cv2.stereoCalibrate says: X2 = R X1 + T."""
    turn, shift = cv2.Rodrigues(np.array([0.02, -0.1, 0.03]))[0], np.array([[-0.2, 0.01, 0.005]]).T
    put(tmp_path / "intrinsics.yml", M1=K, D1=BROWN, M2=K + np.diag([5.0, 6.0, 0]), D2=BROWN * 0.5)
    put(tmp_path / "extrinsics.yml", R=turn, T=shift, R1=np.eye(3), P1=np.zeros((3, 4)))
    content = read(tmp_path / "intrinsics.yml", image_size=(640, 480))
    pose = content.calibration.rig["cam1"].cam_from_rig
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(pose.translation, shift[:, 0], atol=1e-15)
    expected = cv2.projectPoints(RAYS * 3, cv2.Rodrigues(turn)[0], shift, K + np.diag([5.0, 6.0, 0]), BROWN * 0.5)[0][:, 0]
    second = content.calibration["cam1"].project(pose.transform(torch.as_tensor(RAYS * 3)).numpy())[0]
    np.testing.assert_allclose(second, expected, atol=1e-9)
    (tmp_path / "extrinsics.yml").unlink()
    assert not read(tmp_path / "intrinsics.yml", image_size=(640, 480)).calibration.rig


def test_the_omnidirectional_pair(tmp_path: Path) -> None:
    """The sample omni_stereo_calibration: rvec and tvec; here on cv2.omnidir.projectPoints with that very pose."""
    rvec, tvec, d = np.array([0.02, -0.1, 0.03]), np.array([-0.2, 0.01, 0.005]), np.array([[-0.1, 0.02, 1e-3, -2e-3]])
    both = {
        "camera_matrix_1": K,
        "distortion_coefficients_1": d,
        "xi_1": 1.1,
        "camera_matrix_2": K,
        "distortion_coefficients_2": d,
        "xi_2": 1.3,
    }
    path = put(tmp_path / "pair.xml", **both, rvec=rvec, tvec=tvec, image_width=640, image_height=480)
    calibration = read(path).calibration
    pose = calibration.rig["cam1"].cam_from_rig
    expected = cv2.omnidir.projectPoints(3 * RAYS[:, None], rvec, tvec, K, 1.3, d)[0].reshape(-1, 2)
    seen = calibration["cam1"].project(pose.transform(torch.as_tensor(3 * RAYS)).numpy())[0]
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_what_is_written_is_read_by_opencv(tmp_path: Path) -> None:
    """Straight into OpenCV's functions, types and shapes as it wants them."""
    size = (1280, 960)
    models = [Pinhole.examples()[0], OpenCVFisheye.examples()[0], Unified.examples()[1]]
    for model in models:
        path = tmp_path / f"{model.NAME}.yml"
        write(path, Calibration({"cam0": model}, {"cam0": CameraEstimate(rms_px_per_point=0.25)}))
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        matrix, d = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
        assert (int(storage.getNode("image_width").real()), int(storage.getNode("image_height").real())) == size
        assert storage.getNode("avg_reprojection_error").real() == 0.25
        if isinstance(model, Pinhole):
            expected = cv2.projectPoints(RAYS, ZERO, ZERO, matrix, d)[0]
        elif isinstance(model, OpenCVFisheye):
            assert storage.getNode("fisheye_model").real() == 1
            expected = cv2.fisheye.projectPoints(RAYS[:, None], ZERO, ZERO, matrix, d)[0]
        else:
            expected = cv2.omnidir.projectPoints(RAYS[:, None], ZERO, ZERO, matrix, storage.getNode("xi").real(), d)[0]
        np.testing.assert_allclose(model.project(RAYS)[0], expected.reshape(-1, 2), atol=1e-8)
    pose = Pose.exp(torch.tensor([0.1, 0.2, -0.1, 0.3, -0.2, 0.1], dtype=torch.float64))
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(pose)}
    write(tmp_path / "pair.yml", Calibration({"left": models[0], "right": models[0]}, rig=rig))
    storage = cv2.FileStorage(str(tmp_path / "pair.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("R").mat(), pose.rotation)
    np.testing.assert_array_equal(storage.getNode("T").mat()[:, 0], pose.translation)
    # cv2.stereoRectify takes them as they are.
    m1, d1, m2, d2, r, t = (storage.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T"))
    assert cv2.stereoRectify(m1, d1, m2, d2, size, r, t)[0].shape == (3, 3)


def multiview() -> tuple[dict[str, Any], list[np.ndarray], list[np.ndarray]]:
    """What cv2.calibrateMultiview finds of three cameras on a board, saved as the app multiview_calibration saves it."""
    rng = np.random.default_rng(0)
    board = np.zeros((40, 3), np.float32)
    board[:, :2] = np.mgrid[0:8, 0:5].T.reshape(-1, 2) * 0.05
    distortions, kinds = [BROWN * 0.5, FISHEYE, BROWN], [0, 1, 0]
    rvecs = [ZERO, np.array([0.0, 0.1, 0.02]), np.array([0.05, -0.1, 0.0])]
    tvecs = [ZERO, np.array([-0.1, 0.0, 0.01]), np.array([0.1, 0.02, 0.0])]
    points: list[list[np.ndarray]] = [[], [], []]
    for _ in range(8):
        turn, at = rng.uniform(-0.4, 0.4, 3), rng.uniform([-0.3, -0.2, 0.7], [-0.1, 0.0, 0.9])
        placed = (board @ cv2.Rodrigues(turn)[0].T + at)[:, None]
        for camera in range(3):
            project = cv2.fisheye.projectPoints if kinds[camera] else cv2.projectPoints
            seen = project(placed, rvecs[camera], tvecs[camera], K, distortions[camera])[0]
            points[camera].append(seen.reshape(-1, 2).astype(np.float32))
    flags = np.array([cv2.CALIB_RECOMPUTE_EXTRINSIC + cv2.CALIB_FIX_SKEW if kind else 0 for kind in kinds], dtype=int)
    rms, matrices, found, rotations, translations = cv2.calibrateMultiview(
        [board] * 8, points, [(640, 480)] * 3, np.ones((3, 8), np.uint8), np.array(kinds, np.uint8),
        [K.copy() for _ in kinds], [d.copy() for d in distortions], None, None, flagsForIntrinsics=flags,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    assert rms < 1e-3
    saved = {
        "Rs": np.array(rotations), "distortions": np.concatenate([d.reshape(-1) for d in found]), "Ks": np.array(matrices),
        "Ts": np.array(translations), "models": np.array(kinds, dtype=int), "image_sizes": np.array([(640, 480)] * 3),
        "cam_ids": ["left", "middle", "right"],
    }  # fmt: skip
    return saved, rvecs, tvecs


def test_the_rig_of_calibrate_multiview(tmp_path: Path) -> None:
    saved, rvecs, tvecs = multiview()
    calibration = read(put(tmp_path / "rig.yaml", **saved)).calibration
    assert [type(model) for model in calibration.values()] == [Pinhole, OpenCVFisheye, Pinhole]
    assert list(calibration) == ["left", "middle", "right"]
    for item, rvec, tvec in zip(calibration.rig.values(), rvecs, tvecs, strict=True):
        np.testing.assert_allclose(item.cam_from_rig.rotation, cv2.Rodrigues(rvec)[0], atol=1e-6)
        np.testing.assert_allclose(item.cam_from_rig.translation, tvec, atol=1e-6)
    np.testing.assert_allclose(list(calibration["right"].named_parameters().values())[5:10], BROWN[:, 0], atol=1e-4)
    # Rotations as matrices, as earlier versions of the app saved them.
    matrices = put(tmp_path / "m.yaml", **saved | {"Rs": np.array([cv2.Rodrigues(r)[0] for r in saved["Rs"]])})
    again = read(matrices).calibration.rig["right"].cam_from_rig
    assert (again.rotation - calibration.rig["right"].cam_from_rig.rotation).abs().max() < 1e-12
    for key, value, message in (
        ("models", np.array([0, 1]), "models must be a matrix of 3 numbers, found one of 2"),
        ("distortions", np.zeros(15), "as many coefficients for each pinhole camera, found 15"),
        ("cam_ids", ["a", "a", "b"], "cam_ids must be 3 different names, found 2"),
        ("cam_ids", ["a", "null", "b"], "Each of cam_ids must be a name, found none of camera 1"),
    ):
        with pytest.raises(InputError, match=message):
            read(put(tmp_path / "bad.yaml", **saved | {key: value}))


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("name", ["true", "null", "yes", "12", "1e5", "~", "a b", "x: y", "it's", "#1", '"q"', "end ", "é"])
def test_a_camera_of_any_name_comes_back_or_is_refused(name: str, suffix: str, tmp_path: Path) -> None:
    names = [name, "left", "right"]
    rig = {one: RigCamera(Pose.exp(torch.full((6,), 0.1 * index, dtype=torch.float64))) for index, one in enumerate(names)}
    path, calibration = tmp_path / f"rig{suffix}", Calibration(dict.fromkeys(names, Pinhole.examples()[0]), rig=rig)
    refused = name == '"q"' or (suffix == ".yml" and name in ("true", "null", "end "))
    if refused:
        with pytest.raises(InputError, match="Texts that OpenCV reads as it writes them were expected in cam_ids, found "):
            write(path, calibration, "opencv")
        assert not path.exists()
    else:
        write(path, calibration, "opencv")
        assert list(read(path).calibration) == names


def test_more_than_two_omnidirectional_cameras(tmp_path: Path) -> None:
    model = Unified.examples()[0]
    names = ["a", "b", "c"]
    rig = {name: RigCamera(Pose.exp(torch.full((6,), 0.1 * index, dtype=torch.float64))) for index, name in enumerate(names)}
    with pytest.raises(
        InputError, match="of more than two cameras hold pinhole and fisheye cameras, found a of the model unified"
    ):
        write(tmp_path / "rig.yml", Calibration(dict.fromkeys(names, model), rig=rig))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("cut", ["   cols: 3\n", "   data: [ 600., 0., 320.5, 0., 605., 241.5, 0., 0., 1. ]\n", "   dt: d\n"])
def test_matrices_that_opencv_would_take_on_trust(cut: str, tmp_path: Path) -> None:
    """Its own reader writes beyond the end of the matrix where a side is absent or does not fit the data."""
    path = put(tmp_path / "a.yml", **sample())
    text = path.read_text()
    assert cut in text
    path.write_text(text.replace(cut, "", 1))
    with pytest.raises(InputError, match=r"The matrix camera_matrix must (have|hold)|must be a matrix"):
        read(path)
    path.write_text(text.replace("rows: 3", "rows: 7", 1))
    with pytest.raises(InputError, match="The matrix camera_matrix must hold 7 x 3 x 1 numbers, found 9"):
        read(path)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"camera_matrix": np.eye(2)}, "camera_matrix of the camera must be a matrix of 9 numbers, found one of 4"),
        ({"camera_matrix": None}, "camera_matrix of the camera must be a matrix of 9 numbers, found none"),
        ({"distortion_coefficients": "five"}, "must be a matrix, found 'five'"),
        ({"image_width": 640.5}, "must be two whole numbers of pixels, found 640.5, 480"),
        ({"camera_matrix": K * np.nan}, "must hold finite numbers"),
    ],
)
def test_wrong_values(changed: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(put(tmp_path / "a.yml", **sample(**changed)), "opencv")
