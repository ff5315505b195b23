"""What a mirror shows beside the scene, where the domain of a camera ends, and photos that went through a camera's JPEG:
against what was painted."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from camera_models import OpenCVFisheye, Pinhole, Scaramuzza
from omnilines.extraction import extract_arcs
from omnilines.extraction.kernels import step_algebra, step_edge
from omnilines.extraction.kernels.tables import Window
from omnilines.extraction.mirror import within_rim
from omnilines.extraction.options import ExtractionOptions
from omnilines.files import read_photo

MIRROR = Scaramuzza([318.2, 241.5, 0.9997, 0.0001, 0.0002, -121.0, 2.4e-3, -1.0e-6, 2.0e-9], (640, 480))
LENS = Scaramuzza([318.2, 241.5, 0.9997, 0.0001, 0.0002, 121.0, -2.4e-3, 1.0e-6, -2.0e-9], (640, 480))
FOLD = OpenCVFisheye([227.27, 226.55, 471.73, 305.88, 0.02341, -0.02145, 0.01918, -0.007075], (960, 600))
"""Pixels do not change with the bearing where it ends, 91.6 degrees off axis, 340 px from its centre."""
KNOWN_PX, RIM_PX = 150.0, 210.0


def known_rad(model: Scaramuzza) -> tuple[float, float]:
    """As far as the calibration of a mirror is known: to KNOWN_PX from its centre."""
    axis, edge = model.unproject(model.centre_px.numpy() + np.array([[0.0, 0.0], [KNOWN_PX, 0.0]]))[0]
    return 0.0, math.acos(axis @ edge)


def edge_points(share: float) -> np.ndarray:
    """Edge points anywhere and in any direction, and those of a rim around a part of all directions; float32 (n, 4)."""
    rng = np.random.default_rng(0)
    turn = rng.uniform(0.0, 2.0 * math.pi, 5000)
    loose = np.stack([*rng.uniform(0.0, [[640.0], [480.0]], (2, 5000)), np.cos(turn), np.sin(turn)], -1)
    around = 2.0 * math.pi * share * np.arange(1320) / 1320
    way = np.stack([np.cos(around), np.sin(around)], -1)
    rim = MIRROR.centre_px.numpy() + (RIM_PX + rng.normal(0.0, 0.3, (1320, 1))) * way
    return np.concatenate([loose, np.concatenate([rim, way], -1)]).astype(np.float32)


@pytest.mark.parametrize(("model", "share", "found"), [(MIRROR, 1.0, True), (MIRROR, 0.6, False), (LENS, 1.0, False)])
def test_nothing_is_of_the_scene_beyond_the_rim_of_a_mirror(model: Scaramuzza, share: float, found: bool) -> None:
    points = edge_points(share)
    inside = within_rim(model, points, known_rad(model)[1], ExtractionOptions())
    off = np.linalg.norm(points[:, :2] - model.centre_px.numpy(), axis=-1)
    assert inside[off < RIM_PX - 12.0].all()
    assert (not inside[off > RIM_PX - 2.0].any()) if found else inside.all()


def test_arcs_of_a_mirror_end_at_its_rim() -> None:
    """A bright scene with a straight edge, a dark ring around it, and a bright wall with edges behind."""
    v, u = np.mgrid[:480, :640].astype(np.float64)
    off = np.hypot(u - 318.2, v - 241.5)
    rays = MIRROR.unproject(np.stack([u, v], -1))[0]
    scene = np.where(rays @ np.array([0.6, 0.8, 0.05]) > 0.0, 200.0, 120.0)
    wall = np.where((u // 40 + v // 40) % 2 > 0, 220.0, 140.0)
    image = np.where(off < RIM_PX, scene, np.where(off < RIM_PX + 15.0, 10.0, wall))
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + np.random.default_rng(0).normal(0.0, 1.0, image.shape)
    image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    found, every = extract_arcs(image, MIRROR, None, known_rad(MIRROR)), extract_arcs(image, MIRROR)
    away = [np.linalg.norm(one.endpoints_px - MIRROR.centre_px.numpy(), axis=-1) for one in (found, every)]
    assert len(found) >= 1
    assert away[0].max() < RIM_PX
    assert (away[1] > RIM_PX).any()


def test_blurred_steps_are_those_of_the_normal_distribution() -> None:
    """Whatever the blur and the places, beyond the window too."""
    offsets = np.arange(-12, 13) * 0.5
    window = Window(0, offsets, np.exp(-0.25 * (offsets / 2.0) ** 2))
    room = step_edge._room(1, window.weight, step_edge.MOST_LANES)
    place = np.random.default_rng(0).uniform(-7.0, 7.0, room.move.here.shape)
    for blur in (0.3, 0.55, 1.2, 6.0):
        step_algebra.heights(window, place, step_algebra.MOST_STEPS, blur, room.fit)
        x = (offsets[:, None] - place[:, None]) / blur
        step, bell = window.weight[:, None] * (ndtr(x) - 0.5), window.weight[:, None] * np.exp(-0.5 * x * x)
        np.testing.assert_allclose(room.fit.design[1:], step, rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(room.fit.slope, -bell / (blur * math.sqrt(2.0 * math.pi)), rtol=0.0, atol=1e-9)


def test_what_sharpening_and_jpeg_leave_beside_an_edge_is_no_edge() -> None:
    """Bars in many directions, as they are and as a phone makes them: about one arc for each side of a bar."""
    model, noise = (
        Pinhole.from_mapping({"fx": 700.0, "fy": 700.0, "cx": 449.5, "cy": 299.5}, (900, 600)),
        np.random.default_rng(0),
    )
    image = np.full((4 * 600, 4 * 900, 3), 90.0, dtype=np.float32)
    for k in range(24):
        corner = np.array([80 + 145 * (k % 6), 80 + 145 * (k // 6)]) * 4.0
        box = cv2.boxPoints((corner.tolist(), (4.0 * 30, 4.0 * 100), 7.3 * k))
        cv2.fillPoly(image, [np.rint(box).astype(np.int32)], (150.0 + 2 * k, 60.0 + 3 * k, 200.0 - 3 * k))
    image = cv2.resize(cv2.GaussianBlur(image, (0, 0), 2.0), (900, 600), interpolation=cv2.INTER_AREA)
    drawn = np.clip(np.rint(image + noise.normal(0.0, 2.0, image.shape)), 0, 255).astype(np.uint8)
    calm = cv2.bilateralFilter(drawn, 5, 12.0, 1.5).astype(np.float32)
    sharp = np.clip(np.rint(calm + 0.8 * (calm - cv2.GaussianBlur(calm, (0, 0), 1.0))), 0, 255).astype(np.uint8)
    phone = cv2.imdecode(cv2.imencode(".jpg", sharp, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], cv2.IMREAD_COLOR)
    counts = [len(extract_arcs(one, model, options=ExtractionOptions(min_length_px=20.0))) for one in (drawn, phone)]
    assert counts == pytest.approx([96, 96], abs=8)


@pytest.mark.parametrize(("inside_px", "arcs"), [(0.0, 0), (1.0, 1)])
def test_an_arc_along_the_end_of_the_domain_of_a_camera_is_none(inside_px: float, arcs: int) -> None:
    """There a pixel is a degree and more, and an end point would be stated to be known exactly."""
    u = np.tile(np.arange(960.0), (600, 1))
    image = cv2.GaussianBlur(np.where(u > 131.66 + inside_px, 200.0, 100.0), (0, 0), 0.7)
    image = np.rint(image + np.random.default_rng(0).normal(0.0, 1.0, u.shape)).astype(np.uint8)
    found = extract_arcs(image, FOLD)
    assert len(found) == arcs
    assert (np.linalg.eigvalsh(found.covariance_px2) > 1e-3).all()


def test_ends_of_arcs_in_real_photos_that_reach_the_end_of_the_domain_are_uncertain(shared_data: Path) -> None:
    found = extract_arcs(read_photo(shared_data / "rigs" / "stereo_fisheye" / "left" / "left8.jpg"), FOLD)
    assert len(found) > 100
    assert (np.linalg.eigvalsh(found.covariance_px2) > 1e-4).all()
