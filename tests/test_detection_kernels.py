"""The compiled loops of detection against what they compute, written plainly in NumPy and SciPy."""

import math

import cv2
import numpy as np
import pytest
from scipy.ndimage import correlate, map_coordinates
from scipy.optimize import least_squares
from scipy.special import ndtr

from calib_patterns.kernels.saddle_fit import BUFFER_ROWS, JACOBIAN, LEFT, fit_all, linearised
from calib_patterns.kernels.saddle_points import FIELDS, SAMPLES, crossings, nearest_along, responses
from calib_patterns.kernels.saddle_window import FEW_PIXELS, GREY, PARAMETERS, ROW_LENGTH, U, V, starts, window


def saddle_image(p: np.ndarray, curvature: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The model as saddle.py states it, with the shift that blur along bent edges causes, in 64 bits."""
    du, dv, gain = u - p[0], v - p[1], abs(p[6])
    w_1, w_2 = np.exp(p[4:6])
    along_1, across_1 = np.cos(p[2]) * du + np.sin(p[2]) * dv, np.cos(p[2]) * dv - np.sin(p[2]) * du
    along_2, across_2 = np.cos(p[3]) * du + np.sin(p[3]) * dv, np.cos(p[3]) * dv - np.sin(p[3]) * du
    h_1 = across_1 - 0.5 * curvature[0] * (along_1**2 + w_2**2)
    h_2 = across_2 - 0.5 * curvature[1] * (along_2**2 + w_1**2)
    side = -1.0 if p[6] < 0 else 1.0
    one_way = ndtr((h_1 - gain) / w_1) * ndtr((-side * h_2 - gain) / w_2)
    other_way = ndtr((-h_1 - gain) / w_1) * ndtr((side * h_2 - gain) / w_2)
    return (1.0 + p[8] * du + p[9] * dv) * (p[7] + p[10] * side * (1.0 - 2.0 * (one_way + other_way)))


def test_compiled_derivatives_are_those_of_the_model() -> None:
    """What is left, its sum of squares and the derivatives, which are those of the model by central differences, for both signs
    of the gain and edges from sharp to blurred."""
    rng = np.random.default_rng(1)
    u, v = (values.ravel().astype(float) for values in np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)))
    grey = rng.uniform(40, 200, u.shape)
    curvature = np.array([0.01, -0.015])
    rows = np.zeros((BUFFER_ROWS, ROW_LENGTH))
    rows[U, : len(u)], rows[V, : len(u)], rows[GREY, : len(u)] = u, v, grey
    compared = 0
    for gain in (0.3, -0.3):
        for log_blur in (-1.2, 0.1, 1.0):
            at = np.array([0.3, -0.2, 0.1, 1.4, log_blur, log_blur - 0.3, gain, 110.0, 0.004, -0.006, 60.0])
            cost = linearised(at, curvature, rows.reshape(-1), len(u))
            left = grey - saddle_image(at, curvature, u, v)
            np.testing.assert_allclose(rows[LEFT, : len(u)], left, atol=1e-6)
            np.testing.assert_allclose(cost, left @ left, rtol=1e-8)
            for k in range(PARAMETERS):
                step = np.zeros(PARAMETERS)
                step[k] = 1e-5
                ahead, behind = (saddle_image(at + sign * step, curvature, u, v) for sign in (1, -1))
                truth = (ahead - behind) / 2e-5
                np.testing.assert_allclose(rows[JACOBIAN + k, : len(u)], truth, atol=5e-6 * np.abs(truth).max())
                compared += 1
    assert compared == 6 * PARAMETERS


# --- where fits start, and their pixels


def test_starts_are_the_edges_of_the_derivatives() -> None:
    rng = np.random.default_rng(2)
    corners = rng.uniform(10, 90, (20, 2))
    first = 12.0 * np.eye(2) + rng.uniform(-4, 4, (20, 2, 2))
    first[7] = [[0.2, 0.0], [0.0, 0.3]]  # squares of less than half a pixel
    second = rng.normal(0.0, 0.3, (20, 2, 2))
    parameters, curvature, into_squares, narrowest, widest = starts(corners, first, second, np.ones((len(corners), 2)))
    np.testing.assert_allclose(narrowest, np.linalg.svd(first, compute_uv=False)[:, -1], rtol=1e-12)
    first[7] = np.eye(2)
    np.testing.assert_allclose(into_squares, np.linalg.inv(first), rtol=1e-12, atol=1e-15)
    assert widest == pytest.approx(np.abs(first).sum(2).max())
    x, y = first[..., 0], -first[..., 1]
    np.testing.assert_array_equal(parameters[:, :2], corners)
    np.testing.assert_allclose(parameters[:, 2:4], np.stack([np.arctan2(e[:, 1], e[:, 0]) for e in (x, y)], 1), rtol=1e-12)
    blur = np.log(np.minimum(np.maximum(0.2 * narrowest, 0.5), 1.0))
    np.testing.assert_allclose(parameters[:, 4:6], np.stack([blur, blur], 1), rtol=1e-12, atol=1e-15)
    for edge, bend, signed in ((x, second[..., 0], curvature[:, 0]), (y, second[..., 1], curvature[:, 1])):
        # (t x c'') / |c'|^3 of the curve along the edge.
        truth = (edge[:, 0] * bend[:, 1] - edge[:, 1] * bend[:, 0]) / np.linalg.norm(edge, axis=1) ** 3
        np.testing.assert_allclose(signed, truth, rtol=1e-12)


def plain_window(
    image: np.ndarray, corner: np.ndarray, into_squares: np.ndarray, plain: np.ndarray, half: int, stride: int, reach: float
) -> set[tuple[float, float, float]]:
    """Pixels from the middle of the window and their grey levels."""
    column, row = round(corner[0]), round(corner[1])
    steps = np.arange(-half, half + 1, stride)
    u, v = (values.ravel() for values in np.meshgrid(column + steps, row + steps))
    square = (np.stack([u, v], 1) - corner) @ into_squares.T
    offset = np.stack([u, v], 1) - corner
    near = (np.abs(square) < reach).all(1) & ((offset**2).sum(1) < (half + 0.5) ** 2)
    if near.sum() < FEW_PIXELS:
        near |= (np.abs(offset) < 2.51).all(1)
    one_colour = np.abs(square).min(1) < plain[(square[:, 1] > 0).astype(int), (square[:, 0] > 0).astype(int)]
    inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
    kept = near & one_colour & inside
    return {(float(a - column), float(b - row), float(image[b, a])) for a, b in zip(u[kept], v[kept], strict=True)}


@pytest.mark.parametrize("stride", [1, 2])
def test_windows_hold_the_pixels_of_the_corner_that_are_of_one_colour(stride: int) -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 255, (60, 80)).astype(np.uint8)
    few = 0
    for case in range(60):
        corner = rng.uniform([39, 29], [41, 31]) if case % 3 else rng.uniform(0, [79, 59])
        square_px = 3.0 if case % 5 == 0 else rng.uniform(8, 25)
        turn = rng.uniform(0, math.pi)
        first = square_px * np.array([[math.cos(turn), -0.8 * math.sin(turn)], [math.sin(turn), 0.9 * math.cos(turn)]])
        into_squares = np.linalg.inv(first)
        plain = np.full((2, 2), np.inf) if case % 2 else rng.uniform(0.05, 0.5, (2, 2))
        half = 4 if case % 5 == 0 else 9
        rows = np.zeros(BUFFER_ROWS * ROW_LENGTH)
        count = window(image, corner, into_squares, plain, half, stride, 0.42, rows)
        table = rows.reshape(BUFFER_ROWS, ROW_LENGTH)[[U, V, GREY], :count]
        truth = plain_window(image, corner, into_squares, plain, half, stride, 0.42)
        # Widened windows reach as far as 5 x 5 pixels.
        assert {tuple(float(x) for x in pixel) for pixel in table.T} == truth and count == len(truth)
        few += case % 5 == 0
    assert few == 12


def test_fits_are_the_least_squares_ones_of_scipy() -> None:
    """From blurred and noisy saddles: corner, parameters, sum of squares and variance."""
    rng = np.random.default_rng(4)
    v, u = (values.astype(float) for values in np.mgrid[:40, :40])
    compared = 0
    for gain in (0.2, -0.15):
        true = np.array([20.2, 19.7, 0.15, -1.45, 0.1, 0.2, gain, 120.0, 0.002, -0.003, 60.0])
        curvature = np.array([[0.004, -0.006]])
        image = saddle_image(true, curvature[0], u, v) + rng.normal(0.0, 1.0, u.shape)
        start = true.copy()
        start[:6] += [0.3, -0.2, 0.05, -0.04, 0.2, -0.2]
        start[6:] = 0.0
        parameters = start[None].copy()
        plain, into_squares = np.full((1, 2, 2), np.inf), np.linalg.inv(16.0 * np.eye(2))[None]
        counts, costs, spreads, last_px = fit_all(image, parameters, curvature, into_squares, plain, 8, 1, 0.42, 5.0, 60, 1e-9)
        rows = np.zeros(BUFFER_ROWS * ROW_LENGTH)
        assert window(image, start, into_squares[0], plain[0], 8, 1, 0.42, rows) == counts[0]
        pixels = rows.reshape(BUFFER_ROWS, ROW_LENGTH)[:, : counts[0]]
        at_u, at_v, grey = pixels[U] + round(start[0]), pixels[V] + round(start[1]), pixels[GREY]

        def left(p: np.ndarray) -> np.ndarray:
            return grey - saddle_image(p, curvature[0], at_u, at_v)  # noqa: B023

        theirs = least_squares(left, true, x_scale=[1, 1, 1, 1, 1, 1, 1, 100, 0.01, 0.01, 100], xtol=1e-12, ftol=1e-12)
        assert costs[0] == pytest.approx(2.0 * theirs.cost, rel=1e-6) and last_px[0] < 1e-6
        np.testing.assert_allclose(parameters[0, :2], theirs.x[:2], atol=2e-4)
        np.testing.assert_allclose(parameters[0, 2:6], theirs.x[2:6], atol=2e-3)
        covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)
        assert spreads[0] == pytest.approx(0.5 * (covariance[0, 0] + covariance[1, 1]), rel=1e-3)
        compared += 1
    assert compared == 2


# --- saddle points


def photo(seed: int = 0) -> np.ndarray:
    """A turned checkerboard with noise, smoothed."""
    v, u = np.mgrid[:120, :160].astype(float)
    x, y = 0.95 * u + 0.3 * v, -0.3 * u + 0.95 * v
    board = np.where((np.floor(x / 14.0) + np.floor(y / 14.0)) % 2 == 0, 40.0, 200.0)
    board += np.random.default_rng(seed).normal(0.0, 3.0, board.shape)
    return cv2.GaussianBlur(board.astype(np.float32), (0, 0), 2.0)


SECOND = (
    np.array([[1.0, -2.0, 1.0], [2.0, -4.0, 2.0], [1.0, -2.0, 1.0]]) / 4.0,
    np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]]) / 4.0,
    np.array([[1.0, 2.0, 1.0], [-2.0, -4.0, -2.0], [1.0, 2.0, 1.0]]) / 4.0,
)
"""Sobel's kernels of the second derivatives (uu, uv, vv), over 4."""


def hessian(smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    uu, uv, vv = (correlate(smooth.astype(np.float64), kernel, mode="nearest") for kernel in SECOND)
    return uu, uv, vv


def test_responses_are_minus_the_determinants_of_the_hessians() -> None:
    smooth = photo()
    uu, uv, vv = hessian(smooth)
    found = responses(smooth, 16.0)
    truth = 16.0 * (uv**2 - uu * vv)
    np.testing.assert_allclose(found[1:-1, 1:-1], truth[1:-1, 1:-1], atol=1e-5 * np.abs(truth).max())
    assert not found[[0, -1]].any() and not found[:, [0, -1]].any()


def test_crossings_are_the_saddles_whose_circles_meet_their_level_four_times() -> None:
    smooth, radius = photo(), 5.0
    response = responses(smooth, 16.0)
    peaks = np.argwhere((response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > 1.0))
    peaks = peaks[((peaks >= 3) & (peaks < np.array(smooth.shape) - 3)).all(1)]
    found = crossings(smooth, response, peaks, radius)
    uu, uv, vv = hessian(smooth)
    angles = 2.0 * math.pi / SAMPLES * np.arange(SAMPLES)
    expected = []
    for y, x in peaks:
        matrix = np.array([[uu[y, x], uv[y, x]], [uv[y, x], vv[y, x]]])
        slope = 0.5 * np.array([smooth[y, x + 1] - smooth[y, x - 1], smooth[y + 1, x] - smooth[y - 1, x]], dtype=np.float64)
        step = -np.linalg.solve(matrix, slope)
        if np.abs(step).max() >= 1.5:
            continue
        u, v = x + step[0], y + step[1]
        at = np.clip(v + radius * np.sin(angles), 0, 119 - 1e-3), np.clip(u + radius * np.cos(angles), 0, 159 - 1e-3)
        level = map_coordinates(smooth.astype(np.float64), at, order=1)
        level -= 0.5 * (level.min() + level.max())
        following = np.roll(level, -1)
        crossed = np.flatnonzero((level < 0) != (following < 0))
        if len(crossed) != 4:
            continue
        arms = 2.0 * math.pi / SAMPLES * (crossed + level[crossed] / (level[crossed] - following[crossed]))
        arms = np.stack([np.cos(arms), np.sin(arms)], 1).ravel()
        norm = np.linalg.norm(matrix)
        expected.append([u, v, *(matrix.ravel()[[0, 1, 3]] / norm), *arms, response[y, x]])
    assert found.shape == (len(expected), FIELDS) and 60 < len(expected) < len(peaks)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_neighbours_are_the_nearest_of_opposite_hessian_along_each_edge() -> None:
    rng = np.random.default_rng(5)
    pixels = rng.uniform(0, 100, (60, 2))
    matrix = rng.normal(size=(60, 3))
    matrix /= np.sqrt(matrix[:, 0] ** 2 + 2.0 * matrix[:, 1] ** 2 + matrix[:, 2] ** 2)[:, None]
    angle = rng.uniform(0, 2 * math.pi, (60, 1)) + np.arange(4) * math.pi / 2
    edges = np.stack([np.cos(angle), np.sin(angle)], -1)
    distance = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    neighbours = np.argsort(distance, axis=1)[:, 1:21]
    found = nearest_along(pixels, matrix, edges, neighbours, -0.3, 0.9)
    alike = (matrix[:, None] * matrix * [1.0, 2.0, 1.0]).sum(-1)
    towards = (pixels - pixels[:, None]) / np.maximum(distance, 1e-9)[..., None]
    truth = np.full((60, 4), -1)
    for i in range(60):
        for d in range(4):
            fitting = [j for j in neighbours[i] if alike[i, j] < -0.3 and towards[i, j] @ edges[i, d] > 0.9]
            truth[i, d] = fitting[0] if fitting else -1
    np.testing.assert_array_equal(found, truth)
    assert (truth >= 0).sum() > 40 and (truth < 0).sum() > 40
