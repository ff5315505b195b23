"""Files of OpenSfM, Metashape and lensfun: the equations of their documents, beside what is read."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from camera_models import Calibration, Equirectangular, InputError, OpenCVFisheye, Pinhole
from camera_models.formats import format_named, read, write
from camera_models.formats.contract import HAS_POSES
from camera_models.formats.transfer import transfer

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
    path.write_text(json.dumps([{"cameras": {"pano": camera}, "shots": {"a.jpg": {"camera": "pano"}}, "points": {}}]))
    content = read(path)
    assert isinstance(content.calibration["pano"], Equirectangular)
    assert content.notes == ("Not kept of the file: points.", HAS_POSES)
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


@pytest.mark.parametrize(
    ("kind", "own", "f", "terms", "rms_px"),
    [
        ("frame", "pinhole", 900.0, {"b2": 0.4, "k1": -0.1, "k2": 0.09, "k3": -0.05, "k4": 0.01, "p1": 5e-4, "p2": -3e-4}, 0.02),
        ("frame", "pinhole", 900.0, {"k1": -0.1, "k2": 0.02, "p1": 5e-4, "p2": -3e-4, "p3": 0.2}, 0.02),
        ("fisheye", "unified", 420.0, {"b1": 1.0, "b2": 0.4, "k1": 0.02, "k2": -0.01, "k3": 1e-3, "p1": 5e-4, "p2": -3e-4}, 0.3),
        ("fisheye", "fisheye624", 420.0, {"b1": 1.0, "k1": 0.02, "k2": -0.01, "k3": 1e-3, "p1": 5e-4, "p2": -3e-4}, 0.02),
    ],
)
def test_metashape_cameras_with_terms_of_their_own_are_read_as_near_as_is_said(
    tmp_path: Path, kind: str, own: str, f: float, terms: dict[str, float], rms_px: float
) -> None:
    content = read(metashape(tmp_path, kind, f=f, cx=3.0, cy=-2.0, **terms))
    (camera,), (estimate,), (note,) = content.calibration.values(), content.calibration.estimates.values(), content.notes
    assert camera.NAME == own
    said_px, said_rms_px = (float(note.rpartition(word)[2].split(" px")[0]) for word in ("within ", "px ("))
    assert said_rms_px < rms_px
    rng = np.random.default_rng(0)
    rays = rng.normal([0.0, 0.0, 1.0 if kind == "frame" else 0.2], 1.0, (3000, 3))
    rays = rays[np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) < math.radians(estimate.max_angle_deg)]
    level = rays[:, :2] / np.hypot(rays[:, 0], rays[:, 1])[:, None]
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    x, y = (np.tan(theta) if kind == "frame" else theta) * level.T
    r2 = x * x + y * y
    k, p = (np.array([terms.get(f"{name}{n}", 0.0) for n in range(1, 5)]) for name in "kp")
    radial, growing = 1 + sum(k[n] * r2 ** (n + 1) for n in range(4)), 1 + p[2] * r2 + p[3] * r2**2
    across = x * radial + growing * (p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y)
    down = y * radial + growing * (p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y)
    u = WIDTH / 2 + 3.0 + (f + terms.get("b1", 0.0)) * across + terms.get("b2", 0.0) * down - 0.5
    v = HEIGHT / 2 - 2.0 + f * down - 0.5
    inside = (u >= 0) & (u <= WIDTH - 1) & (v >= 0) & (v <= HEIGHT - 1)
    off = np.hypot(*(np.asarray(camera.project(rays)[0]) - np.stack([u, v], -1))[inside].T)
    assert inside.sum() > 25 and off.max() < 1.05 * said_px + 1e-6 and np.sqrt((off**2).mean()) < 2 * said_rms_px + 1e-6


def test_metashape_files_that_no_model_holds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"without p1, p2; hold these at 0 in Metashape"):
        read(metashape(tmp_path, "spherical", p1=1e-3, p2=-2e-3))
    with pytest.raises(InputError, match=r"curve that grows with the angle was expected, found one that does not"):
        read(metashape(tmp_path, "fisheye", f=400.0, k1=-1e6, p1=1e-3))
    with pytest.raises(InputError, match=r"counterpart here \(frame, fisheye, spherical\), found equisolid_fisheye"):
        read(metashape(tmp_path, "equisolid_fisheye", f=400.0))
    path = metashape(tmp_path, "frame", f=400.0)
    path.write_text('<!DOCTYPE x [<!ENTITY a "aaaa">]>' + path.read_text())
    with pytest.raises(InputError, match=r"plain XML, found a document type"):
        read(path)


def test_metashape_gives_the_adjusted_cameras_of_its_sensors(tmp_path: Path) -> None:
    """File, Export, Export Cameras."""
    path = tmp_path / "cameras.xml"

    def sensor(label: str, kind: str, terms: str) -> str:
        start = f'<calibration type="{kind}" class="initial"><resolution width="640" height="480"/><f>1</f></calibration>'
        own = f'<calibration type="{kind}" class="adjusted"><resolution width="640" height="480"/>{terms}</calibration>'
        return f'<sensor id="3" label="{label}" type="{kind}"><resolution width="640" height="480"/>{start}{own}</sensor>'

    sensors = sensor("FC6310", "frame", "<f>500</f><cx>2</cx><k1>-0.1</k1>") + sensor("Theta", "fisheye", "<f>200</f>")
    text = f'<?xml version="1.0"?>\n<document version="2.0.0"><chunk label="c"><sensors>{sensors}</sensors></chunk></document>'
    path.write_text(text)
    content = read(path)
    assert content.calibration["cam0"].named_parameters() | {"fx": 500.0, "cx": 321.5, "k1": -0.1} == (
        content.calibration["cam0"].named_parameters()
    )
    assert content.calibration["cam1"].NAME == "opencv-fisheye"
    assert content.notes[0] == "Sensors in the file: cam0 is FC6310, cam1 is Theta."
    path.write_text(text.replace("calibration", "other"))
    with pytest.raises(InputError, match="Sensors with a calibration were expected"):
        read(path, "metashape")


def test_metashape_names_its_files(tmp_path: Path) -> None:
    """OpenCV has files that end alike."""
    path = tmp_path / "metashape.xml"
    write(path, Calibration({"cam0": Pinhole.examples()[0]}))
    assert "<projection>frame</projection>" in path.read_text()
    write(tmp_path / "camera.xml", Calibration({"cam0": Pinhole.examples()[0]}))
    assert "opencv_storage" in (tmp_path / "camera.xml").read_text()


PROJECTIONS = {
    "rectilinear": np.tan,
    "fisheye": lambda t: t,
    "stereographic": lambda t: 2 * np.tan(t / 2),
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "orthographic": np.sin,
    "fisheye_thoby": lambda t: 1.47 * np.sin(0.713 * t),
}
CURVES = {
    'model="poly3" focal="8" k1="-0.02"': lambda r: r * (1.02 - 0.02 * r**2),
    'model="poly5" focal="8" k1="-0.01" k2="0.002"': lambda r: r * (1 - 0.01 * r**2 + 0.002 * r**4),
    'model="ptlens" focal="8" a="0.004" b="-0.02" c="0.01"': lambda r: r * (1.006 + 0.01 * r - 0.02 * r**2 + 0.004 * r**3),
}
"""As a file has them -> the distorted radius."""


def lensfun(tmp_path: Path, kind: str, distortion: str, beside: str = "") -> Path:
    """A lens of 8 mm measured on a sensor of 36 x 24 mm, by default."""
    path = tmp_path / "lens.xml"
    path.write_text(
        '<!DOCTYPE lensdatabase SYSTEM "lensfun-database.dtd">\n<lensdatabase version="1"><lens><maker>M</maker>'
        f"<model>Eight</model><model lang='de'>Acht</model><mount>K</mount><type>{kind}</type><cropfactor>1</cropfactor>{beside}"
        f'<calibration><!-- measured --><distortion {distortion}/><tca model="linear" focal="8" kr="1"/></calibration></lens>'
        "</lensdatabase>"
    )
    return path


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        ("rectilinear", "poly3"),
        ("rectilinear", "ptlens"),
        ("fisheye", "poly5"),
        ("stereographic", "poly5"),
        ("equisolid", "ptlens"),
        ("orthographic", "poly3"),
        ("fisheye_thoby", "poly3"),
    ],
)
def test_lensfun_follows_its_manual(kind: str, model: str, tmp_path: Path) -> None:
    """A sensor of 36 x 24 mm from the first pixel to the last, whose unit is 12 mm; nominal focal lengths are of the corrected
    image."""
    size = (3601, 2401)
    (distortion,) = (curve for curve in CURVES if model in curve)
    content = read(lensfun(tmp_path, kind, distortion), image_size=size)
    (camera,) = content.calibration.values()
    theta = np.linspace(0.01, 0.95, 50)
    radius = 1200 * CURVES[distortion](8 / 12 * PROJECTIONS[kind](theta))
    phi = np.linspace(0, 6, 50)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    expected = np.stack([1800 + radius * np.cos(phi), 1200 + radius * np.sin(phi)], -1)
    fitted = "ptlens" in distortion or kind not in ("rectilinear", "fisheye")
    np.testing.assert_allclose(camera.project(rays)[0], expected, atol=0.1 if fitted else 1e-8)
    *notes, last = content.notes
    assert last == "Not kept of the lenses: tca." and len(notes) == fitted
    if fitted:
        said_px = float(notes[0].rpartition("within ")[2].removesuffix(" px."))
        assert np.hypot(*(np.asarray(camera.project(rays)[0]) - expected).T).max() < 1.01 * said_px + 1e-6
        assert content.calibration.estimates["cam0"].max_angle_deg > 54


def test_lensfun_sensors_and_real_focal_lengths(tmp_path: Path) -> None:
    """A sensor of 4:3 and crop factor 2, off the middle of the image; the real focal length is that in the middle."""
    size = (4001, 3001)
    beside = '<aspect-ratio>4:3</aspect-ratio><center x="0.02" y="-0.01"/>'
    path = lensfun(tmp_path, "fisheye", 'model="poly3" focal="7.5" k1="-0.05"', beside)
    path.write_text(
        path.read_text()
        .replace("<cropfactor>1<", "<cropfactor>2<")
        .replace("<tca", '<real-focal-length focal="7.5" real-focal="7.2"/><tca')
    )
    (camera,) = read(path, image_size=size).calibration.values()
    half_mm = np.hypot(36, 24) / 2 / np.hypot(4, 3) * 3 / 2
    named = camera.named_parameters()
    assert named["fx"] == named["fy"] == pytest.approx(7.2 / half_mm * 1500, rel=1e-12)
    assert (named["cx"], named["cy"]) == (pytest.approx(2000 + 30), pytest.approx(1500 - 15))
    assert named["k1"] == pytest.approx(-0.05 / 1.05 * (7.2 / half_mm / 1.05) ** 2)


def test_lensfun_files_of_many_lenses(tmp_path: Path) -> None:
    """Each focal length of a zoom lens is a camera; what cannot be read is named."""
    path = tmp_path / "db.xml"
    lens = "<lens><model>Zoom</model><cropfactor>1.5</cropfactor>{}<calibration>{}</calibration></lens>"
    both = "".join(f'<distortion model="poly3" focal="{focal}" k1="-0.01"/>' for focal in (18, 55))
    adobe = '<distortion model="acm" focal="20" k1="-0.1" k2="0.01" k3="0.001" k4="0.0002" k5="-0.0003"/>'
    flat = lens.format("<type>panoramic</type>", both).replace("Zoom", "Flat")
    path.write_text(f"<lensdatabase>{lens.format('', both)}{lens.format('', adobe)}{lens.format('', adobe)}{flat}</lensdatabase>")
    with pytest.raises(InputError, match="give `image_size`"):
        read(path)
    content = read(path, image_size=(1501, 1001))
    assert list(content.calibration) == ["Zoom at 18 mm", "Zoom at 55 mm", "Zoom at 20 mm", "Zoom at 20 mm (2)"]
    assert content.notes == (
        "Left out: Flat; of the first: The type of a lens must be one of rectilinear, fisheye, stereographic, equisolid, "
        "orthographic, fisheye_thoby, found panoramic; no model here has it.",
    )
    camera = content.calibration["Zoom at 20 mm"]
    x, y = brown(RAYS[:, 0] / RAYS[:, 2], RAYS[:, 1] / RAYS[:, 2], (-0.1, 0.01, 0.001), 0.0002, -0.0003)
    f = 20 / (np.hypot(36, 24) / 1.5 / np.hypot(1500, 1000))
    pixels, valid = camera.project(RAYS)
    np.testing.assert_allclose(pixels[valid], np.stack([750 + f * x, 500 + f * y], -1)[valid], atol=1e-8)
    assert valid.mean() > 0.8
    path.write_text(f"<lensdatabase>{flat}</lensdatabase>")
    with pytest.raises(InputError, match=r"db.xml: The type of a lens .* found panoramic"):
        read(path, image_size=(1501, 1001))


def test_lensfun_is_written_for_the_lensfun_that_there_is(tmp_path: Path) -> None:
    """lensfun 0.3 does not know acm: a fit is of poly5."""
    lens = OpenCVFisheye.examples()[0]
    found = transfer(Calibration({"cam0": lens}), format_named("lensfun"), tmp_path / "lensfun.xml")
    assert found.forms["cam0"].name == "fisheye poly5" and found.conversions["cam0"].max_px > 0
    exact = Calibration({"cam0": Pinhole.examples()[-1]})
    assert transfer(exact, format_named("lensfun"), tmp_path / "lensfun.xml").forms["cam0"].name == "rectilinear acm"
