"""Arcs of panoramas that end at a pole, pass over it or beside it, or cross the seam, are arcs like others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import omnilines as ol
from camera_models import Calibration, Equirectangular, InputError
from camera_models.pose import Pose
from omnilines.files import photos_of
from omnilines.pages.arcs import arcs_summary
from omnilines.pipelines.options import OF_TABLES
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.pipelines.scene import Scene
from omnilines.records import ImagePoses, Segments
from omnilines.report.line_scene import line_curves

PANORAMA = Equirectangular([], (2048, 1024))
SIGMA_PX = 0.2
PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.3, 0.2], [-0.8, 0.1, 1.1], [0.5, -0.2, -1.0]])
POSES = Pose(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), -torch.as_tensor(PLACES))


def seen(ends_m: np.ndarray, seed: int) -> np.ndarray:
    """The ends of lines in all panoramas, with noise; what lies in the direction of a pole of the first is put into its row."""
    pixels, valid = PANORAMA.project(ends_m - PLACES[:, None, None])
    rows = np.where(ends_m[..., 1] < 0, -0.5, 1023.5)
    pixels[..., 1] = np.where(valid, pixels[..., 1], rows)
    noisy = pixels + SIGMA_PX * np.random.default_rng(seed).standard_normal(pixels.shape)
    noisy[..., 1] = np.where(valid, noisy[..., 1].clip(-0.5, 1023.5), rows)
    return noisy


def table(pixels: np.ndarray) -> Segments:
    count = pixels.shape[1]
    every = np.repeat(np.arange(len(pixels)), count), np.tile(np.arange(count), len(pixels))
    return ol.segments_of_arrays(pixels.reshape(-1, 2, 2), *every, sigma_px=np.full(count * len(pixels), SIGMA_PX))


def adjusted(pixels: np.ndarray, cost: str = "whitened") -> Scene:
    return ol.adjust(table(pixels), POSES, PANORAMA, replace(OF_TABLES, cost=cost))


def others(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-3, -1.9, -3], [3, 1.5, 3], (8, 2, 3))


@pytest.mark.parametrize("beside", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("up", [1.0, -1.0])
@pytest.mark.parametrize("begins", [0.0, -1.0], ids=["ends there", "passes over"])
def test_arcs_at_a_pole_are_lines(beside: float, up: float, begins: float) -> None:
    """Lines through the zenith or below the first camera came out as `parallel_planes`."""
    line = np.array([[2 * beside, -2 * up, begins], [2 * beside, -2 * up, 1.5]])
    scene = adjusted(seen(np.concatenate([line[None], others(3)]), 4))
    assert scene.lines.status[0] == "ok"
    off = np.linalg.norm(np.cross(scene.lines.ends_m[0] - line[0], [0.0, 0.0, 1.0]), axis=-1)
    assert 1e-4 < scene.lines.sigma_m[0] < 0.02
    assert (off < 3 * scene.lines.sigma_m[0]).all()


@pytest.mark.parametrize("beside", [0.0, 1e-9])
def test_the_length_of_an_arc_over_a_pole_is_finite(beside: float) -> None:
    """A third of the cost stands at the middle of an arc, here at the pole, where the image runs around it."""
    line = np.array([[2 * beside, -2.0, -1.0], [2 * beside, -2.0, 1.0]])
    exact = PANORAMA.project(np.concatenate([line[None], others(3)]) - PLACES[:, None, None])[0]
    scene = adjusted(exact, "taylor-kriegman")
    assert scene.lines.status[0] == "ok"
    assert 1e-5 < scene.lines.sigma_m[0] < 0.02


def test_bearings_change_at_a_pole_as_in_its_row_of_pixels() -> None:
    """The derivative is that of `unproject` from the first row on, and of full rank beyond."""
    u = torch.tensor([-0.5, 100.3, 1023.5, 2047.2], dtype=torch.float64)
    for row, way in ((0.0, -1.0), (1023.0, 1.0)):
        pixels = torch.stack([u, torch.full_like(u, row)], -1)
        exact = torch.autograd.functional.jacobian(lambda p: PANORAMA.unproject(p)[0].sum(0), pixels).permute(1, 0, 2)
        torch.testing.assert_close(PANORAMA.unproject_jacobian(pixels), exact, rtol=1e-9, atol=1e-15)
        pole = PANORAMA.unproject_jacobian(pixels + torch.tensor([0.0, 0.5 * way]))
        torch.testing.assert_close(pole[..., 0], exact[..., 0], rtol=1e-9, atol=1e-15)
        longitude = np.pi * ((u + 0.5) / 1024 - 1)
        inwards = torch.stack([torch.sin(longitude), 0 * u, torch.cos(longitude)], -1)
        torch.testing.assert_close(pole[..., 1], -way * inwards * np.pi / 1024, rtol=0, atol=1e-12)


def across_the_seam() -> np.ndarray:
    """Lines behind all cameras, that go from one side of the panoramas to the other."""
    return np.array([[[-1.0, 0.2, -3.0], [1.2, -0.5, -2.5]], [[0.9, 1.0, -4.0], [-1.1, 0.4, -3.0]]])


def test_segments_may_cross_the_seam_or_go_on_beyond_it() -> None:
    pixels = seen(np.concatenate([across_the_seam(), others(5)]), 6)
    assert (np.abs(np.diff(pixels[:, :2, :, 0], axis=-1)) > 1024).any(1).all()
    wrapped = adjusted(pixels).lines
    beyond = pixels.copy()
    beyond[..., 0] += np.where(beyond[..., 0] < 1024, 2048.0, 0.0)
    gone_on = adjusted(beyond).lines
    assert wrapped.status[:2] == gone_on.status[:2] == ("ok", "ok")
    np.testing.assert_allclose(gone_on.ends_m, wrapped.ends_m, rtol=0, atol=1e-7)
    beyond[0, 0, 0, 1] = 1200.0
    with pytest.raises(InputError, match="Segments inside the image of 2048x1024 px"):
        adjusted(beyond)


def test_curves_break_at_the_seam() -> None:
    pixels = seen(np.concatenate([across_the_seam(), others(5)]), 6)
    scene, segments = adjusted(pixels), table(pixels)
    poses = ImagePoses(segments.images, POSES)
    for curve in line_curves(scene.lines, segments, poses, {"cam0": PANORAMA}):
        step = np.abs(np.diff(curve.pixels[:, 0]))
        assert (step[np.isfinite(step)] < 600).all()
        if curve.label in ("0", "1") and curve.image == "0":
            assert np.isnan(curve.pixels[1:-1, 0]).sum() == 1


def test_how_well_ends_are_known_is_told_across_the_arc_and_not_across_its_chord() -> None:
    """An arc that falls over the seam: between its two ends in the image lies nearly the whole width."""
    slope = np.array([[1.0, 1.0], [1.0, 1.0]]) / 2
    covariance = np.broadcast_to(1.0 * slope + 0.1**2 * (np.eye(2) - slope), (1, 2, 2, 2))
    ends = np.array([[[2040.0, 505.0], [5.0, 518.0]]])
    (photo,) = photos_of({"a": np.zeros((1024, 2048), dtype=np.uint8)})
    found = FoundArcs(photo, "cam0", ends, covariance, np.array([18.4]), np.full((1, 2, 3), np.nan))
    arcs = PhotoArcs((found,), Calibration({"cam0": PANORAMA}))
    assert "known to 0.1 px across" in arcs_summary(arcs, Path("segments.csv")).verdict
