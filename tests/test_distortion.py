"""The distortion of the ideal plane: its first fold and its inverse against brute force and OpenCV."""

import math

import cv2
import numpy as np
import pytest
import torch

from camera_models import Pinhole
from camera_models._distortion import distort, first_fold, undistort
from camera_models._radial import first_sign_change, invert_monotone

# k1 k2 p1 p2 k3 k4 k5 k6
DISTORTIONS = {
    "barrel": [-0.28, 0.09, 2e-4, -3e-4, -0.012, 0.0, 0.0, 0.0],
    "strongly decentred": [-0.1, 0.01, 0.05, -0.06, 0.0, 0.0, 0.0, 0.0],
    "tangential alone": [0.0, 0.0, 0.01, 0.02, 0.0, 0.0, 0.0, 0.0],
    "decentred more than it folds": [-0.02, 0.0, 0.1, 0.1, 0.0, 0.0, 0.0, 0.0],
    "rational": [0.9, 0.05, -1e-2, 2e-3, 0.001, 1.2, 0.22, 0.01],
    "pincushion": [0.3, 0.1, 5e-3, 5e-3, 0.02, 0.0, 0.0, 0.0],
}
EACH = pytest.mark.parametrize("coefficients", DISTORTIONS.values(), ids=DISTORTIONS)


def _determinant(coefficients: list[float], r: np.ndarray, angle: np.ndarray) -> np.ndarray:
    at = distort(coefficients, torch.as_tensor(r * np.cos(angle)), torch.as_tensor(r * np.sin(angle)))
    return (at.xx * at.yy - at.cross**2).numpy()


@EACH
def test_the_first_fold_is_where_the_determinant_vanishes_in_some_direction(coefficients: list[float]) -> None:
    fold = first_fold(coefficients)
    angles = np.linspace(0, 2 * np.pi, 2001)
    inside = np.linspace(0, 1, 500)[:-1, None] * min(fold, 20.0)
    assert _determinant(coefficients, inside, angles).min() > 0
    if fold < 1e8:
        # Right behind it, the direction of the sharpest fold is folded; it lies between two of the grid.
        beyond = fold * (1 + 1e-4)
        assert _determinant(coefficients, np.full_like(angles, beyond), angles).min() < 0
    else:
        assert coefficients == DISTORTIONS["pincushion"]


def test_folds_with_closed_forms() -> None:
    """1 + 3 k1 r^2 = 0 for k1 alone; 6 r |p| = 1 for the tangential terms alone; never for the ideal plane."""
    assert first_fold([-0.3, *[0.0] * 7]) == pytest.approx(math.sqrt(1 / 0.9), rel=1e-12)
    assert first_fold([0.0, 0.0, 0.03, -0.04, 0.0, 0.0, 0.0, 0.0]) == pytest.approx(1 / (6 * 0.05), rel=1e-12)
    assert first_fold([0.0] * 8) == 1e8
    assert first_fold([math.nan, *[0.0] * 7]) == 0.0 == first_fold([0.0, 0.0, math.nan, *[0.0] * 5])


@EACH
def test_the_inverse_is_found_in_the_whole_disc_and_nowhere_else(coefficients: list[float]) -> None:
    rng = np.random.default_rng(1)
    fold = first_fold(coefficients)
    radius, angle = 0.999 * min(fold, 3.0) * np.sqrt(rng.random(20000)), rng.uniform(-np.pi, np.pi, 20000)
    plane = torch.as_tensor(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    at = distort(coefficients, *plane.unbind(-1))
    found, known = undistort(coefficients, fold, torch.stack([at.x, at.y], -1))
    assert bool(known.all())
    # At 0.999 of the fold the inverse is a thousand times as steep as at the centre.
    assert float((found - plane).norm(dim=-1).max()) < 1e-11
    far = 1e3 * torch.as_tensor(np.stack([np.cos(angle), np.sin(angle)], -1))[:100]
    found, known = undistort(coefficients, fold, far)
    assert torch.isfinite(found).all()
    again = distort(coefficients, *found[known].unbind(-1))
    torch.testing.assert_close(torch.stack([again.x, again.y], -1), far[known], rtol=1e-9, atol=0)
    assert bool(known.all()) == (fold == 1e8) and bool(known.any()) == (fold == 1e8)


def test_the_inverse_agrees_with_opencv() -> None:
    """cv2.undistortPoints, iterated until it is exact."""
    model = Pinhole.examples()[0]
    fx, fy, cx, cy, _ = model.parameters[:5].tolist()
    rng = np.random.default_rng(2)
    pixels = rng.uniform([200, 150], [1080, 810], (2000, 2))
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-14)
    expected = cv2.undistortPoints(pixels[:, None], matrix, model.parameters[5:].numpy(), criteria=criteria)[:, 0]
    bearings, seen = model.unproject(pixels)
    assert seen.all()
    np.testing.assert_allclose(bearings[:, :2] / bearings[:, 2:], expected, atol=1e-10)


