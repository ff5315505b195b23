"""Colours beside arcs in drawn photos, whose colours on both sides of great circles are known."""

import math

import numpy as np
import pytest

from camera_models import CameraModel
from camera_models.equirectangular import Equirectangular
from omnilines.geometry.sphere import points_on_arc
from omnilines.matching.appearance import side_colours
from omnilines.matching.options import AppearanceOptions
from omnilines.synthetic.targets import example_camera

FIRST, SECOND = np.array([40.0, 90.0, 200.0]), np.array([220.0, 0.0, 60.0])
"""Blue, green and red towards the normal of a circle, and on its other side."""
MODELS = {"fisheye": ("opencv-fisheye", 190.0), "scaramuzza": ("scaramuzza", 220.0), "pinhole": ("pinhole", 100.0)}


def camera(name: str) -> CameraModel:
    if name == "panorama":
        return Equirectangular([], (720, 360))
    return example_camera(*MODELS[name], (640, 480), 3)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def drawn(model: CameraModel, normal: np.ndarray) -> np.ndarray:
    """The photo of a world in two colours, (h, w, 3) of 8 bits."""
    width, height = model.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    bearings, _ = model.unproject(pixels)
    return np.where((bearings @ normal)[..., None] > 0, FIRST, SECOND).astype(np.uint8)


def arc(model: CameraModel, seed: int, length_rad: float = 0.3) -> np.ndarray:
    """Ends of an arc that the photo holds, with room beside it."""
    rng = np.random.default_rng(seed)
    size = np.array(model.image_size)
    while True:
        first, along = unit(rng.standard_normal((2, 3)))
        ends = np.stack([first, math.cos(length_rad) * first + math.sin(length_rad) * unit(np.cross(first, along))])
        pixels, valid = model.project(points_on_arc(ends[0], ends[1], np.linspace(0.0, 1.0, 30)))
        if valid.all() and ((pixels > 8) & (pixels < size - 9)).all():
            return ends


def expected(*sides: np.ndarray) -> np.ndarray:
    return np.log(np.stack(sides) + AppearanceOptions().dark_grey)


@pytest.mark.parametrize("name", [*MODELS, "panorama"])
def test_sides_have_their_colours_in_order(name: str) -> None:
    model, seen = camera(name), []
    for seed in range(5):
        ends = arc(model, seed)
        image = drawn(model, np.cross(*ends))
        both = np.stack([ends, ends[::-1]])
        found = side_colours(image, model, both)
        np.testing.assert_allclose(found, np.stack([expected(FIRST, SECOND), expected(SECOND, FIRST)]), atol=1e-9)
        sixteen = side_colours(image.astype(np.uint16) * 257, model, both)
        np.testing.assert_allclose(sixteen, found, atol=1e-9)
        for grey in (image[..., 2], image[..., 2:]):
            alone = side_colours(np.ascontiguousarray(grey), model, both)
            np.testing.assert_array_equal(alone, np.repeat(found[..., 2:], 3, -1))
        seen.append(math.degrees(math.acos(ends.mean(0)[2] / np.linalg.norm(ends.mean(0)))))
    assert max(seen) > {"fisheye": 60, "scaramuzza": 80, "pinhole": 20, "panorama": 100}[name]


@pytest.mark.parametrize("turn_deg", [-90.0, -89.9999, 0.0, 30.0, 89.9999, 90.0])
def test_arcs_at_and_across_the_seam_of_a_panorama(turn_deg: float) -> None:
    """Circles through the bearing behind the camera, from upright ones, along the seam, to level ones, which cross it."""
    model, behind = camera("panorama"), np.array([0.0, 0.0, -1.0])
    turn = math.radians(turn_deg)
    along = np.array([math.cos(turn), math.sin(turn), 0.0])
    if abs(turn_deg) == 90.0:
        along = np.array([0.0, math.copysign(1.0, turn_deg), 0.0])
    ends = np.stack([math.cos(0.3) * behind - math.sin(0.3) * along, math.cos(0.3) * behind + math.sin(0.3) * along])
    pixels, _ = model.project(points_on_arc(ends[0], ends[1], np.linspace(0.0, 1.0, 30)))
    assert (np.minimum(pixels[:, 0] + 0.5, model.image_size[0] - 0.5 - pixels[:, 0]) < 40).all()
    both = np.stack([ends, ends[::-1]])
    found = side_colours(drawn(model, np.cross(*ends)), model, both)
    np.testing.assert_allclose(found, np.stack([expected(FIRST, SECOND), expected(SECOND, FIRST)]), atol=1e-9)


@pytest.mark.parametrize("name", ["fisheye", "pinhole"])
def test_a_side_beyond_the_border_has_no_colour(name: str) -> None:
    model = camera(name)
    width, height = model.image_size
    for row, known in ((1.0, 1), (0.25 * height, 2), (-8.0, 0)):
        ends, _ = model.unproject(np.array([[0.45 * width, row], [0.55 * width, row]]))
        image = drawn(model, np.cross(*ends))
        found = side_colours(image, model, np.stack([ends, ends[::-1]]))
        assert int((~np.isnan(found[0])).all(-1).sum()) == known
        assert bool((np.isnan(found).all(-1) == np.isnan(found).any(-1)).all())
        np.testing.assert_array_equal(found[1], found[0, ::-1])
        there = ~np.isnan(found[0])
        np.testing.assert_allclose(found[0][there], expected(FIRST, SECOND)[there], atol=1e-9)


def test_a_spot_on_one_side_does_not_count_and_a_dark_side_is_finite() -> None:
    model = camera("fisheye")
    ends = arc(model, 5, 0.4)
    normal = unit(np.cross(*ends))
    image = np.where(drawn(model, normal)[..., :1] == int(FIRST[0]), 0, 255).repeat(3, -1).astype(np.uint8)
    share = 0.3
    spot, _ = model.project(unit((1 - share) * ends[0] + share * ends[1] + 0.02 * normal))
    u, v = np.round(spot).astype(int)
    image[v - 6 : v + 7, u - 6 : u + 7] = 90
    found = side_colours(image, model, ends[None])
    np.testing.assert_allclose(found[0], expected(np.zeros(3), np.full(3, 255.0)), atol=0.02)


def test_arcs_of_any_number_are_read_one_by_one() -> None:
    """More places than an image of OpenCV has rows; none at all; and each as if it were alone."""
    model = camera("panorama")
    rng = np.random.default_rng(6)
    image = rng.integers(0, 256, (360, 720, 3)).astype(np.uint8)
    first = unit(rng.standard_normal((700, 3)))
    ends = np.stack([first, unit(first + 0.2 * rng.standard_normal((700, 3)))], 1)
    found = side_colours(image, model, ends)
    assert found.shape == (700, 2, 3) and np.isfinite(found).all()
    for k in (0, 1, 350, 699):
        np.testing.assert_array_equal(side_colours(image, model, ends[k : k + 1])[0], found[k])
    assert side_colours(image, model, ends[:0]).shape == (0, 2, 3)
