"""Arcs against closed forms: painted half spaces whose great circle is known; and against the edges of rendered rooms."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

import omnilines as ol
from camera_models import Calibration, CameraModel, Equirectangular, InputError, OpenCVFisheye, Pinhole, load, save
from omnilines.cli import main
from omnilines.commands.render_scene import render_scene
from omnilines.evaluation.arcs import ArcScores, arc_scores
from omnilines.extraction import ExtractedArcs, extract_arcs
from omnilines.extraction.image_circle import image_circle
from omnilines.files import read_poses, read_segments
from omnilines.files.true_edges import read_stretches, read_true_edges
from omnilines.geometry.sphere import angle_between, arc_normal

DARK, BRIGHT = np.array([60.0, 80.0, 100.0]), np.array([110.0, 120.0, 90.0])
PINHOLE = Pinhole.from_mapping({"fx": 260.0, "fy": 260.0, "cx": 159.3, "cy": 119.6}, (320, 240))
FISHEYE = OpenCVFisheye.from_mapping(
    {"fx": 100.0, "fy": 101.0, "cx": 161.2, "cy": 118.7, "k1": -0.02, "k2": 0.004, "k3": 0.0, "k4": 0.0}, (320, 240)
)
PANORAMA = Equirectangular([], (480, 240))


def bearings_of(model: CameraModel) -> np.ndarray:
    width, height = model.image_size
    rays, _ = model.unproject(np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1))
    return rays


def painted(
    model: CameraModel,
    normal: np.ndarray,
    blur_px: float = 0.7,
    noise: float = 0.0,
    seed: int = 0,
    colours: tuple = (DARK, BRIGHT),
) -> np.ndarray:
    """A photo (h, w, 3) as floats of a sky of two colours, divided by a great circle; the step is blurred by `blur_px`."""
    height = bearings_of(model) @ normal
    slope = np.hypot(*np.gradient(height))
    distance = height / np.maximum(slope, 1e-9)
    share = ndtr(distance / blur_px)[..., None]
    image = (1 - share) * colours[0] + share * colours[1]
    return image + noise * np.random.default_rng(seed).standard_normal(image.shape)


def byte(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def normals(found: ExtractedArcs, model: CameraModel) -> np.ndarray:
    rays, valid = model.unproject(found.endpoints_px)
    assert valid.all()
    return arc_normal(rays[:, 0].copy(), rays[:, 1].copy())


def direction_error(found: ExtractedArcs, model: CameraModel, normal: np.ndarray) -> np.ndarray:
    angle = angle_between(normals(found, model), np.broadcast_to(normal, (len(found), 3)).copy())
    return np.minimum(angle, math.pi - angle)


def unit(*values: float) -> np.ndarray:
    return np.array(values) / np.linalg.norm(values)


@pytest.mark.parametrize("model", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_one_edge_is_one_arc_without_an_offset(model: CameraModel) -> None:
    """From border to border; the pixel offset of the ends, averaged over turns and places of the edge, is nothing."""
    offsets = []
    for k, turn in enumerate(np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False)):
        normal = unit(math.cos(turn), math.sin(turn), 0.013 * k)
        image = byte(painted(model, normal, noise=1.0, seed=k))
        found = extract_arcs(image, model)
        # An edge seen over more than 149 degrees is two arcs.
        assert len(found) == 1 or (model is FISHEYE and len(found) == 2)
        assert found.length_px.sum() > 220
        assert direction_error(found, model, normal)[0] < math.radians(0.06)
        rays, _ = model.unproject(found.endpoints_px[0])
        side = model.unproject(found.endpoints_px[0] + 1e-3 * np.array([math.cos(turn), math.sin(turn)]))[0] - rays
        offsets += list((rays @ normal) / (side @ normal) * 1e-3)
    assert len(offsets) == 24
    assert np.abs(offsets).max() < 0.12
    assert abs(np.mean(offsets)) < 0.015


@pytest.mark.slow
def test_the_covariance_explains_the_errors() -> None:
    """Distances of end points from the true circle over their standard deviations, for weak edges in noise.

    Of strong ones the standard deviation is the floor for what no average removes, which painted edges do not have.
    """
    scaled = []
    rng = np.random.default_rng(5)
    for k in range(30):
        turn = rng.uniform(0.0, 2.0 * math.pi)
        normal = unit(math.cos(turn), math.sin(turn), rng.uniform(-0.3, 0.3))
        image = byte(painted(PINHOLE, normal, noise=rng.uniform(3.0, 5.0), seed=k, colours=(DARK, DARK + 14.0)))
        found = extract_arcs(image, PINHOLE)
        assert len(found) >= 1
        step = 1e-4
        for pixel, covariance in zip(found.endpoints_px[0], found.covariance_px2[0], strict=True):
            places = pixel + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
            height = PINHOLE.unproject(places)[0] @ normal
            slope = (height[1:] - height[0]) / step
            scaled.append(height[0] / math.sqrt(slope @ covariance @ slope))
    inside = np.mean(np.abs(scaled) < 1.96)
    assert len(scaled) == 60
    assert 0.88 <= inside <= 1.0
    assert 0.5 <= np.std(scaled) <= 1.3


def test_colours_of_one_brightness_differ() -> None:
    """An edge that a grey photo does not show."""
    red, green = np.array([90.0, 100.0, 140.0]), np.array([90.0, 100.0 + 0.299 / 0.587 * 40.0, 100.0])
    normal = unit(1.0, 0.4, 0.1)
    image = byte(painted(PINHOLE, normal, noise=1.0, colours=(red, green)))
    found = extract_arcs(image, PINHOLE)
    assert len(found) == 1
    assert direction_error(found, PINHOLE, normal)[0] < math.radians(0.1)
    assert len(extract_arcs(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), PINHOLE)) == 0


def test_an_arc_crosses_the_seam_of_a_panorama() -> None:
    """One arc on both sides of the seam, given by end pixels at either side of the image."""
    normal = unit(0.05, 1.0, 0.1)
    image = painted(PANORAMA, normal, noise=1.0)
    rays = bearings_of(PANORAMA)
    image[rays[..., 2] > -0.6] = DARK  # only behind the camera
    found = extract_arcs(byte(image), PANORAMA)
    on = direction_error(found, PANORAMA, normal) < math.radians(0.3)
    assert on.sum() == 1
    ends = found.endpoints_px[on][0]
    assert abs(ends[0, 0] - ends[1, 0]) > 300
    assert found.length_px[on][0] > 120


def test_past_a_half_turn_and_over_the_pole() -> None:
    """A great circle through both poles of a panorama, where a pixel is next to nothing."""
    normal = unit(1.0, 0.02, 0.3)
    found = extract_arcs(byte(painted(PANORAMA, normal, noise=1.0)), PANORAMA)
    error = direction_error(found, PANORAMA, normal)
    assert len(found) >= 2
    assert np.median(error) < math.radians(0.3)
    assert found.length_px[error < math.radians(0.5)].sum() > 2 * 180


@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_the_rim_of_the_image_circle_is_no_arc(noise: float) -> None:
    """A bright disc with nothing in it; a dark side of the scene does not hide the rim."""
    rays = bearings_of(FISHEYE)
    theta = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
    inside = theta < math.radians(62.0)
    image = np.where(inside[..., None], 150.0, 5.0) + np.zeros(3)
    image[inside & (rays[..., 0] > 0.6)] = 8.0
    image = byte(image + noise * np.random.default_rng(0).standard_normal(image.shape))
    circle = image_circle(image, FISHEYE)
    assert circle is not None
    radius = float(FISHEYE.project(np.array([math.sin(math.radians(62.0)), 0.0, math.cos(math.radians(62.0))]))[0][0]) - 161.2
    np.testing.assert_allclose(circle, (161.2, 118.7, radius), atol=1.5)
    assert len(extract_arcs(image, FISHEYE, mask=rays[..., 0] < 0.5)) == 0


@pytest.mark.parametrize("quality", [90, 75])
def test_the_rim_is_found_where_a_camera_sharpened_it(quality: int) -> None:
    """Sharpening and JPEG darken the dark beside the light: where the rim nearly meets the border, it is darkest."""
    apart = np.linalg.norm(np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1) - [161.2, 118.7], axis=-1)
    image = 4.0 + 146.0 * ndtr((115.0 - apart) / 0.6)[..., None] + np.zeros(3)
    image += np.random.default_rng(3).standard_normal(image.shape)
    image += 0.8 * (image - cv2.GaussianBlur(image, (0, 0), 1.0))
    photo = cv2.imdecode(cv2.imencode(".jpg", byte(image), [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    circle = image_circle(photo, FISHEYE)
    assert circle is not None
    np.testing.assert_allclose(circle, (161.2, 118.7, 115.0), atol=1.5)
    assert len(extract_arcs(photo, FISHEYE)) == 0


def test_what_the_mask_leaves_out_has_no_arcs() -> None:
    normal = unit(1.0, 0.2, 0.0)
    image = byte(painted(PINHOLE, normal, noise=1.0))
    mask = np.ones((240, 320), dtype=bool)
    mask[:140] = False
    found = extract_arcs(image, PINHOLE, mask)
    assert len(found) == 1
    assert found.endpoints_px[0, :, 1].min() > 137
    # The mount of a mirror: nothing nearer to the axis than an angle.
    outer = extract_arcs(image, PINHOLE, None, (math.radians(15.0), math.inf))
    assert len(outer) == 2
    radius = np.hypot(*(outer.endpoints_px - np.array([159.3, 119.6])).reshape(-1, 2).T)
    assert radius.min() > 260.0 * math.tan(math.radians(14.0))


def test_two_edges_of_a_narrow_strip() -> None:
    """A strip 1.6 px wide has two edges, each in its place."""
    width = 1.6 / 260.0
    a, b = unit(1.0, 0.3, 0.0), unit(1.0, 0.3, -width * math.hypot(1.0, 0.3))
    low, high = painted(PINHOLE, a), painted(PINHOLE, b)
    strip = (low - high)[..., :1] / (BRIGHT - DARK)[0]
    image = byte(DARK + 60.0 * strip + np.random.default_rng(1).normal(size=low.shape))
    found = extract_arcs(image, PINHOLE)
    assert len(found) == 2
    errors = np.sort([min(direction_error(found, PINHOLE, n)) for n in (a, b)])
    assert errors.max() < 0.5 / 260.0
    rays = PINHOLE.unproject(found.endpoints_px)[0]
    across = np.sort(np.abs(260.0 * np.stack([rays @ a, rays @ b])).min(0).ravel())
    assert across[-1] < 0.2
    # One arc on either edge, not both on one.
    np.testing.assert_allclose(np.ptp((260.0 * rays @ a).mean(-1)), 1.6, atol=0.2)


def test_eight_and_sixteen_bits_and_grey() -> None:
    normal = unit(1.0, 0.4, 0.1)
    image = painted(PINHOLE, normal, noise=1.0)
    eight = extract_arcs(byte(image), PINHOLE)
    sixteen = extract_arcs(np.rint(image * 257.0).astype(np.uint16), PINHOLE)
    np.testing.assert_allclose(sixteen.endpoints_px, eight.endpoints_px, atol=0.1)
    assert len(extract_arcs(byte(image)[..., 0], PINHOLE)) == 1


def test_noise_is_no_arc() -> None:
    image = 120.0 + 6.0 * np.random.default_rng(2).standard_normal((240, 320, 3))
    assert len(extract_arcs(byte(image), PINHOLE)) == 0
    assert len(extract_arcs(np.zeros((240, 320), dtype=np.uint8), PINHOLE)) == 0


def test_a_photo_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="320x240 px was expected"):
        extract_arcs(np.zeros((100, 100), dtype=np.uint8), PINHOLE)


def test_the_command_writes_table_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    normal = unit(1.0, 0.4, 0.1)
    cv2.imwrite(str(photos / "a.png"), byte(painted(PINHOLE, normal, noise=1.0)))
    (photos / "b.png").write_bytes(b"not a photo")
    save(tmp_path / "calibration.yaml", Calibration({"cam0": PINHOLE}))
    out = tmp_path / "out"
    main_exit(["extract", str(photos), "--calibration", str(tmp_path / "calibration.yaml"), "--out", str(out), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["arcs"] == 1
    assert [photo["reason"] is None for photo in told["photos"]] == [True, False]
    table = read_segments(out / "segments.csv")
    assert table.images == ("a.png",) and table.cameras == ("cam0",)
    assert (table.track == -1).all() and table.covariance_px2 is not None
    assert np.linalg.eigvalsh(table.covariance_px2).min() > 0
    picture = cv2.imread(str(out / "pictures" / "a.jpg"))
    assert picture.shape == (240, 320, 3)
    small = tmp_path / "mask.png"
    cv2.imwrite(str(small), np.full((10, 10), 255, dtype=np.uint8))
    arguments = [
        "extract",
        str(photos),
        "--calibration",
        str(tmp_path / "calibration.yaml"),
        "--mask",
        str(small),
        "--out",
        str(out),
    ]
    assert main_exit(arguments) == 2
    assert "mask" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_finds_what_python_finds_down_to_the_same_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And it names a next step where that can be taken."""
    folder, table = tmp_path / "room", tmp_path / "out" / "segments.csv"
    render_scene(folder, scene="room", views=3, size=(320, 240))
    camera = folder / "calibration.yaml"
    found = ol.extract(folder, load(camera))
    for photos, settings, next_step in (
        (folder / "view00.png", [], False),
        (folder, ["--set", "extraction.min_length_px=10"], True),
    ):
        assert main_exit(["extract", str(photos), "--calibration", str(camera), "--out", str(table.parent), *settings]) == 0
        assert ("Next: omnilines reconstruct" in capsys.readouterr().out) is next_step, "nothing is rebuilt from one photo"
    assert len(read_segments(table).track) == len(found) > 40


