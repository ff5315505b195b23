"""Sampling grids and resampled images against OpenCV's rectification maps, closed forms and directly computed images."""

import math

import cv2
import numpy as np
import pytest
import torch

from camera_models import Cylindrical, Equirectangular, InputError, OpenCVFisheye, Pinhole, Scaramuzza, load, save
from camera_models.formats.calibration_data import Calibration
from camera_models.resampling import resample, sampling_grid
from camera_models.views import CUBE_FACES, axis_from_camera, looking, views

FISHEYE = OpenCVFisheye([180.0, 181.0, 318.0, 241.5, 0.02, -0.01, 0.003, -0.0005], (640, 480))
BROWN = Pinhole.from_mapping(
    {"fx": 400.0, "fy": 402.0, "cx": 322.0, "cy": 238.0, "k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -5e-4, "k3": 0.01}, (640, 480)
)
TURN = cv2.Rodrigues(np.array([0.2, -0.3, 0.1]))[0]


def photo(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """A smooth colour photo."""
    noise = np.random.default_rng(seed).uniform(0, 255, (size[1], size[0], 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return cv2.normalize(smooth, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


def plain_pinhole(size: tuple[int, int], focal: float) -> Pinhole:
    named = {"fx": focal, "fy": focal, "cx": 0.5 * (size[0] - 1), "cy": 0.5 * (size[1] - 1)}
    return Pinhole.from_mapping(named, size)


def matrix(camera: Pinhole | OpenCVFisheye) -> np.ndarray:
    fx, fy = camera.parameters[:2].tolist()
    cx, cy = camera.centre_px.tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def test_perspective_views_of_a_fisheye_are_those_of_opencv() -> None:
    output = plain_pinhole((500, 400), 150.0)
    grid = sampling_grid(output, FISHEYE, TURN.T)
    u, v = cv2.fisheye.initUndistortRectifyMap(
        matrix(FISHEYE), FISHEYE.parameters[4:].numpy(), TURN, matrix(output), (500, 400), cv2.CV_32FC1
    )
    inside = (u > 0) & (u < 639) & (v > 0) & (v < 479)
    assert inside.mean() > 0.8 and grid.valid[inside].all()
    assert np.abs(grid.pixels - np.stack([u, v], -1))[inside].max() < 1e-3
    image = photo((640, 480))
    turned_off = sampling_grid(output, FISHEYE)
    expected = cv2.fisheye.undistortImage(
        image, matrix(FISHEYE), FISHEYE.parameters[4:].numpy(), Knew=matrix(output), new_size=(500, 400)
    )
    made = resample(image, turned_off, area=False)
    u, v = turned_off.pixels[..., 0], turned_off.pixels[..., 1]
    inside = turned_off.valid & (u > 1) & (u < 638) & (v > 1) & (v < 478)
    assert inside.mean() > 0.8
    assert np.abs(made.astype(int) - expected)[inside].max() <= 1


def test_perspective_views_of_a_distorted_pinhole_are_those_of_opencv() -> None:
    output = plain_pinhole((600, 450), 380.0)
    grid = sampling_grid(output, BROWN, TURN.T)
    coefficients = BROWN.parameters[5:10].numpy()
    maps = cv2.initUndistortRectifyMap(matrix(BROWN), coefficients, TURN, matrix(output), (600, 450), cv2.CV_32FC1)
    expected = np.stack(maps, -1)
    assert grid.valid.mean() > 0.5
    assert np.abs(grid.pixels - expected)[grid.valid].max() < 1e-3
    image = photo((640, 480))
    remapped = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    well_inside = grid.valid & (expected > 1).all(-1) & (expected < [638, 478]).all(-1)
    assert np.abs(resample(image, grid, area=False).astype(int) - remapped)[well_inside].max() <= 1


def scene_of_bearings(bearings: np.ndarray) -> np.ndarray:
    """A smooth function of the direction, as grey levels."""
    x, y, z = np.moveaxis(bearings, -1, 0)
    return 128 + 40 * np.sin(3 * x + 1) + 40 * np.cos(4 * y - 2 * z) + 30 * x * z


def directly(camera) -> tuple[np.ndarray, np.ndarray]:
    width, height = camera.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    bearings, valid = camera.unproject(pixels)
    return scene_of_bearings(bearings), valid


MIRROR = Scaramuzza(np.array([320.0, 240.0, 1.0, 0.0, 0.0, -150.0, 1.5e-3]), (640, 480))
SOURCES = [
    pytest.param(FISHEYE, id="fisheye"),
    pytest.param(BROWN, id="pinhole"),
    pytest.param(MIRROR, id="mirror"),
    pytest.param(Equirectangular([], (1024, 512)), id="panorama"),
    pytest.param(Cylindrical([1024 / (2 * math.pi), 160.0, 500.0, 255.0], (1024, 512)), id="cylinder"),
]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("kind", ["perspective", "cylindrical", "panorama", "cube"])
def test_views_show_what_the_directions_do(source, kind: str) -> None:
    """An image whose grey levels are a function of the direction, resampled, is that function at the view's directions.

    Panoramas are looked at across their seam too."""
    image, known = directly(source)
    image, known = image.astype(np.float32), known.astype(np.float32)
    size = {"perspective": (300, 200), "cylindrical": (500, 200), "panorama": (400, 200), "cube": (150, 150)}[kind]
    shown = 0
    for view in views(kind, size, yaw_deg=170.0 if source.PERIODIC else 0.0):
        view_from_cam = view.view_from_axis @ axis_from_camera(source)
        grid = sampling_grid(view.camera, source, view_from_cam.T)
        made = resample(image, grid, area=False)
        pixels = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).astype(np.float64)
        bearings, _ = view.camera.unproject(pixels)
        expected = scene_of_bearings(bearings @ view_from_cam)
        # Half a pixel at the rim of the image is extrapolated; the rows at the poles of a panorama have neighbours all round.
        inner = (
            grid.valid
            & (resample(known, grid, area=False) == 1)
            & (grid.pixels[..., 1] > 1)
            & (grid.pixels[..., 1] < source.image_size[1] - 2)
        )
        if not source.PERIODIC:
            inner &= (grid.pixels[..., 0] > 1) & (grid.pixels[..., 0] < source.image_size[0] - 2)
        shown += int(inner.sum())
        if inner.any():
            assert np.abs(made - expected)[inner].max() < 0.7
        assert (made[~grid.valid] == 0).all()
    assert shown > 5_000


def test_the_grid_is_the_projection_of_each_pixel() -> None:
    """Pixel by pixel, with the validity of both cameras and of the source's image."""
    output = Scaramuzza.examples()[0]
    grid = sampling_grid(output, FISHEYE, torch.as_tensor(TURN))
    width, height = output.image_size
    rng = np.random.default_rng(0)
    u, v = rng.integers(0, width, 400), rng.integers(0, height, 400)
    seen_count = 0
    for column, row in zip(u.tolist(), v.tolist(), strict=True):
        bearing, seen = output.unproject(np.array([column, row], dtype=np.float64))
        pixel, imaged = FISHEYE.project(TURN @ bearing)
        inside = bool(seen and imaged and -0.5 <= pixel[0] <= 639.5 and -0.5 <= pixel[1] <= 479.5)
        assert bool(grid.valid[row, column]) == inside
        if inside:
            np.testing.assert_allclose(grid.pixels[row, column], pixel, atol=1e-4)
        seen_count += inside
    assert 100 < seen_count < 400


@pytest.mark.slow
def test_panorama_and_back() -> None:
    image = photo(FISHEYE.image_size, seed=3)
    panorama = Equirectangular([], (3000, 1500))
    there = resample(image, sampling_grid(panorama, FISHEYE))
    grid = sampling_grid(FISHEYE, panorama)
    back = resample(there, grid)
    around = cv2.erode(grid.valid.astype(np.uint8), np.ones((5, 5))).astype(bool)
    known = sampling_grid(panorama, FISHEYE).valid.astype(np.uint8) * 255
    around &= resample(known, grid) == 255
    around[:3], around[-3:], around[:, :3], around[:, -3:] = False, False, False, False
    difference = np.abs(back.astype(int) - image)[around]
    assert around.mean() > 0.8
    assert difference.mean() < 0.6 and np.percentile(difference, 99.9) <= 4


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_coarser_views_are_averages(factor: int) -> None:
    """A plain pinhole view of a plain pinhole photo at half, a quarter, an eighth of the size is cv2's mean over areas."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (320, 480, 3)).astype(np.uint8)
    source = plain_pinhole((480, 320), 300.0)
    output = plain_pinhole((480 // factor, 320 // factor), 300.0 / factor)
    grid = sampling_grid(output, source)
    np.testing.assert_allclose(grid.area, factor**2, rtol=1e-4)
    expected = cv2.resize(image, output.image_size, interpolation=cv2.INTER_AREA)
    assert np.abs(resample(image, grid).astype(int) - expected).max() <= 2
    # Without averaging, the mean of four pixels is left of however many there are.
    assert resample(image, grid, area=False).std() > 0.45 * factor * expected.std()


def test_areas_of_pixels() -> None:
    """Of a perspective view of a panorama: the pixel's solid angle over that of the panorama's pixels there, in closed form."""
    panorama, output = Equirectangular([], (4000, 2000)), plain_pinhole((200, 150), 100.0)
    grid = sampling_grid(output, panorama, looking(180.0, 20.0).T)
    u, v = np.meshgrid(np.arange(200) - 99.5, np.arange(150) - 74.5)
    solid = 1e-4 / (1 + (u**2 + v**2) / 1e4) ** 1.5
    latitude = math.pi * ((grid.pixels[..., 1] + 0.5) / 2000 - 0.5)
    expected = solid / (np.cos(latitude) * (2 * math.pi / 4000) ** 2)
    assert grid.valid.all()
    np.testing.assert_allclose(grid.area, expected, rtol=5e-3)


def test_grey_and_sixteen_bits_and_fill() -> None:
    grid = sampling_grid(plain_pinhole((900, 300), 100.0), BROWN)
    grey = photo(BROWN.image_size)[..., 0]
    deep = grey.astype(np.uint16) * 257
    eight, sixteen = resample(grey, grid, fill=7), resample(deep, grid)
    assert eight.shape == (300, 900) and eight.dtype == np.uint8 and sixteen.dtype == np.uint16
    assert (~grid.valid).any() and (eight[~grid.valid] == 7).all()
    assert np.abs(sixteen[grid.valid] / 257 - eight[grid.valid]).max() <= 0.52


def test_cylinder_against_opencv() -> None:
    """cv2's cylindrical warper, which works in single precision."""
    scale = 1001 / (2 * math.pi)
    camera = Cylindrical([scale, scale, 497.3, 240.2], (1001, 501))
    warper = cv2.PyRotationWarper("cylindrical", scale)
    rng = np.random.default_rng(4)
    for _ in range(200):
        axis = rng.standard_normal(3)
        rotation = cv2.Rodrigues(axis)[0]
        bearing = rotation[:, 2]
        if math.hypot(bearing[0], bearing[2]) < 0.3:
            continue
        u, v = warper.warpPoint((0.0, 0.0), np.eye(3, dtype=np.float32), rotation.astype(np.float32))
        pixel, valid = camera.project(bearing)
        assert valid
        difference = pixel - [u + 497.3, v + 240.2]
        difference[0] -= 1001 * round(difference[0] / 1001)
        assert np.abs(difference).max() < 2e-3


def test_part_of_a_cylinder_is_not_closed(tmp_path) -> None:
    camera = views("cylindrical", (800, 300), 200.0)[0].camera
    assert isinstance(camera, Cylindrical) and not camera.PERIODIC
    assert views("cylindrical", (800, 300))[0].camera.PERIODIC
    edge, seen = camera.unproject(np.array([[-0.5, 149.5], [799.5, 149.5]]))
    assert seen.all()
    np.testing.assert_allclose(np.degrees(np.arctan2(edge[:, 0], edge[:, 2])), [-100.0, 100.0], atol=1e-9)
    width_at_pi = math.pi * float(camera.parameters[0])
    beyond = np.array([[399.5 + width_at_pi + sign, 149.5] for sign in (-1e-3, 1e-3)])
    assert camera.unproject(beyond)[1].tolist() == [True, False]
    assert camera.project(np.array([[0.0, 0, -1], [1e-9, 0, -1], [0, 1, 0], [0, 0, 0]]))[1].tolist() == [
        False,
        True,
        False,
        False,
    ]
    save(tmp_path / "c.yaml", Calibration({"view": camera}))
    again = load(tmp_path / "c.yaml")["view"]
    assert torch.equal(again.parameters, camera.parameters) and not again.PERIODIC


def test_cube_faces_cover_the_sphere_once() -> None:
    faces = views("cube", (64, 64))
    assert [face.name for face in faces] == [name for name, _, _ in CUBE_FACES]
    rng = np.random.default_rng(0)
    bearings = rng.standard_normal((2000, 3))
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    hits = np.zeros(len(bearings), dtype=int)
    for face, axis in zip(faces, ([0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]), strict=True):
        np.testing.assert_allclose(face.view_from_axis[2], axis, atol=1e-15)
        pixels, valid = face.camera.project(bearings @ face.view_from_axis.T)
        hits += valid & (pixels > -0.5).all(-1) & (pixels < 63.5).all(-1)
    assert (hits == 1).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: views("fish"), "one of perspective, cylindrical, panorama, cube, found 'fish'"),
        (lambda: views("perspective", fov_deg=175.0), "1 to 170 degrees was expected, found 175"),
        (lambda: views("panorama", fov_deg=90.0), "360 degrees across, found 90"),
        (lambda: views("cube", (64, 32)), "square, found 64x32"),
        (lambda: sampling_grid(plain_pinhole((40000, 10), 100.0), FISHEYE), "32766 px a side"),
        (lambda: resample(np.zeros((10, 20), dtype=np.uint8), sampling_grid(FISHEYE, FISHEYE)), "640x480 px was expected"),
        (lambda: Cylindrical.from_mapping({"fx": -1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}, (4, 4)), "above 0, found -1"),
    ],
)
def test_wrong_options_are_named(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
