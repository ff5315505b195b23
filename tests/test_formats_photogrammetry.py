"""Files of OpenSfM and Metashape: the equations of their documents, beside what is read."""

import json
from pathlib import Path

import numpy as np
import pytest

from camera_models import Calibration, Equirectangular, InputError, OpenCVFisheye, Pinhole
from camera_models.formats import read, write

RAYS = np.random.default_rng(0).normal(size=(200, 3)) * [0.4, 0.4, 0.0] + [0, 0, 1.0]
WIDTH, HEIGHT = 1280, 960


def brown(x: np.ndarray, y: np.ndarray, k: tuple[float, ...], first: float, second: float) -> tuple[np.ndarray, np.ndarray]:
    """Radial terms, and `first` with 2 x y in x, `second` with r^2 + 2 x^2."""
    r2 = x**2 + y**2
    q = 1 + sum(term * r2 ** (power + 1) for power, term in enumerate(k))
    return x * q + 2 * first * x * y + second * (r2 + 2 * x**2), y * q + first * (r2 + 2 * y**2) + 2 * second * x * y


def angles() -> tuple[np.ndarray, np.ndarray]:
    """The angles off and about the axis as a point of the plane."""
    r = np.hypot(RAYS[:, 0], RAYS[:, 1])
    theta = np.arctan2(r, RAYS[:, 2])
    return theta * RAYS[:, 0] / r, theta * RAYS[:, 1] / r


def opensfm(tmp_path: Path, **keys: object) -> Path:
    path = tmp_path / "camera_models.json"
    path.write_text(json.dumps({"v2 some camera": {"width": WIDTH, "height": HEIGHT, **keys}}))
    return path


def test_opensfm_measures_in_the_longer_side_from_the_middle(tmp_path: Path) -> None:
    keys = {
        "focal_x": 0.5,
        "focal_y": 0.51,
        "c_x": 0.01,
        "c_y": -0.02,
        "k1": -0.1,
        "k2": 0.02,
        "p1": 1e-3,
        "p2": -2e-3,
        "k3": 1e-3,
    }
    (camera,) = read(opensfm(tmp_path, projection_type="brown", **keys)).calibration.values()
    x, y = brown(RAYS[:, 0] / RAYS[:, 2], RAYS[:, 1] / RAYS[:, 2], (-0.1, 0.02, 1e-3), 1e-3, -2e-3)
    normalised = np.stack([0.5 * x + 0.01, 0.51 * y - 0.02], -1)
    pixels, valid = camera.project(RAYS)
    # The pixel coordinates of its document: from the centre of the first pixel.
    expected = WIDTH * normalised + [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]
    np.testing.assert_allclose(pixels[valid], expected[valid], atol=1e-9)
    assert valid.mean() > 0.9


def test_opensfm_cameras_of_one_focal_length_are_centred(tmp_path: Path) -> None:
    (lens,) = read(opensfm(tmp_path, projection_type="fisheye", focal=0.4, k1=-0.02, k2=0.003)).calibration.values()
    assert isinstance(lens, OpenCVFisheye)
    x, y = angles()
    theta2 = x**2 + y**2
    scale = 0.4 * WIDTH * (1 - 0.02 * theta2 + 0.003 * theta2**2)
    expected = np.stack([scale * x + (WIDTH - 1) / 2, scale * y + (HEIGHT - 1) / 2], -1)
    np.testing.assert_allclose(lens.project(RAYS)[0], expected, atol=1e-9)
    (plain,) = read(opensfm(tmp_path, projection_type="perspective", focal=0.8, k1=-0.1, k2=0.01)).calibration.values()
    values = plain.named_parameters()
    assert isinstance(plain, Pinhole) and values["fx"] == values["fy"] == 0.8 * WIDTH
    assert (values["cx"], values["cy"], values["k1"], values["k2"]) == ((WIDTH - 1) / 2, (HEIGHT - 1) / 2, -0.1, 0.01)