def main_exit(arguments: list[str]) -> int:
    try:
        main(arguments)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def room_scores(folder: Path, model: str, fov_deg: float | None, views: int, size: tuple[int, int], seed: int) -> ArcScores:
    render_scene(folder, scene="room", model=model, fov_deg=fov_deg, views=views, size=size, seed=seed)
    out = folder.parent / f"{folder.name} arcs"
    assert main_exit(["extract", str(folder), "--calibration", str(folder / "calibration.yaml"), "--out", str(out)]) == 0
    camera = load(folder / "calibration.yaml")["cam0"]
    edges = read_true_edges(folder / "truth.csv")
    stretches = read_stretches(folder / "visibility.csv", edges)
    return arc_scores(camera, read_poses(folder / "poses.csv"), edges, stretches, read_segments(out / "segments.csv"))


CAMERAS = [
    pytest.param("opencv-fisheye", 190.0, id="fisheye-190"),
    pytest.param("scaramuzza", 220.0, id="scaramuzza-220"),
    pytest.param("equirectangular", None, id="equirectangular"),
    pytest.param("pinhole", None, id="pinhole"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "fov_deg"), CAMERAS)
def test_a_small_photo_of_a_room(tmp_path: Path, model: str, fov_deg: float | None) -> None:
    scores = room_scores(tmp_path, model, fov_deg, 1, (640, 480), 11)
    assert scores.covered_share > 0.8
    assert scores.on_edge_share > 0.65
    assert scores.arcs_per_stretch <= 1.2
    assert scores.direction_deg(50) < 0.2


@pytest.mark.full
@pytest.mark.parametrize(("model", "fov_deg"), CAMERAS)
def test_rooms(tmp_path: Path, model: str, fov_deg: float | None) -> None:
    """The figures that are reached; the issue asks for more: docs/extraction_measured.md."""
    scores = room_scores(tmp_path, model, fov_deg, 3, (1280, 960), 5)
    assert scores.covered_share > 0.84
    assert scores.on_edge_share > 0.78
    assert scores.arcs_per_stretch <= 1.15
    assert scores.direction_deg(50) <= 0.12
