"""Files of COLMAP: what its documents say, and what its own tools write."""

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation
from tool_files import put, rig_pair

from camera_models import Calibration, Equirectangular, Fisheye624, InputError, OpenCVFisheye, Pinhole, Scaramuzza
from camera_models.formats import read, write
from camera_models.formats.calibration_data import RigCamera
from camera_models.formats.contract import Content
from camera_models.pose import Pose

CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 3
1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
2 PINHOLE 3072 2304 2560.56 2560.56 1536 1152
3 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
"""
RIGS = (
    "1 2 CAMERA 1 CAMERA 2 1 -0.9999701516465348 -0.0011120266840749639 -0.0075347911527510894 0.0012985125893421306 "
    "-0.19316906391350164 0.00085222218993398979 0.0070758955539026785\n"
)


def test_colmap_counts_pixels_from_the_corner_of_the_image(tmp_path: Path) -> None:
    """The principal point in the middle of an image of 3072 x 2304 is (1536, 1152) there and (1535.5, 1151.5) here."""
    calibration = read(put(tmp_path / "cameras.txt", CAMERAS)).calibration
    assert list(calibration) == ["1", "2", "3"]
    for camera in calibration.values():
        assert isinstance(camera, Pinhole) and camera.image_size == (3072, 2304)
        assert camera.centre_px.tolist() == [1535.5, 1151.5] == [(3072 - 1) / 2, (2304 - 1) / 2]
    assert calibration["3"].named_parameters()["k1"] == -0.0218531
    write(tmp_path / "out" / "cameras.txt", calibration)
    rows = [line.split() for line in (tmp_path / "out" / "cameras.txt").read_text().splitlines() if line[0] != "#"]
    assert rows[0] == "1 SIMPLE_PINHOLE 3072 2304 2559.81 1536.0 1152.0".split() and rows[2][1] == "SIMPLE_RADIAL"


def test_colmap_quaternions_and_direction(tmp_path: Path) -> None:
    """The documented rig: (w, x, y, z) of sensor_from_rig, w may be negative; the second camera stands 0.19 to the right."""
    put(tmp_path / "cameras.txt", "".join(CAMERAS.splitlines(keepends=True)[:5]))
    put(tmp_path / "rigs.txt", RIGS)
    rotation, translation = rig_pair(tmp_path)
    w, x, y, z, *t = map(float, RIGS.split()[7:])
    np.testing.assert_allclose(rotation, Rotation.from_quat([x, y, z, w]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(translation, t, atol=1e-15)
    centre = -rotation.T @ translation
    assert centre[0] > 0.19
    # The reference need not be the first camera.
    put(tmp_path / "rigs.txt", RIGS.replace("CAMERA 1 CAMERA 2", "CAMERA 2 CAMERA 1"))
    back, shift = rig_pair(tmp_path)
    np.testing.assert_allclose(back, rotation.T, atol=1e-12)
    np.testing.assert_allclose(shift, centre, atol=1e-12)


def test_colmap_rigs_that_are_not_one(tmp_path: Path) -> None:
    put(tmp_path / "cameras.txt", CAMERAS)
    put(tmp_path / "rigs.txt", RIGS + "2 1 CAMERA 3\n")
    content = read(tmp_path)
    assert not content.calibration.rig and "not one rig of all cameras" in content.notes[0]
    put(tmp_path / "rigs.txt", "1 3 CAMERA 1 CAMERA 2 0 CAMERA 3 1 1 0 0 0 0 0 1\n")
    assert "the pose of a camera is not known" in read(tmp_path).notes[0]
    put(tmp_path / "rigs.txt", "1 3 CAMERA 1 CAMERA 2 1 1 0 0\n")
    with pytest.raises(InputError, match=r"rigs.txt, line 1 must hold RIG_ID NUM_SENSORS"):
        read(tmp_path)
    put(tmp_path / "rigs.txt", RIGS + "2 1 CAMERA 1\n")
    with pytest.raises(InputError, match=r"rigs.txt: every sensor must be in one rig once"):
        read(tmp_path)


def test_colmap_binary_layout(tmp_path: Path) -> None:
    """Bytes as COLMAP documents them: little endian, uint64 count, uint32 id, int32 model, uint64 size, float64 parameters."""
    parameters = (300.0, 301.0, 640.5, 480.5, 0.01, -0.02, 0.003, -0.0004)
    cameras = struct.pack("<Q", 2)
    cameras += struct.pack("<IiQQ8d", 7, 5, 1281, 961, *parameters) + struct.pack(
        "<IiQQ4d", 9, 1, 640, 480, 500.0, 501.0, 320.0, 240.0
    )
    rig = struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 7, 0, 9, 1, 0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0)
    put(tmp_path / "cameras.bin", cameras), put(tmp_path / "rigs.bin", rig)
    calibration = read(tmp_path).calibration
    assert list(calibration) == ["7", "9"] and isinstance(calibration["7"], OpenCVFisheye)
    assert calibration["7"].parameters.tolist() == [300.0, 301.0, 640.0, 480.0, *parameters[4:]]
    rotation, translation = rig_pair(tmp_path)
    # A third of a turn about (1, 1, 1): x to y to z to x.
    np.testing.assert_allclose(rotation, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)
    assert translation.tolist() == [1.0, 2.0, 3.0]
    out = tmp_path / "out" / "cameras.bin"
    assert write(out, calibration) == [out, out.with_name("rigs.bin")]
    assert out.read_bytes() == cameras and out.with_name("rigs.bin").read_bytes() == rig
    for at in (4, 12, len(cameras) - 1):
        with pytest.raises(InputError, match="ends in the middle of a record"):
            read(put(tmp_path / "cut" / "cameras.bin" if False else tmp_path / "cameras_cut.bin", cameras[:at]), "colmap")
    with pytest.raises(InputError, match="found 3 more bytes"):
        read(put(tmp_path / "cameras_long.bin", cameras + b"abc"), "colmap")


def test_colmap_division_is_a_polynomial(tmp_path: Path) -> None:
    """The ray of pixel x is (x - c) / f with z = 1 + k r^2."""
    text = "1 SIMPLE_DIVISION 1280 960 400 640.5 480.5 -0.15\n2 DIVISION 1280 960 400 410 640.5 480.5 -0.15\n"
    calibration = read(put(tmp_path / "cameras.txt", text)).calibration
    pixels = np.random.default_rng(1).uniform([100, 100], [1100, 800], (50, 2))
    for camera, focal in zip(calibration.values(), ([400, 400], [400, 410]), strict=True):
        assert isinstance(camera, Scaramuzza)
        plane = (pixels + 0.5 - [640.5, 480.5]) / focal
        rays = np.concatenate([plane, 1 - 0.15 * (plane**2).sum(-1, keepdims=True)], -1)
        bearings, valid = camera.unproject(pixels)
        assert valid.all()
        np.testing.assert_allclose(bearings, rays / np.linalg.norm(rays, axis=-1, keepdims=True), atol=1e-12)


def of_colmap(tmp_path: Path, model: str, values: list[float]) -> tuple[Content, np.ndarray, np.ndarray]:
    """What is read of a camera of 1280 x 960 px, rays up to 85 degrees off axis that it shows, and their pixels by pycolmap."""
    row = f"1 {model} 1280 960 {' '.join(map(str, values))}\n"
    rng = np.random.default_rng(2)
    theta, phi = rng.uniform(0, np.radians(85), 2000), rng.uniform(-np.pi, np.pi, 2000)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    pixels = pycolmap.Camera(model=model, width=1280, height=960, params=values).img_from_cam(rays)
    inside = ((pixels > 0.5) & (pixels < [1279.5, 959.5])).all(-1)
    assert inside.sum() > 1000
    return read(put(tmp_path / "cameras.txt", row)), rays[inside], pixels[inside] - 0.5


def test_colmap_decentred_fisheye_is_held_to_the_digit(tmp_path: Path) -> None:
    values = [301.2, 302.5, 640.5, 482.0, 0.02, -0.012, 0.004, -0.0005, 1e-5, -1e-6, 8e-4, -6e-4, 1e-3, -3e-4, -7e-4, 2e-4]
    content, rays, pixels = of_colmap(tmp_path, "RAD_TAN_THIN_PRISM_FISHEYE", values)
    (camera,) = content.calibration.values()
    assert isinstance(camera, Fisheye624) and content.notes == ()
    np.testing.assert_allclose(camera.project(rays)[0], pixels, rtol=0, atol=1e-9)


def test_colmap_thin_prism_fisheye_is_read_as_near_as_is_said(tmp_path: Path) -> None:
    """The terms of lenses in ETH3D's data sets, at the focal length of a fisheye."""
    values = [300.0, 301.0, 640.0, 480.0, -0.01, 0.004, 5e-4, -7e-4, -0.002, 1e-4, 1e-3, -8e-4]
    content, rays, pixels = of_colmap(tmp_path, "THIN_PRISM_FISHEYE", values)
    (camera,), (note,) = content.calibration.values(), content.notes
    said_px, rms_px = (float(note.rpartition(word)[2].split(" px")[0]) for word in ("within ", "px ("))
    off = np.linalg.norm(np.asarray(camera.project(rays)[0]) - pixels, axis=1)
    assert isinstance(camera, Fisheye624) and content.calibration.estimates["1"].max_angle_deg > 85
    assert off.max() < said_px < 0.05 and np.sqrt((off**2).mean()) < 2 * rms_px


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 THIN_PRISM_FISHEYE 100 80 50 50 50 40 -1e6 0 0 0 0 0 0 0", "curve that grows with the angle"),
        ("1 FOV 100 80 50 50 50 40 0.9", "found FOV; convert it"),
        ("1 PINHOLE 100 80 50 50 50", "line 1 must hold 4 parameters for PINHOLE, found 3"),
        ("1 PINHOLE 100 80 50 50 50 x", "line 1 must hold numbers, found '50 50 50 x'"),
        ("1 BROWN 100 80 50 50 50 40", "must name a camera model of COLMAP"),
        ("1 PINHOLE 100 80 50 50 50 40\n1 PINHOLE 100 80 50 50 50 40", "every camera must have its own id"),
        ("1 PINHOLE 0 80 50 50 50 40", "must have a size and finite parameters"),
        ("1 EQUIRECTANGULAR 100 50 90 45", "must fill its image of 100 x 50 px"),
        ("# nothing", "must hold at least one camera"),
    ],
)
def test_colmap_refuses(tmp_path: Path, row: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(put(tmp_path / "cameras.txt", row), "colmap")


def test_colmap_panorama(tmp_path: Path) -> None:
    (camera,) = read(put(tmp_path / "cameras.txt", "1 EQUIRECTANGULAR 2048 1024 2048 1024\n")).calibration.values()
    assert isinstance(camera, Equirectangular) and camera.image_size == (2048, 1024)


def test_colmap_keeps_ids_and_leaves_no_stale_file(tmp_path: Path) -> None:
    model = Pinhole.examples()[3]
    calibration = Calibration(
        {"5": model, "3": model},
        rig={"5": RigCamera(Pose.identity()), "3": RigCamera(Pose.exp(torch.full((6,), 0.1, dtype=torch.float64)))},
    )
    write(tmp_path / "cameras.txt", calibration)
    assert list(read(tmp_path).calibration) == ["5", "3"]
    with pytest.raises(InputError, match=r"found .*rigs.txt, which COLMAP would read with the new ones"):
        write(tmp_path / "cameras.txt", Calibration({"5": model}))
    with pytest.raises(InputError, match=r"found .*cameras.txt, .*rigs.txt, which COLMAP"):
        write(tmp_path / "cameras.bin", calibration)
    # COLMAP reads the binary files first.
    put(tmp_path / "cameras.bin", struct.pack("<QIiQQ3d", 1, 4, 0, 100, 80, 50.0, 50.0, 40.0))
    assert list(read(tmp_path).calibration) == ["4"]