def test_opensfm_reconstructions_hold_cameras_too(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.json"
    camera = {"projection_type": "spherical", "width": 2048, "height": 1024}
    path.write_text(json.dumps([{"cameras": {"pano": camera}, "shots": {}, "points": {}}]))
    content = read(path)
    assert isinstance(content.calibration["pano"], Equirectangular)
    assert content.notes == ("Not kept of the file: shots, points.",)
    with pytest.raises(InputError, match=r"must be one with a counterpart here \(simple_radial, .*\), found dual;"):
        read(opensfm(tmp_path, projection_type="dual", focal=0.5))


def metashape(tmp_path: Path, kind: str, **terms: float) -> Path:
    path = tmp_path / "metashape.xml"
    rows = {"projection": kind, "width": WIDTH, "height": HEIGHT, **terms, "date": "2026-01-01T00:00:00Z"}
    path.write_text(f"<calibration>{''.join(f'<{key}>{value}</{key}>' for key, value in rows.items())}</calibration>")
    return path


def test_metashape_frame_cameras_follow_its_manual(tmp_path: Path) -> None:
    terms = {
        "f": 700.0,
        "cx": 3.5,
        "cy": -2.0,
        "b1": 1.5,
        "b2": -0.7,
        "k1": -0.1,
        "k2": 0.02,
        "k3": 1e-3,
        "p1": 1e-3,
        "p2": -2e-3,
    }
    content = read(metashape(tmp_path, "frame", **terms))
    (camera,) = content.calibration.values()
    assert content.notes == ()
    # P1 stands with r^2 + 2 x^2, P2 with 2 x y.
    x, y = brown(RAYS[:, 0] / RAYS[:, 2], RAYS[:, 1] / RAYS[:, 2], (-0.1, 0.02, 1e-3), -2e-3, 1e-3)
    u = WIDTH * 0.5 + 3.5 + 700.0 * x + 1.5 * x - 0.7 * y
    v = HEIGHT * 0.5 - 2.0 + 700.0 * y
    pixels, valid = camera.project(RAYS)
    # Metashape counts from the corner of the image.
    np.testing.assert_allclose(pixels[valid] + 0.5, np.stack([u, v], -1)[valid], atol=1e-9)
    assert valid.mean() > 0.9


def test_metashape_fisheyes_are_polynomials_of_the_angle(tmp_path: Path) -> None:
    terms = {"f": 400.0, "cx": 1.0, "cy": 2.0, "b1": 0.5, "k1": -0.02, "k2": 0.003, "k3": -1e-3, "k4": 1e-4}
    (camera,) = read(metashape(tmp_path, "fisheye", **terms)).calibration.values()
    x, y = brown(*angles(), (-0.02, 0.003, -1e-3, 1e-4), 0.0, 0.0)
    expected = np.stack([WIDTH / 2 + 1.0 + 400.5 * x, HEIGHT / 2 + 2.0 + 400.0 * y], -1)
    np.testing.assert_allclose(camera.project(RAYS)[0] + 0.5, expected, atol=1e-9)


def test_metashape_files_that_no_model_holds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"without p1, p2, .*found p1 = 0.001, p2 = -0.002; hold these at 0 in Metashape"):
        read(metashape(tmp_path, "fisheye", f=400.0, p1=1e-3, p2=-2e-3))
    with pytest.raises(InputError, match=r"counterpart here \(frame, fisheye, spherical\), found equisolid_fisheye"):
        read(metashape(tmp_path, "equisolid_fisheye", f=400.0))
    path = metashape(tmp_path, "frame", f=400.0)
    path.write_text('<!DOCTYPE x [<!ENTITY a "aaaa">]>' + path.read_text())
    with pytest.raises(InputError, match=r"plain XML, found a document type"):
        read(path)


def test_metashape_names_its_files(tmp_path: Path) -> None:
    """OpenCV has files that end alike."""
    path = tmp_path / "metashape.xml"
    write(path, Calibration({"cam0": Pinhole.examples()[0]}))
    assert "<projection>frame</projection>" in path.read_text()
    write(tmp_path / "camera.xml", Calibration({"cam0": Pinhole.examples()[0]}))
    assert "opencv_storage" in (tmp_path / "camera.xml").read_text()
