"""OCamCalib: its published fits on their corners, its rig on other people's code, and its own functions on what is written."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from camera_models import Calibration, InputError, Scaramuzza
from camera_models.formats import format_named, format_of_file, read, write
from camera_models.formats.calibration_data import CameraEstimate
from camera_models.formats.transfer import transfer
from camera_models.formats.turn import turn_rad, turned
from camera_models.pose import Pose
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.views import board_points
from omnilines.files import read_corners

# A file that its export writes, as its users show it.
KODAK = """#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world

5 -2.716972e+02 0.000000e+00 -2.741744e-06 1.840940e-06 -8.024838e-10 

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

13 583.439624 470.805865 97.165132 120.712689 100.686168 55.067847 67.348203 15.186683 1.492255 84.459767 105.607698 48.090642 7.785426 

#center: "row" and "column", starting from 0 (C convention)

728.648728 729.090632

#affine parameters "c", "d", "e"

1.001407 -0.000818 0.000221

#image size: "height" and "width"

1440 1440

"""  # noqa: E501


def put(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def world2cam(text: str, points: np.ndarray) -> np.ndarray:
    """Pixels (u, v) of points in OCamCalib's frame by its own recipe: inverse polynomial and affine matrix, rows first."""
    rows = [[float(item) for item in line.split()] for line in text.splitlines() if line.strip() and line[0] != "#"]
    inverse, (row0, column0), (c, d, e) = rows[1][1:], rows[2], rows[3]
    norm = np.hypot(points[:, 0], points[:, 1])
    rho = np.polynomial.polynomial.polyval(np.arctan(points[:, 2] / norm), np.array(inverse))
    x, y = points[:, 0] / norm * rho, points[:, 1] / norm * rho
    return np.stack([x * e + y + column0, x * c + y * d + row0], -1)


