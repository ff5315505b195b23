"""Refits: fits of one circle in closed form, and that the arcs of a photo do not depend on how the work is parted."""

import cv2
import numpy as np
import pytest

from camera_models import Pinhole
from omnilines.extraction import ExtractionOptions, extract_arcs, refit
from omnilines.extraction.kernels.circle import fit_circles
from omnilines.extraction.kernels.tables import Places

CAMERA = Pinhole.from_mapping({"fx": 260.0, "fy": 260.0, "cx": 159.5, "cy": 119.5}, (320, 240))


def drawn() -> np.ndarray:
    image = np.full((240, 320, 3), 120, dtype=np.uint8)
    rng = np.random.default_rng(4)
    for _ in range(25):
        corners = cv2.boxPoints((rng.uniform([20, 20], [300, 220]).tolist(), rng.uniform(20, 90, 2).tolist(), rng.uniform(0, 90)))
        cv2.fillPoly(image, [corners.astype(np.int32)], rng.uniform(30, 220, 3).tolist(), cv2.LINE_AA)
    noise = 2.0 * rng.standard_normal(image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.6) + noise, 0, 255).astype(np.uint8)


def test_a_circle_is_fitted_through_most_of_its_places() -> None:
    """Two arcs; the second has a fifth of its places off by 0.9 px, a third of those of the first are not usable."""
    rng = np.random.default_rng(1)
    angle, rate = np.tile(np.linspace(-0.2, 0.2, 60), 2), np.full(120, 500.0)
    truth = np.array([[1e-3, -2e-3], [-5e-4, 1e-3]])
    change = np.repeat(truth, 60, 0)
    shift = -rate * (change[:, 0] * np.cos(angle) + change[:, 1] * np.sin(angle)) + 0.05 * rng.standard_normal(120)
    usable = np.ones(120, dtype=bool)
    usable[10:30], shift[10:30] = False, 0.9
    shift[60::5] += 0.9
    found, inverse, variance, used, residual = fit_circles(
        np.array([0, 60, 120]), Places(angle, rate, shift, np.ones(120), usable), ExtractionOptions().refit.max_shift_px
    )
    sigma = np.sqrt(np.einsum("nii->ni", inverse) * variance[:, None])
    assert (np.abs(found - truth) < 4.0 * sigma).all()
    assert (sigma < 2e-4).all()
    assert used[0] <= 40
    assert 40 <= used[1] <= 48
    np.testing.assert_array_equal(np.isnan(residual), ~usable)
    assert np.median(np.abs(residual[60::5])) > 0.7


def test_arcs_do_not_depend_on_how_many_are_refitted_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    image = drawn()
    whole = extract_arcs(image, CAMERA, options=ExtractionOptions(min_length_px=13.0))
    assert len(whole) > 50
    monkeypatch.setattr(refit, "_ARCS", 7)
    parts = extract_arcs(image, CAMERA, options=ExtractionOptions(min_length_px=13.0))
    np.testing.assert_allclose(parts.endpoints_px, whole.endpoints_px, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.covariance_px2, whole.covariance_px2, rtol=1e-9)
