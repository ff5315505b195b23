"""Conversion between camera models: closed-form identities, errors recomputed on every pixel, and what a target cannot hold."""

import math

import numpy as np
import pytest
import torch

from camera_models import (
    DoubleSphere,
    Equirectangular,
    ExtendedUnified,
    InputError,
    OpenCVFisheye,
    Pinhole,
    Scaramuzza,
    Unified,
    convert,
)
from camera_models.fitting import refine

SIZE = (1280, 960)
STEREOGRAPHIC = Unified([300.0, 302.0, 640.0, 470.0, 0, 1.0, 0, 0, 0, 0], SIZE)
FISHEYE = OpenCVFisheye.examples()[0]


@pytest.mark.parametrize(
    ("source", "target", "expected"),
    [
        # r = s / (z + n) = (s / (n / 2 + z / 2)) / 2: the unified model with xi = 1 is alpha = 1/2 and xi = 0 of the others.
        (STEREOGRAPHIC, "extended-unified", {"fx": 150.0, "fy": 151.0, "alpha": 0.5, "beta": 1.0}),
        (STEREOGRAPHIC, "double-sphere", {"fx": 150.0, "fy": 151.0, "alpha": 0.5, "xi": 0.0}),
        (
            ExtendedUnified([200.0, 201.0, 640.0, 470.0, 0.6, 1.0], SIZE),
            "unified",
            {"fx": 500.0, "fy": 502.5, "xi": 1.5, "k1": 0.0},
        ),
        # tan(theta / 2) = rho / f: z = s (f^2 - rho^2) / (2 f rho), a parabola.
        (
            Unified([300.0, 300.0, 640.0, 470.0, 0, 1.0, 0, 0, 0, 0], SIZE),
            "scaramuzza",
            {"a0": 150.0, "a2": -1 / 600, "a4": 0, "c": 1},
        ),
        (
            Pinhole([900.0, 905.0, 630.0, 470.0, 1.5, *[0.0] * 8], SIZE),
            "scaramuzza",
            {"a0": 900.0, "c": 905 / 900, "a2": 0, "d": 0},
        ),
        (Pinhole([900.0, 905.0, 630.0, 470.0, 1.5, *[0.0] * 8], SIZE), "pinhole", {"fx": 900.0, "skew": 1.5, "k1": 0.0}),
    ],
)
def test_models_that_hold_each_other_exactly(source, target, expected):
    result = convert(source, target, 160 if isinstance(source, Unified | ExtendedUnified) else None)
    named = result.model.named_parameters()
    assert result.model.NAME == target
    for name, value in expected.items():
        assert math.isclose(named[name], value, rel_tol=1e-5, abs_tol=1e-5), (name, named[name])
    assert result.max_px < 1e-5 and result.max_deg < 1e-5


def test_a_slanted_chip_needs_no_rotation():
    """e and d are told apart, though a calibration with free poses cannot: the bearings are given."""
    source = Scaramuzza.examples()[1]
    result = convert(source, "scaramuzza", 190, degree=4)
    np.testing.assert_allclose(result.model.parameters, source.parameters, rtol=1e-5, atol=1e-9)
    assert result.max_px < 1e-6


@pytest.mark.parametrize("target", ["opencv-fisheye", "scaramuzza", "unified", "extended-unified", "double-sphere"])
@pytest.mark.parametrize("source", [FISHEYE, Unified.examples()[0], DoubleSphere.examples()[1]], ids=lambda m: m.NAME)
def test_errors_are_those_of_every_pixel_in_the_field_of_view(source, target):
    result = convert(source, target, 190)
    assert 188 < result.fov_deg <= 190
    w, h = source.image_size
    pixels = np.stack(np.meshgrid(np.arange(0.0, w, 3), np.arange(0.0, h, 3)), -1).reshape(-1, 2)
    bearings, valid = source.unproject(pixels)
    axis = source.unproject(source.centre_px.numpy())[0]
    use = valid & (np.degrees(np.arccos(np.clip(bearings @ axis, -1, 1))) <= 190 / 2)
    projected, imaged = result.model.project(bearings[use])
    again, seen = result.model.unproject(pixels[use])
    assert imaged.all() and seen.all()
    off_px = np.linalg.norm(projected - pixels[use], axis=-1)
    off_deg = np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(again - bearings[use], axis=-1) / 2, 0, 1)))
    for found, expected in (
        (result.rms_px, np.sqrt(np.mean(off_px**2))),
        (result.max_px, off_px.max()),
        (result.rms_deg, np.sqrt(np.mean(off_deg**2))),
        (result.max_deg, off_deg.max()),
    ):
        assert abs(found - expected) < 0.05 * expected + 1e-6
    assert result.rms_px <= 0.5


