"""Files of NVIDIA's FTheta, Project Aria, OpenMVG and USD: the equations of their documents, beside what is read."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.polynomial.polynomial import polyval

from camera_models import Calibration, Equirectangular, Fisheye624, InputError, OpenCVFisheye, Pinhole, Scaramuzza, convert
from camera_models.formats import read, write
from camera_models.formats.calibration_data import CameraEstimate, RigCamera
from camera_models.pose import Pose
from omnilines.pipelines.convert import convert as converted

WIDTH, HEIGHT = 1280, 960
WIDE = np.linspace(0.01, math.radians(105), 60)
AROUND = np.linspace(0, 2 * math.pi, 60, endpoint=False)
RAYS = np.stack([np.sin(WIDE) * np.cos(AROUND), np.sin(WIDE) * np.sin(AROUND), np.cos(WIDE)], -1)
"""All round, up to 105 degrees off axis."""


def ftheta(tmp_path: Path, **keys: object) -> Path:
    path = tmp_path / "ftheta.json"
    whole = {
        "resolution": [WIDTH, HEIGHT],
        "shutter_type": "GLOBAL",
        "external_distortion_parameters": None,
        "principal_point": [641.3, 477.2],
        "reference_poly": "ANGLE_TO_PIXELDIST",
        "pixeldist_to_angle_poly": [0.0, 0.003, 0.0, 0.0, 0.0, 0.0],
        "angle_to_pixeldist_poly": [0.0, 330.0, 0.0, -9.0, 0.0, 1.5],
        "max_angle": math.radians(110),
        "linear_cde": [1.0, 0.0, 0.0],
    }
    path.write_text(json.dumps(whole | keys))
    return path


def seen(delta: np.ndarray, cde: tuple[float, float, float]) -> np.ndarray:
    """The equation of the model: pixels with the centre of the first at (0, 0)."""
    c, d, e = cde
    plane = delta[:, None] * RAYS[:, :2] / np.hypot(RAYS[:, 0], RAYS[:, 1])[:, None]
    return plane @ np.array([[c, d], [e, 1.0]]).T + [641.3, 477.2]


def test_ftheta_of_odd_powers_is_read_exactly_beyond_180_degrees(tmp_path: Path) -> None:
    content = read(ftheta(tmp_path, linear_cde=[1.003, 0.0, 0.0]))
    camera = content.calibration["cam0"]
    assert isinstance(camera, OpenCVFisheye) and content.notes == ()
    pixels, valid = camera.project(RAYS)
    assert valid.all()
    np.testing.assert_allclose(pixels, seen(polyval(WIDE, [0.0, 330.0, 0.0, -9.0, 0.0, 1.5]), (1.003, 0.0, 0.0)), atol=1e-9)
    assert content.calibration.estimates["cam0"].max_angle_deg == pytest.approx(110)


@pytest.mark.parametrize("reference", ["ANGLE_TO_PIXELDIST", "PIXELDIST_TO_ANGLE"])
def test_any_ftheta_is_read_as_near_as_is_said(reference: str, tmp_path: Path) -> None:
    cde = (0.998, 2e-4, -1e-4)
    forward = [0.0, 330.0, 6.0, -14.0, 1.2, 1.5]
    backward = [0.0, 3.03e-3, -4e-8, 1.1e-10, 3e-14, -2e-17]
    path = ftheta(
        tmp_path, reference_poly=reference, angle_to_pixeldist_poly=forward, pixeldist_to_angle_poly=backward, linear_cde=cde
    )
    content = read(path)
    camera = content.calibration["cam0"]
    assert isinstance(camera, Scaramuzza)
    (note,) = content.notes
    assert "the scaramuzza polynomial of degree" in note and "within" in note
    said_px = float(note.rpartition("within ")[2].removesuffix(" px."))
    assert said_px < 0.01
    delta = polyval(WIDE, forward)
    if reference == "PIXELDIST_TO_ANGLE":
        grid = np.linspace(0, 900, 200_001)
        delta = np.interp(WIDE, polyval(grid, backward), grid)
    wanted = seen(delta, cde)
    # As far as the image reaches.
    use = (wanted >= 0).all(1) & (wanted <= [WIDTH - 1, HEIGHT - 1]).all(1)
    assert use.sum() > 30
    np.testing.assert_allclose(camera.project(RAYS[use])[0], wanted[use], atol=2 * said_px + 1e-5)


def test_ftheta_is_written_with_a_polynomial_that_inverts(tmp_path: Path) -> None:
    wide = Scaramuzza.examples()[1]
    fitted = convert(wide, "opencv-fisheye", 215, {"k3": 0.0, "k4": 0.0})
    assert fitted.rms_px < 1.5
    write(tmp_path / "ftheta.json", Calibration({"cam0": fitted.model}))
    keys = json.loads((tmp_path / "ftheta.json").read_text())
    assert keys["reference_poly"] == "ANGLE_TO_PIXELDIST" and keys["max_angle"] > math.radians(100)
    theta = np.linspace(0, keys["max_angle"], 100)
    delta = polyval(theta, keys["angle_to_pixeldist_poly"])
    found = polyval(delta, keys["pixeldist_to_angle_poly"])
    assert np.abs(found - theta).max() < 0.1
    # gsplat and 3DGRUT take three steps of Newton from there.
    forward = np.array(keys["angle_to_pixeldist_poly"])
    for _ in range(3):
        found = found - (polyval(found, forward) - delta) / polyval(found, forward[1:] * np.arange(1, 6))
    assert np.abs(found - theta).max() < 1e-5


def test_the_error_of_the_second_ftheta_polynomial_is_stated(tmp_path: Path) -> None:
    path = tmp_path / "ftheta.json"
    given = OpenCVFisheye([300.0, 300.0, 639.5, 639.5, 0.3, -0.05, 0.0, 0.0], (1280, 1280))
    calibration = Calibration({"cam0": given}, {"cam0": CameraEstimate(max_angle_deg=100.0)})
    result = converted(calibration, path)
    result.save()
    keys = json.loads(path.read_text())
    theta = np.linspace(0, math.radians(100), 5000)
    delta = polyval(theta, keys["angle_to_pixeldist_poly"])
    off = polyval(polyval(delta, keys["pixeldist_to_angle_poly"]), keys["angle_to_pixeldist_poly"]) - delta
    (note,) = result.notes
    said_px = float(note.partition(" px off at most up to 100 degrees")[0].rpartition(" ")[2])
    assert said_px > 1 and said_px == pytest.approx(np.abs(off).max(), rel=0.05)
    # What the file says is exact all the same.
    assert not result.errors and torch.equal(read(path).calibration["cam0"].parameters, given.parameters)


def test_an_ftheta_image_of_any_size_is_not_looked_at(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at most 100000 pixels a side, found 18446744073709551616 x 480"):
        read(ftheta(tmp_path, resolution=[1 << 64, 480]))


def test_ftheta_files_of_other_tools(tmp_path: Path) -> None:
    path = ftheta(tmp_path, shutter_type="ROLLING_TOP_TO_BOTTOM")
    wrapped = tmp_path / "wrapped_ftheta.json"
    wrapped.write_text(json.dumps({"type": "ftheta", "parameters": json.loads(path.read_text())}))
    assert read(path).notes == ("Not kept of the file: shutter_type.",)
    assert read(wrapped).notes == ("Not kept of the file: type, shutter_type.",)
    with pytest.raises(InputError, match="windshield"):
        read(ftheta(tmp_path, external_distortion_parameters={"type": "bivariate-windshield"}))
    with pytest.raises(InputError, match="grows with the angle"):
        read(ftheta(tmp_path, angle_to_pixeldist_poly=[0.0, 1.0, -900.0, 0.0, 0.0, 0.0]))


def test_aria_follows_its_documents(tmp_path: Path) -> None:
    path = tmp_path / "aria.json"
    quaternion = np.array([0.9, 0.1, -0.3, 0.2])
    quaternion /= np.linalg.norm(quaternion)
    params = [240.0, 320.0, 240.5, -0.02, 0.01, -0.003, 0.0004, *([0.0] * 8)]
    entry = {
        "Label": "camera-rgb",
        "Projection": {"Name": "FisheyeRadTanThinPrism", "Params": params},
        "T_Device_Camera": {"Translation": [0.1, -0.2, 0.05], "UnitQuaternion": [quaternion[0], quaternion[1:].tolist()]},
    }
    other = entry | {"Label": "camera-et", "Projection": {"Name": "Linear", "Params": [300.0, 301.0, 320.0, 240.0]}}
    other["T_Device_Camera"] = {"Translation": [0.0, 0.0, 0.0], "UnitQuaternion": [1.0, [0.0, 0.0, 0.0]]}
    path.write_text(json.dumps({"CameraCalibrations": [other, entry], "ImageSizes": [[640, 480], [640, 480]]}))
    content = read(path)
    x, y = WIDE * np.cos(AROUND), WIDE * np.sin(AROUND)
    scale = 1 + polyval(WIDE**2, [0.0, *params[3:7]])
    expected = np.stack([240.0 * x * scale + 320.0, 240.0 * y * scale + 240.5], -1)
    np.testing.assert_allclose(content.calibration["camera-rgb"].project(RAYS)[0], expected, atol=1e-9)
    w, a, b, c = quaternion
    turn = np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )
    back = content.calibration.rig["camera-rgb"].cam_from_rig.inverse()
    np.testing.assert_allclose(back.rotation.numpy(), turn, atol=1e-12)
    np.testing.assert_allclose(back.translation.numpy(), [0.1, -0.2, 0.05], atol=1e-12)
    path.write_text(json.dumps({"CameraCalibrations": [entry]}))
    with pytest.raises(InputError, match="give `image_size`"):
        read(path)
    entry["Projection"] = {"Name": "FisheyeRadTanThinPrism", "Params": params[:-1]}
    path.write_text(json.dumps({"CameraCalibrations": [entry]}))
    with pytest.raises(InputError, match="Params of camera-rgb"):
        read(path, image_size=(640, 480))


def test_aria_with_all_terms_is_held_to_the_digit(tmp_path: Path) -> None:
    """fisheye624 as its documents write it, with values of the size that devices have."""
    f, cx, cy, *rest = 241.1, 317.5, 240.7, -0.0263, 0.0985, -0.0673, 0.0123, 0.0027, -0.00085
    p, s = np.array([-0.00049, 0.00046]), np.array([0.00045, -0.00019, -0.00083, 0.00015])
    path = tmp_path / "aria.json"
    projection = {"Name": "FisheyeRadTanThinPrism", "Params": [f, cx, cy, *rest, *p, *s]}
    path.write_text(json.dumps({"CameraCalibrations": [{"Label": "slam", "Projection": projection}]}))
    content = read(path, image_size=(640, 480))
    camera = content.calibration["slam"]
    assert isinstance(camera, Fisheye624) and content.notes == ()
    d = (WIDE * (1 + polyval(WIDE**2, [0.0, *rest])))[:, None] * np.stack([np.cos(AROUND), np.sin(AROUND)], -1)
    r2 = (d**2).sum(-1)
    plane = d + 2 * d * (d @ p)[:, None] + r2[:, None] * p + np.stack([s[0] * r2 + s[1] * r2**2, s[2] * r2 + s[3] * r2**2], -1)
    pixels, valid = camera.project(RAYS)
    # The curve of these values stops growing beyond.
    assert valid[math.pi / 2 > WIDE].all()
    np.testing.assert_allclose(pixels[valid], (f * plane + [cx, cy])[valid], rtol=0, atol=1e-9)
    posed = Calibration({"slam": camera}, rig={"slam": RigCamera(Pose.identity())})
    write(tmp_path / "again_aria.json", posed)
    assert read(tmp_path / "again_aria.json").calibration["slam"].named_parameters() == camera.named_parameters()


def test_openmvg_follows_its_sources(tmp_path: Path) -> None:
    """A file of an older version, whose keys lie side by side, and one of two cameras of one type as cereal writes it."""
    path = tmp_path / "sfm_data.json"
    data = {
        "width": WIDTH,
        "height": HEIGHT,
        "focal_length": 800.0,
        "principal_point": [640.0, 481.0],
        "disto_t2": [-0.1, 0.02, 1e-3, 1e-3, -2e-3],
    }
    entry = {
        "polymorphic_id": 2147483649,
        "polymorphic_name": "pinhole_brown_t2",
        "ptr_wrapper": {"id": 2147483700, "data": data},
    }
    again = {"polymorphic_id": 1, "ptr_wrapper": {"id": 2147483701, "data": data | {"focal_length": 810.0}}}
    whole = {
        "sfm_data_version": "0.3",
        "views": [{"key": 0}],
        "intrinsics": [{"key": 0, "value": entry}, {"key": 1, "value": again}],
    }
    path.write_text(json.dumps(whole))
    content = read(path)
    assert content.notes == ("Not kept of the file: views.",)
    narrow = RAYS[WIDE < 0.6]
    x, y = narrow[:, 0] / narrow[:, 2], narrow[:, 1] / narrow[:, 2]
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2 + 1e-3 * r2**3
    expected = np.stack([
        640.0 + 800.0 * (x * radial + 2 * 1e-3 * x * y - 2e-3 * (r2 + 2 * x * x)),
        481.0 + 800.0 * (y * radial + 1e-3 * (r2 + 2 * y * y) - 2 * 2e-3 * x * y),
    ], -1)  # fmt: skip
    np.testing.assert_allclose(content.calibration["cam0"].project(narrow)[0], expected, atol=1e-9)
    assert content.calibration["cam1"].named_parameters()["fx"] == 810.0
    write(tmp_path / "again_sfm_data.json", content.calibration)
    entries = json.loads((tmp_path / "again_sfm_data.json").read_text())["intrinsics"]
    assert [item["value"].get("polymorphic_name") for item in entries] == ["pinhole_brown_t2", None]
    assert [item["value"]["polymorphic_id"] for item in entries] == [2147483649, 1]
    spherical = {
        "polymorphic_id": 2147483649,
        "polymorphic_name": "spherical",
        "ptr_wrapper": {"data": {"width": 2048, "height": 1024}},
    }
    path.write_text(json.dumps(whole | {"intrinsics": [{"key": 0, "value": spherical}]}))
    panorama = read(path)
    assert isinstance(panorama.calibration["cam0"], Equirectangular) and panorama.calibration["cam0"].image_size == (2048, 1024)
    assert "half a pixel right of and below" in panorama.notes[0]


def test_a_fit_of_one_focal_length_is_the_best_one() -> None:
    source = Pinhole([800.0, 812.0, 640.0, 480.0, 0.0, -0.2, 0.05, 0.0, 0.0, 0.0, 0, 0, 0], (WIDTH, HEIGHT))
    tied = convert(source, "pinhole", None, {"skew": 0.0}, ("fx", "fy"))
    named = tied.model.named_parameters()
    assert named["fx"] == named["fy"] and 800.0 < named["fx"] < 812.0
    bearings, _ = source.unproject(
        np.stack(np.meshgrid(np.arange(0.0, WIDTH, 40), np.arange(0.0, HEIGHT, 40)), -1).reshape(-1, 2)
    )

    def rms(off: float) -> float:
        moved = Pinhole([named["fx"] + off, named["fy"] + off, *list(named.values())[2:]], (WIDTH, HEIGHT))
        return float(np.sqrt(((moved.project(bearings)[0] - source.project(bearings)[0]) ** 2).sum(-1).mean()))

    assert rms(0.0) < min(rms(-0.5), rms(0.5))


def two_in_usd(tmp_path: Path) -> tuple[Path, str]:
    """Two cameras 0.1 m apart, and the text of their file."""
    lens, path = OpenCVFisheye.examples()[0], tmp_path / "rig.usda"
    beside = Pose.exp(torch.tensor([0.0, 0.0, 0.0, -0.1, 0.0, 0.0], dtype=torch.float64))
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(beside)}
    write(path, Calibration({"left": lens, "right": lens}, rig=rig))
    return path, path.read_text()


@pytest.mark.parametrize(("said", "metres"), [("metersPerUnit = 1", 0.1), ("metersPerUnit = 0.01", 0.001), ("", 0.001)])
def test_usd_is_read_in_its_own_unit(tmp_path: Path, said: str, metres: float) -> None:
    path, text = two_in_usd(tmp_path)
    path.write_text(text.replace("metersPerUnit = 1", said))
    content = read(path)
    assert content.notes == ()
    assert content.calibration.rig["cam1"].cam_from_rig.translation.tolist() == pytest.approx([-metres, 0, 0])


@pytest.mark.parametrize("where", ["of a camera", "around cameras"])
def test_usd_poses_of_several_steps_are_not_taken_for_none(tmp_path: Path, where: str) -> None:
    path, text = two_in_usd(tmp_path)
    if where == "of a camera":
        text = text.replace(
            "matrix4d xformOp:transform", "double3 xformOp:translate = (1, 2, 3)\n        matrix4d xformOp:transform", 1
        )
    else:
        text = text.replace('def Xform "Rig"\n{', 'def Xform "Rig"\n{\n    double3 xformOp:translate = (1, 2, 3)')
    path.write_text(text)
    content = read(path)
    assert list(content.calibration) == ["cam0", "cam1"] and not content.calibration.rig
    assert "Not kept: the poses" in content.notes[-1] and "found xformOp:translate of cameras" in content.notes[-1]


def test_usd_opens_with_pixars_library(tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    lens = OpenCVFisheye([285.0, 286.0, 642.1, 398.7, 0.01, -0.006, 0.0015, -0.0002], (1280, 800))
    pose = Pose.exp(torch.tensor([0.3, -0.2, 0.5, 0.1, 0.4, -0.3], dtype=torch.float64))
    rig = {"left": RigCamera(Pose.identity()), "right": RigCamera(pose)}
    path = tmp_path / "rig.usda"
    write(path, Calibration({"left": Pinhole.examples()[1], "right": lens}, rig=rig))
    stage = Usd.Stage.Open(str(path))
    assert pxr is not None and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    prim = stage.GetPrimAtPath("/Rig/cam1")
    assert prim.IsA(UsdGeom.Camera) and prim.GetAttribute("omni:lensdistortion:model").Get() == "opencvFisheye"
    prefix = "omni:lensdistortion:opencvFisheye:"
    fx, fy, cx, cy, *k = (prim.GetAttribute(prefix + key).Get() for key in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"))
    assert tuple(prim.GetAttribute(prefix + "imageSize").Get()) == (1280, 800)
    # A point of the rig in the prim's frame, rows multiplied from the left, and through Newton's equation.
    points = torch.tensor(RAYS) * 3.0 + pose.inverse().translation
    world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
    local = (np.concatenate([points.numpy(), np.ones((len(points), 1))], 1) @ np.linalg.inv(world))[:, :3]
    x, y, z = local[:, 0], -local[:, 1], -local[:, 2]
    theta = np.arctan2(np.hypot(x, y), z)
    r = theta * (1 + polyval(theta**2, [0.0, *k])) / np.hypot(x, y)
    columns, rows = fx * x * r + cx - 0.5, fy * y * r + cy - 0.5
    pixels, valid = lens.project(pose.transform(points))
    assert bool(valid.any())
    np.testing.assert_allclose(np.stack([columns, rows], -1)[valid], pixels.numpy()[valid], atol=1e-3)
