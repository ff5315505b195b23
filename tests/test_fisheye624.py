"""Decentred lenses and lenses behind a plate: where their map of the plane is one-to-one, and what `auto` makes of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from board_views import board_corners, board_views

import camera_models
from camera_models import Calibration, CameraModel, Fisheye624, InputError, OpenCVFisheye, Scaramuzza
from camera_models._thin_prism import displaced, one_to_one_until, replaced
from camera_models.formats import format_named, read
from camera_models.formats.transfer import transfer
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.select import Candidate, select_model
from omnilines.calibration.uncertainty import supported_grid
from omnilines.records import Corners

SIZE = (1280, 960)
LENS = OpenCVFisheye([320.0, 320.0, 645.0, 470.0, -0.03, 0.0, 0.0, 0.0], SIZE)
REACH_DEG, NOISE_PX = 98.0, 0.1
TERMS = [
    tuple(map(float, terms))
    for terms in (
        (3e-3, -2e-3, 0, 0, 0, 0),
        (0, 0, 4e-3, 0, -1e-3, 0),
        (-0.02, 0.03, 0.05, -0.01, -0.04, 0.02),
        (0, 0, 0, 0.01, 0, 0.02),
    )
]


def least_eigenvalue(terms: tuple[float, ...], radius: float) -> float:
    """Of the symmetric part of the Jacobian of T, over all directions at a radius."""
    phi = torch.linspace(0, 2 * math.pi, 3601, dtype=torch.float64)
    at = displaced(terms, radius * torch.cos(phi), radius * torch.sin(phi))
    mean, half = (at.xx + at.yy) / 2, (at.xx - at.yy) / 2
    return float((mean - torch.hypot(half, (at.xy + at.yx) / 2)).min())


@pytest.mark.parametrize("terms", TERMS)
def test_the_map_of_the_plane_is_one_to_one_as_far_as_it_says(terms: tuple[float, ...]) -> None:
    radius = one_to_one_until(terms)
    assert all(least_eigenvalue(terms, share * radius) > 0 for share in np.linspace(0.0, 0.9999, 200))
    if terms[3] == terms[5] == 0:
        # Without terms of the fourth power the bound is met.
        assert abs(least_eigenvalue(terms, radius)) < 1e-5
    rng = np.random.default_rng(0)
    angle, length = rng.uniform(-np.pi, np.pi, 500), 0.999 * radius * np.sqrt(rng.uniform(0, 1, 500))
    d = torch.as_tensor(np.stack([length * np.cos(angle), length * np.sin(angle)], -1))
    at = displaced(terms, d[:, 0], d[:, 1])
    back, found = replaced(terms, radius, torch.stack([at.x, at.y], -1))
    assert bool(found.all()) and float((back - d).abs().max()) < 1e-8 * radius
    beyond, found = replaced(terms, 0.5 * radius, torch.stack([at.x, at.y], -1))
    inside = d.norm(dim=-1) < 0.5 * radius
    assert torch.equal(found, inside) and float(beyond.norm(dim=-1).max()) <= 0.5 * radius * (1 + 1e-12)


def test_without_terms_it_ends_nowhere_and_wild_ones_leave_nothing() -> None:
    assert one_to_one_until([0.0] * 6) == math.inf
    assert one_to_one_until([1e200, 0.0, 0.0, 1e308, 0.0, 1e308]) == 0.0
    assert 0 < one_to_one_until([0.0, 0.0, 0.0, 1e-30, 0.0, 0.0]) < math.inf


def decentred(views: int, seed: int) -> tuple[Corners, np.ndarray, np.ndarray]:
    """Corners of a board by a lens of 200 degrees whose elements do not share an axis (Brown 1966, with the angle in place of the
    radius): 3 theta^2 (a . c) outwards, theta^2 (a x c) around; and bearings all over its image with their pixels."""
    shift = np.array([0.003, -0.002])

    def displacement(bearings: np.ndarray) -> np.ndarray:
        theta = np.arctan2(np.hypot(bearings[:, 0], bearings[:, 1]), bearings[:, 2])
        a = bearings[:, :2] / np.maximum(np.hypot(bearings[:, 0], bearings[:, 1]), 1e-12)[:, None]
        around = np.stack([-a[:, 1], a[:, 0]], -1)
        return 320.0 * theta[:, None] ** 2 * (3 * (a @ shift)[:, None] * a + (around @ shift)[:, None] * around)

    corners = board_corners(LENS, board_views(LENS, REACH_DEG, views, seed), 0.0, 0)
    noise = NOISE_PX * np.random.default_rng(seed).standard_normal(corners.pixels.shape)
    pixels = corners.pixels + displacement(LENS.unproject(corners.pixels)[0]) + noise
    grid = supported_grid(LENS, math.radians(REACH_DEG))
    bearings = LENS.unproject(grid)[0].numpy()
    seen = Corners(corners.view, corners.view_names, corners.images, corners.board_m, pixels)
    return seen, bearings, grid.numpy() + displacement(bearings)


def off_px(camera: CameraModel, bearings: np.ndarray, pixels: np.ndarray) -> float:
    """Root mean square over the image after the best turn."""
    known = torch.as_tensor(bearings)
    said, valid = camera.unproject(torch.as_tensor(pixels))
    u, _, v = torch.linalg.svd(said[valid].mT @ known[valid])
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ v))], dtype=torch.float64)) @ v
    return float((camera.project(known[valid] @ turn.mT)[0] - torch.as_tensor(pixels)[valid]).square().sum(-1).mean().sqrt())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_decentred_fisheye_is_followed_where_radial_models_are_not(seed: int) -> None:
    corners, bearings, pixels = decentred(12, seed)
    radial = [Candidate("opencv-fisheye", {}), Candidate("double-sphere", {}), Candidate("scaramuzza", {"degree": 5})]
    without = select_model(corners, SIZE, candidates=radial)
    chosen = select_model(corners, SIZE, candidates=[*radial, Candidate("fisheye624", {"coefficients": 6})])
    assert isinstance(chosen.result.model, Fisheye624)
    assert chosen.result.rms_px_per_axis < 1.1 * NOISE_PX
    assert off_px(chosen.result.model, bearings, pixels) < 0.3 * off_px(without.result.model, bearings, pixels)


def test_how_many_coefficients_are_estimated_goes_by_what_is_there() -> None:
    named = {"fx": 300.0, "fy": 300.0, "cx": 640.0, "cy": 480.0, "k0": 0.01, "p0": 1e-3}
    estimated = {}
    for more in ({}, {"s2": 1e-4}, {"s3": 1e-4}, {"k5": 1e-4}):
        camera = Fisheye624.from_mapping({**named, **more}, SIZE)
        estimated[tuple(more)] = camera.coefficients, camera.calibration_basis().shape[1]
    assert estimated == {(): (6, 10), ("s2",): (8, 12), ("s3",): (12, 16), ("k5",): (12, 16)}
    with pytest.raises(InputError, match="6, 8 or 12 distortion coefficients, found 5"):
        Fisheye624(camera.parameters, SIZE, 5)
    with pytest.raises(InputError, match="`coefficients` of fisheye624 was expected to be 6, 8 or 12, found 5"):
        CalibrationOptions(model="fisheye624", coefficients=5).require_of_models(["fisheye624"])
    with pytest.raises(InputError, match="`coefficients` of pinhole was expected to be 0, 5 or 8, found 6"):
        CalibrationOptions(model="pinhole", coefficients=6).require_of_models(["pinhole"])


@pytest.mark.parametrize(("target", "known"), [("colmap", "OPENCV_FISHEYE"), ("nerfstudio", "OPENCV_FISHEYE")])
def test_other_cameras_are_fitted_by_it_only_on_request(target: str, known: str, tmp_path: Path) -> None:
    """Few programs that read these formats know it."""
    writer = format_named(target)
    given = Calibration({"cam0": Scaramuzza.examples()[0]})
    path = tmp_path / f"camera{writer.SUFFIXES[0]}"
    assert transfer(given, writer, path, fov_deg=150).forms["cam0"].name == known
    asked = transfer(given, writer, path, model="fisheye624", fov_deg=150)
    assert isinstance(asked.calibration["cam0"], Fisheye624)
    assert asked.conversions["cam0"].rms_px < transfer(given, writer, path, fov_deg=150).conversions["cam0"].rms_px
    own = Calibration({"cam0": Fisheye624.examples()[0]})
    assert not transfer(own, writer, path).conversions


def test_nerfstudio_lists_its_terms(tmp_path: Path) -> None:
    camera = Fisheye624.examples()[0]
    path = tmp_path / "transforms.json"
    format_named("nerfstudio").write(path, Calibration({"cam0": camera}))
    keys = json.loads(path.read_text())
    assert keys["camera_model"] == "FISHEYE624" and keys["distortion_params"] == camera.parameters[4:].tolist()
    assert keys["cx"] == float(camera.parameters[2]) + 0.5 and "k1" not in keys
    (again,) = read(path).calibration.values()
    assert again.named_parameters() == camera.named_parameters()
    path.write_text(json.dumps({**keys, "camera_model": "OPENCV_FISHEYE"}))
    with pytest.raises(InputError, match="distortion_params were expected of a camera FISHEYE624, found those of OPENCV_FISHEYE"):
        read(path)
    path.write_text(json.dumps({**keys, "distortion_params": [0.0] * 6}))
    with pytest.raises(InputError, match="distortion_params"):
        read(path)


def test_it_is_kept_in_our_own_files(tmp_path: Path) -> None:
    for index, camera in enumerate(Fisheye624.examples()):
        camera_models.save(tmp_path / f"{index}.yaml", Calibration({"cam0": camera}))
        again = camera_models.load(tmp_path / f"{index}.yaml")["cam0"]
        assert isinstance(again, Fisheye624) and again.named_parameters() == camera.named_parameters()