def test_first_sign_change_of_known_polynomials() -> None:
    cubic = np.polynomial.Polynomial.fromroots([0.5, 2.0, 3.0]) * -1
    assert first_sign_change(cubic.coef, 1.0) == pytest.approx(0.5)
    assert first_sign_change(np.array([1.0, -0.25]), 10.0) == pytest.approx(4.0)
    assert first_sign_change(np.array([1.0, 0.0, 0.3]), 1.0) == math.inf
    # (x - 1)^2 touches zero and turns back; (x - 1)^2 (2 - x) turns at 2.
    touching = np.polynomial.Polynomial([1.0, -2.0, 1.0])
    # A root of size 1 beside one of size 1e9, and the last value that is not negative.
    wide = first_sign_change((np.polynomial.Polynomial([1.0, -1.0]) * np.polynomial.Polynomial([1.0, 1e-9])).coef, 1.0)
    assert 1 - 1e-14 < wide <= 1.0
    assert first_sign_change(touching.coef, 1.0) == math.inf
    assert first_sign_change((touching * np.polynomial.Polynomial([2.0, -1.0])).coef, 1.0) == pytest.approx(2.0)


def test_monotone_functions_are_inverted_to_rounding_and_clamped() -> None:
    target = torch.tensor([[-1.0, 0.0, 1e-12, 0.3], [0.999, 1.0 - 1e-9, 1.0, 5.0]], dtype=torch.float64)
    found = invert_monotone(lambda x: (torch.sin(x), torch.cos(x)), target, math.pi / 2)
    expected = torch.asin(target.clamp(0.0, 1.0))
    assert found.shape == target.shape
    torch.testing.assert_close(found[:, :3], expected[:, :3], rtol=1e-11, atol=1e-16)
    # The sine is level at the end: an error of rounding there is one of its root.
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-8)


@pytest.mark.slow
def test_every_lens_that_is_monotone_near_its_centre_is_seen_there() -> None:
    """Mild rational lenses at random, with and without poles, against a dense scan of r q(r): pixels inside the reach of the scan
    are seen and go there and back, those beyond it are not; in NumPy and in torch."""
    rng = np.random.default_rng(0)
    radii = np.linspace(0.0, 3.0, 30001)
    poles = folds = 0
    for _ in range(150):
        k1, k2, k3, k4, k5, k6 = rng.uniform(-1, 1, 6) * [0.3, 0.15, 0.08, 0.3, 0.15, 0.08] * rng.choice([0, 1], 6, p=[0.3, 0.7])
        model = Pinhole([900.0, 890.0, 640.0, 480.0, 0.0, k1, k2, 0.0, 0.0, k3, k4, k5, k6], (1280, 960), 8)
        x = radii**2
        denominator = 1 + x * (k4 + x * (k5 + x * k6))
        with np.errstate(divide="ignore"):
            distorted = radii * (1 + x * (k1 + x * (k2 + x * k3))) / denominator
        sound = np.append(True, np.diff(distorted) > 0) & (denominator > 0)
        last = len(radii) - 1 if sound.all() else int(np.argmin(sound)) - 1
        pole = denominator.min() <= 0 and denominator[last + 1] <= 0
        poles, folds = poles + pole, folds + (last < len(radii) - 1 and not pole)
        shown = np.flatnonzero(distorted[:last] < 0.9)[::40]
        angle = rng.uniform(-np.pi, np.pi, len(shown))
        around = np.stack([np.cos(angle), np.sin(angle)], -1)
        pixels = np.array([640.0, 480.0]) + distorted[shown, None] * around * [900.0, 890.0]
        for kind in (pixels, torch.as_tensor(pixels)):
            bearings, seen = (np.asarray(part) for part in model.unproject(kind))
            assert seen.all(), (k1, k2, k3, k4, k5, k6)
            np.testing.assert_allclose(bearings[:, :2] / bearings[:, 2:], radii[shown, None] * around, atol=1e-7)
        if last < len(radii) - 1:
            edge = np.array([[radii[last - 1], 0.0, 1.0], [radii[last + 1], 0.0, 1.0]])
            assert model.project(edge)[1].tolist() == [True, False] == model.project(torch.as_tensor(edge))[1].tolist()
            assert np.isfinite(model.project(edge)[0]).all()
        if last < len(radii) - 1 and not pole:
            assert not model.unproject(np.array([640.0 + 900.0 * (distorted[last] + 1e-3), 480.0]))[1]
    assert poles > 10 and folds > 10


def test_a_domain_that_ends_at_a_pole() -> None:
    """1 - 0.05 r^4 vanishes at 20^(1/4); so does (1 - r^2 / 4)^2 at 2, without a change of sign."""
    for terms, pole in (([0.0, -0.05, 0.0], 20**0.25), ([-0.5, 1 / 16, 0.0], 2.0)):
        fold = first_fold([0.0, 0.1, 0.0, 0.0, 0.0, *terms])
        assert pole * (1 - 1e-3) < fold <= pole
        model = Pinhole([900.0, 900.0, 640.0, 480.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, *terms], (1280, 960), 8)
        assert model.unproject(np.array([[640.0, 480.0], [-0.5, -0.5], [1279.5, 959.5]]))[1].all()