def cam2world(text: str, pixels: np.ndarray) -> np.ndarray:
    """Bearings of pixels (u, v) in OCamCalib's frame: x along the rows, y along the columns, z from the direct polynomial."""
    rows = [[float(item) for item in line.split()] for line in text.splitlines() if line.strip() and line[0] != "#"]
    direct, (row0, column0), (c, d, e) = rows[0][1:], rows[2], rows[3]
    x, y = np.linalg.inv([[c, d], [e, 1]]) @ (pixels[:, ::-1] - [row0, column0]).T
    ray = np.stack([x, y, np.polynomial.polynomial.polyval(np.hypot(x, y), np.array(direct))], -1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def ours_from_theirs(points: np.ndarray) -> np.ndarray:
    """Rows run down and columns to the right; its z points towards the camera. A rotation: no mirror image."""
    turn = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.linalg.det(turn) == pytest.approx(1.0)
    return points @ turn.T


def pixels_of(size: tuple[int, int], count: int = 500) -> np.ndarray:
    return np.random.default_rng(0).uniform([0, 0], size, (count, 2))


def test_a_file_of_the_tool_means_what_its_functions_say(tmp_path: Path) -> None:
    path = put(tmp_path / "calib_results_kodak.txt", KODAK)
    assert format_of_file(path).NAME == "ocamcalib"
    content = read(path)
    (camera,) = content.calibration.values()
    # Row before column: cx is the column.
    assert camera.named_parameters()["cx"] == 729.090632 and camera.named_parameters()["cy"] == 728.648728
    assert camera.named_parameters()["a0"] == 271.6972 and camera.image_size == (1440, 1440)
    pixels = pixels_of((1440, 1440))
    expected = ours_from_theirs(cam2world(KODAK, pixels))
    # f - rho f' > 0: as far as the angle grows with the radius.
    near = np.hypot(*(pixels - [729, 728]).T) < 0.99 * camera.max_radius_px
    assert near.mean() > 0.5
    np.testing.assert_allclose(camera.unproject(pixels)[0][near], expected[near], atol=1e-12)


def test_row_and_column_are_not_exchanged(tmp_path: Path) -> None:
    text = (
        KODAK.replace("728.648728 729.090632", "500.25 900.75")
        .replace("1440 1440", "1000 1800")
        .replace("-0.000818 0.000221", "0.02 -0.01")
    )
    (camera,) = read(put(tmp_path / "calib_results.txt", text)).calibration.values()
    assert camera.image_size == (1800, 1000) and camera.centre_px.tolist() == [900.75, 500.25]
    pixels = np.array([900.75, 500.25]) + np.random.default_rng(1).uniform(-300, 300, (100, 2))
    np.testing.assert_allclose(camera.unproject(pixels)[0], ours_from_theirs(cam2world(text, pixels)), atol=1e-12)


@pytest.mark.parametrize("index", range(5))
def test_what_is_written_works_in_the_functions_of_the_tool(index: int, tmp_path: Path) -> None:
    """Bearings are ours to rounding, pixels to the accuracy of the inverse polynomial."""
    model = Scaramuzza.examples()[index]
    (path,) = write(tmp_path / "calib_results.txt", Calibration({"cam0": model}))
    text = path.read_text()
    pixels = pixels_of(model.image_size)
    bearings, valid = model.unproject(pixels)
    assert valid.mean() > 0.9
    np.testing.assert_allclose(ours_from_theirs(cam2world(text, pixels))[valid], bearings[valid], atol=1e-12)
    theirs = bearings @ np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.abs(world2cam(text, theirs) - pixels)[valid].max() < 0.02
    lens = model.named_parameters()["a0"] > 0
    first = float(text.splitlines()[2].split()[1])
    assert (first < 0) is lens


def poses_of(corners, size):
    result = calibrate_camera(corners, size, "scaramuzza", loss="none")
    return Pose.stack([view.cam_from_board for view in result.views])


def rms_px_per_axis(camera, points, start) -> float:
    """Of the corners, with the camera as it is and the best pose of every board."""
    problem = BoardProblem(points, torch.zeros(len(camera.parameters), 0, dtype=torch.float64))
    solution = problem.solve(CameraAndBoards(camera, start))
    return math.sqrt(float((solution.state.residual_px(points) ** 2).mean()))


def calib_results(entry: dict, size: tuple[int, int], first: int = 1, **changed: float) -> str:
    """A published entry as the tool would export it: rows first, counted from 0."""
    # In this entry the row and the column of the centre have each other's label.
    centre = {"row": entry["centre_col_1based"], "column": entry["centre_row_1based"]}
    values = centre | {key: entry[key] for key in "cde"} | changed
    rows = [[len(entry["ss"]), *entry["ss"]], [1, 0.0]]
    rows += [[values["row"] - first, values["column"] - first], [values[key] for key in "cde"], [size[1], size[0]]]
    return "\n".join("# as published\n" + " ".join(map(str, row)) for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye1", "gopro", "kaidan"])
def test_published_parameters_give_the_published_rms(shared_data: Path, name: str, tmp_path: Path) -> None:
    """`urban_subpix` was fitted to these very corners. Any usual mistake with its centre or its axes shows in the RMS."""
    folder = shared_data / "calibration" / name
    reference = json.loads((folder / "reference.json").read_text())
    entry, size = reference["published"]["urban_subpix"], tuple(reference["image_size"])
    corners = read_corners(folder / "corners.csv")
    points = board_points(corners, np.ones(len(corners), bool), list(range(len(corners.view_names))))
    start = poses_of(corners, size)

    def rms(**changed: float) -> float:
        content = read(put(tmp_path / "calib_results.txt", calib_results(entry, size, **changed)))
        (camera,) = content.calibration.values()
        return rms_px_per_axis(camera, points, start)

    right = rms()
    assert abs(right - entry["rms_px_per_axis"]) < 2e-6
    # Counted from 1 as in MATLAB; c on the columns in place of the rows; d and e turned the other way; as labelled.
    assert rms(first=0) > right + 5e-4
    assert rms(c=1 / entry["c"]) > right + 0.004
    assert rms(d=-entry["d"], e=-entry["e"]) > right + 0.01
    assert rms(row=entry["centre_row_1based"], column=entry["centre_col_1based"]) > 3 * right


def omnimvs(shared_data: Path, name: str) -> Path:
    return shared_data / "rigs" / "omnimvs" / name / "config.yaml"


@pytest.mark.parametrize("name", ["sunny_single", "itbt_sample"])
def test_the_rig_of_other_people(shared_data: Path, name: str, tmp_path: Path) -> None:
    """Four lenses that look outwards: with the pose the other way round they would look inwards, or stand elsewhere."""
    path = omnimvs(shared_data, name)
    assert format_of_file(path).NAME == "ocamcalib"
    content = read(path)
    data = yaml.safe_load(path.read_text())["cameras"]
    assert list(content.calibration) == [camera["img_dir"] for camera in data] and len(data) == 4
    own = [np.eye(4) for _ in data]
    for frame, camera in zip(own, data, strict=True):
        frame[:3, :3], frame[:3, 3] = cv2.Rodrigues(np.array(camera["pose"][:3], float))[0], camera["pose"][3:]
    middle = np.mean([frame[:3, 3] for frame in own], 0)
    for frame, camera, (key, model) in zip(own, data, content.calibration.items(), strict=True):
        pose = content.calibration.rig[key].cam_from_rig
        wanted = np.linalg.inv(frame) @ own[0]
        np.testing.assert_allclose(pose.rotation, wanted[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose.translation, wanted[:3, 3], atol=1e-12)
        outwards = (frame[:3, 3] - middle) / np.linalg.norm(frame[:3, 3] - middle)
        assert outwards @ frame[:3, 2] > 0.65
        assert model.image_size == tuple(camera["image_size"][::-1]) and model.centre_px.tolist() == camera["center"][::-1]
        assert content.calibration.estimates[key].max_angle_deg == 110
    write(tmp_path / "rig.yaml", content.calibration, "ocamcalib")
    again = read(tmp_path / "rig.yaml")
    assert again.notes == ()
    for key, item in content.calibration.rig.items():
        assert (again.calibration.rig[key].cam_from_rig.rotation - item.cam_from_rig.rotation).abs().max() < 1e-12
        assert again.calibration[key].parameters.tolist() == content.calibration[key].parameters.tolist()


def test_the_inverse_polynomial_of_other_people(shared_data: Path) -> None:
    """Where the published inverse agrees with the published direct polynomial, so do our pixels; where not, a note says so."""
    data = yaml.safe_load(omnimvs(shared_data, "sunny_single").read_text())["cameras"]
    calibration = read(omnimvs(shared_data, "sunny_single")).calibration
    checked = 0
    for camera, model in zip(data, calibration.values(), strict=True):
        text = "\n".join(" ".join(map(str, camera[key])) for key in ("poly", "inv_poly", "center", "affine", "image_size"))
        theta, phi = np.radians(np.linspace(1, 105, 40)), np.linspace(0, 6, 40)
        rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        theirs = rays @ np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
        assert np.abs(world2cam(text, theirs) - model.project(rays)[0]).max() < 0.02
        checked += 1
    assert checked == 4
    notes = read(omnimvs(shared_data, "itbt_sample")).notes
    assert sum("inverse polynomial" in note and "The direct one is used" in note for note in notes) == 4
    assert not any("inverse polynomial" in note for note in read(omnimvs(shared_data, "sunny_single")).notes)


def test_the_inverse_of_a_mirror_is_that_of_what_it_shows(tmp_path: Path) -> None:
    """`kaidan`: no corner lies within 54 degrees of the axis, where the polynomial goes where it will."""
    numbers = [324.564, 247.514, 1.0, 0.0, 0.0, -187.2104, 0.28560068113208387, -0.009900158703507292, 0.00015656436164915327]
    numbers += [-1.365550378673913e-06, 6.808142825655262e-09, -1.8229382670680645e-11, 2.0390170222761136e-14]
    mirror = Scaramuzza(numbers, (640, 480))
    estimate = CameraEstimate(min_angle_deg=54.16, max_angle_deg=120.5)
    path = tmp_path / "calib_results.txt"
    fit = transfer(Calibration({"cam0": mirror}, {"cam0": estimate}), format_named("ocamcalib"), path)
    assert fit.nearly["cam0"].off_px < 1e-3 and fit.nearly["cam0"].angles_deg == (54.16, 120.5)
    assert "its inverse polynomial, 0.00072 px off at most from 54 to 120 degrees off axis" in fit.notes[-1]
    write(path, fit.calibration, "ocamcalib")
    theta, phi = np.radians(np.linspace(55, 120, 40)), np.linspace(0, 6, 40)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], -1)
    theirs = rays @ np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.abs(world2cam(path.read_text(), theirs) - mirror.project(rays)[0]).max() < 2e-3
    (note,) = read(path).notes
    assert "(they agree from 41 to 127 degrees off axis only)" in note
    unknown = transfer(Calibration({"cam0": mirror}), format_named("ocamcalib"), path)
    assert unknown.nearly["cam0"].off_px > 10 and unknown.notes[-1].endswith("px off at most over the image.")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("5 -2.716972e+02", "6 -2.716972e+02", r"Line 3 must hold 6 numbers .*found 5"),
        ("0.000000e+00", "1.0", "The coefficient of rho of the camera must be 0, found 1"),
        ("728.648728 729.090632", "728.648728", r"Line 11 must hold 2 numbers .*found 1"),
        ("1440 1440", "1440.5 1440", "must be whole numbers of pixels"),
        ("1.001407", "one", "Line 15 must hold numbers"),
        ("1440 1440", "", "Five lines of numbers were expected"),
        ("1.001407", "inf", "must be a finite number"),
    ],
)
def test_malformed_files_name_the_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(put(tmp_path / "calib_results.txt", KODAK.replace(old, new)), "ocamcalib")


def test_several_cameras_want_a_rig_or_a_folder(tmp_path: Path) -> None:
    model = Scaramuzza.examples()[0]
    with pytest.raises(InputError, match=r"to be a .yaml for a rig, or a folder"):
        write(tmp_path / "calib_results.txt", Calibration({"a": model, "b": model}))


def test_a_turned_camera_sees_the_same(tmp_path: Path) -> None:
    """Pixels stay, bearings turn about the axis; the affine matrix becomes symmetric."""
    for model in (Scaramuzza.examples()[1], Scaramuzza([320.0, 240.0, 0.98, -0.11, 0.14, -130.0, 2e-3, 1e-6], (640, 480))):
        straight, pose = turned(model)
        values = straight.named_parameters()
        assert values["d"] == values["e"] and abs(turn_rad(straight)) < 1e-15
        pixels = pixels_of(model.image_size)
        bearings, valid = model.unproject(pixels)
        again, seen = straight.unproject(pixels)
        assert (valid == seen).all() and valid.any()
        np.testing.assert_allclose(again[valid], (bearings @ pose.rotation.numpy().T)[valid], atol=1e-12)
