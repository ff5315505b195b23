"""Arcs end at corners and part where two edges meet: the kernel in closed form, and painted polygons."""

import math

import cv2
import numpy as np
import pytest

from camera_models import Pinhole
from omnilines.extraction import extract_arcs
from omnilines.extraction.kernels.bend import bend_of

CAMERA = Pinhole.from_mapping({"fx": 260.0, "fy": 260.0, "cx": 159.5, "cy": 119.5}, (320, 240))
RATE, LENGTH, NOISE_PX = 260.0, 120, 0.05
FINER = 16
"""Painted so many times finer, then averaged: pixels are squares."""


def bend(slope: float, place: int, seed: int) -> tuple[int, float, float]:
    """Of one arc whose shifts rise by `slope` a pixel from `place` on: where it bends, F, and how far the one part passes."""
    along = np.arange(LENGTH, dtype=np.float64)
    shift = slope * np.maximum(along - place, 0.0) + NOISE_PX * np.random.default_rng(seed).standard_normal(LENGTH)
    angle = (along - LENGTH / 2) / RATE
    half = np.full(LENGTH, 0.5)
    room = np.stack([-RATE * np.cos(angle), -RATE * np.sin(angle), shift, half])
    return bend_of(room, LENGTH, 8, np.empty((LENGTH + 1, 6)))


@pytest.mark.parametrize("place", [30, 80])
def test_a_bend_is_found_where_it_is(place: int) -> None:
    slope = 0.035
    for seed in range(10):
        where, ratio, off = bend(slope, place, seed)
        assert abs(where - place) <= 6
        # The shifts of the shorter part are 0 or rise; the circle through the other one passes its far end by this much.
        assert abs(off - slope * min(place, LENGTH - place)) < 0.15
        assert ratio > 100.0


def test_noise_is_no_bend() -> None:
    """F is the largest over all places: far below the limit of 20."""
    assert max(bend(0.0, 60, seed)[1] for seed in range(200)) < 12.0


def painted(corners: np.ndarray, blur_px: float = 0.5) -> np.ndarray:
    """A bright polygon (u, v) on a dark ground, as floats."""
    fine = np.zeros((240 * FINER, 320 * FINER), dtype=np.uint8)
    cv2.fillPoly(fine, [np.rint((corners + 0.5) * FINER - 0.5).astype(np.int32)], 255)
    share = cv2.resize(fine, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float64) / 255.0
    return 60.0 + 90.0 * cv2.GaussianBlur(share, None, blur_px)[..., None] * np.ones(3)


def seen(image: np.ndarray, noise: float, seed: int) -> np.ndarray:
    noisy = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return extract_arcs(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), CAMERA).endpoints_px


def nearest(ends: np.ndarray, place: tuple[float, float]) -> float:
    return float(np.linalg.norm(ends.reshape(-1, 2) - np.array(place), axis=-1).min())


@pytest.mark.parametrize("noise", [1.0, 3.0])
@pytest.mark.parametrize("bend_deg", [3.0, 20.0, 60.0])
def test_two_edges_that_nearly_go_on_are_two_arcs_that_end_at_the_corner(bend_deg: float, noise: float) -> None:
    slope = math.tan(math.radians(bend_deg))
    corner, far = (150.3, 80.7), (280.0, 80.7 + slope * 129.7)
    image = painted(np.array([(40.2, 80.7), corner, far, (280.0, 330.0), (40.2, 330.0)]))
    for seed in range(5):
        ends = seen(image, noise, seed)
        upper = ends[(ends[..., 1] < 80.7 + slope * 129.7 + 3.0).all(-1) & (np.abs(ends[:, 1, 0] - ends[:, 0, 0]) > 20.0)]
        assert len(upper) == 2
        # Beyond the corner an arc is off by the bend: what shows of that is a fraction of a pixel where it is small.
        limit = 3.0 if bend_deg >= 20.0 else 15.0
        assert all(nearest(arc, corner) < limit for arc in upper)
        flat = upper[np.abs(upper[..., 1] - 80.7).max(-1).argmin()]
        assert np.abs(flat[:, 1] - 80.7).max() < 0.4


@pytest.mark.parametrize("phase", [0.0, 0.2, 0.5, 0.8])
def test_an_edge_along_the_pixels_is_one_arc(phase: float) -> None:
    """Undersampled: on every row it looks the same, like two small steps where a pixel is shared."""
    side = 120.0 + phase
    image = painted(np.array([(side, 30.0), (260.0, 60.0), (250.0, 200.0), (side, 210.0)]), blur_px=0.4)
    for seed in range(3):
        ends = seen(image, 2.0, seed)
        assert len(ends) == 4
        upright = ends[np.abs(ends[..., 0] - side).max(-1).argmin()]
        # What the samples do not tell at a blur of 0.4 px, alike all along the edge: no average helps.
        assert np.abs(upright[:, 0] - side).max() < 0.15