def test_wide_conversions_stay_below_a_fifth_of_a_pixel():
    """What the models are for: 220 degrees of a 220 degree lens, there and back."""
    source = OpenCVFisheye.examples()[1]
    there = convert(source, "double-sphere", 220)
    back = convert(there.model, "opencv-fisheye", 220)
    assert there.rms_px < 1 and back.rms_px < 0.2
    assert abs(back.model.parameters[0] - source.parameters[0]) < 0.05 * source.parameters[0]


@pytest.mark.parametrize("index", range(3))
def test_double_sphere_minima_are_all_tried(index):
    """From the other minimum a fit ends there; the rivals of that fit lead to the truth."""
    truth = DoubleSphere.examples()[index]
    rng = np.random.default_rng(index)
    theta, phi = rng.uniform(0, math.radians(95), 2000), rng.uniform(-math.pi, math.pi, 2000)
    bearings = torch.as_tensor(np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1))
    pixels = truth.project(bearings)[0]
    rivals = truth.rivals(math.radians(95))
    assert rivals
    elsewhere = [refine(rival, bearings, pixels) for rival in rivals]
    trapped = [fit for fit in elsewhere if float((fit.project(bearings)[0] - pixels).norm(dim=-1).mean()) > 1e-3]
    assert trapped
    for fit in trapped:
        home = [refine(rival, bearings, pixels) for rival in fit.rivals(math.radians(95))]
        best = min(home, key=lambda model: float((model.project(bearings)[0] - pixels).norm()))
        np.testing.assert_allclose(best.parameters, truth.parameters, rtol=1e-6)


def test_a_panorama_is_fitted_over_a_narrow_field_only():
    """No lens has the panorama's two axes: the error says so."""
    source = Equirectangular([], (2048, 1024))
    narrow, wide = convert(source, "pinhole", 20), convert(source, "opencv-fisheye", 100)
    assert narrow.max_px < 0.5 < wide.rms_px
    assert abs(narrow.model.parameters[0] - 2048 / (2 * math.pi)) < 5


@pytest.mark.parametrize(
    ("source", "target", "fov", "message"),
    [
        (FISHEYE, "pinhole", 190, r"pinhole was expected to hold a field of view of 190 degrees.*below 180"),
        (FISHEYE, "pinhole", 178, r"pinhole was expected to hold a field of view of 178 .*best fit holds 12\d degrees at most"),
        (Scaramuzza.examples()[2], "unified", 190, "unified was expected to hold.*a mirror that looks along -z"),
        (Scaramuzza.examples()[2], "opencv-fisheye", 120, "a mirror that looks along -z"),
        (FISHEYE, "equirectangular", 100, "is not calibrated"),
        (FISHEYE, "fish", 100, "found 'fish'"),
        (FISHEYE, "scaramuzza", 0, "above 0 and up to 360 degrees was expected, found 0"),
        (FISHEYE, "scaramuzza", 400, "found 400"),
        (FISHEYE, "scaramuzza", math.nan, "found nan"),
        (Pinhole([600.0, 600.0, -500.0, 200.0, *[0.0] * 9], (640, 480)), "scaramuzza", 20, "give a wider one"),
    ],
)
def test_what_cannot_be_converted(source, target, fov, message):
    with pytest.raises(InputError, match=message):
        convert(source, target, fov)


@pytest.mark.parametrize(("source", "target"), [(DoubleSphere.examples()[1], "unified"), (FISHEYE, "extended-unified")])
@pytest.mark.slow
def test_all_is_converted_that_the_target_holds(source, target):
    """Beyond what it names every fit leaves out pixels; within, each pixel is imaged, and asking for it gives the same fit."""
    found = convert(source, target)
    assert found.holds_deg is not None and found.holds_deg - 2 < found.fov_deg <= found.holds_deg
    with pytest.raises(InputError, match=f"holds {found.holds_deg} degrees at most; give a smaller one"):
        convert(source, target, found.holds_deg + 1)
    again = convert(source, target, found.holds_deg)
    assert torch.equal(again.model.parameters, found.model.parameters) and again.holds_deg is None
    w, h = source.image_size
    pixels = np.stack(np.meshgrid(np.arange(0.0, w, 5), np.arange(0.0, h, 5)), -1).reshape(-1, 2)
    bearings, valid = source.unproject(pixels)
    axis = source.unproject(source.centre_px.numpy())[0]
    use = valid & (np.degrees(np.arccos(np.clip(bearings @ axis, -1, 1))) <= found.fov_deg / 2 - 1)
    assert found.model.project(bearings[use])[1].all() and found.model.unproject(pixels[use])[1].all()


def test_parameters_that_are_held():
    """They keep their values, the others are at the minimum that is left, and a tie (e = d) is cut where one side is held."""
    source = Pinhole.examples()[0]
    held = {"skew": 0.0, "k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 0.0}
    result = convert(source, "pinhole", held=held)
    named = result.model.named_parameters()
    assert all(named[name] == value for name, value in held.items()) and named["k2"] != source.named_parameters()["k2"]
    free = convert(source, "pinhole")
    assert free.rms_px < 1e-9 < result.rms_px
    pixels = torch.as_tensor(np.random.default_rng(0).uniform([0, 0], source.image_size, (500, 2)))
    bearings = source.unproject(pixels)[0]
    _, _, _, by_parameter = result.model.project_with_jacobians(bearings)
    off = (result.model.project(bearings)[0] - pixels).flatten()
    for name in ("fx", "cx", "k1", "k2", "p1"):
        column = by_parameter[..., result.model.PARAMETER_NAMES.index(name)].flatten()
        assert abs(float(column @ off)) < 0.1 * float(column.norm() * off.norm()), name
    slanted = convert(Scaramuzza.examples()[1], "scaramuzza", 150, {"d": 0.0, "e": 0.0}, degree=2)
    assert slanted.model.named_parameters()["d"] == slanted.model.named_parameters()["e"] == 0.0
    assert slanted.model.named_parameters()["c"] != 1.0


def test_rings_of_the_field_of_view():
    result = convert(FISHEYE, "double-sphere", 120)
    edges = [(ring.from_deg, ring.to_deg) for ring in result.rings]
    assert edges == [(5.0 * k, 5.0 * k + 5.0) for k in range(12)]
    weight = np.array([ring.pixels for ring in result.rings])
    for whole, part in (("rms_px", "rms_px"), ("rms_deg", "rms_deg")):
        squared = np.array([getattr(ring, part) ** 2 for ring in result.rings])
        assert math.isclose(math.sqrt((weight * squared).sum() / weight.sum()), getattr(result, whole), rel_tol=1e-9)
    assert max(ring.max_px for ring in result.rings) == result.max_px
    w, h = FISHEYE.image_size
    pixels = np.stack(np.meshgrid(np.arange(0.0, w, 4), np.arange(0.0, h, 4)), -1).reshape(-1, 2)
    bearings = FISHEYE.unproject(pixels)[0]
    angle = np.degrees(np.arctan2(np.hypot(bearings[:, 0], bearings[:, 1]), bearings[:, 2]))
    off = np.linalg.norm(result.model.project(bearings)[0] - pixels, axis=-1)
    for ring in result.rings[2:]:
        inside = (angle >= ring.from_deg) & (angle < ring.to_deg)
        assert math.isclose(np.sqrt((off[inside] ** 2).mean()), ring.rms_px, rel_tol=0.1)
