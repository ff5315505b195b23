"""What extraction reads off smooth curves and grids, against the camera models; its kernels, against closed forms."""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy.special import ndtr

from camera_models import MODELS, CameraModel, Cylindrical, Equirectangular, OpenCVFisheye, Scaramuzza, model_class
from omnilines.extraction.arcs import LONGEST_RAD, Arcs, across_px, arcs_of_ends
from omnilines.extraction.bearings import FARTHEST_PX, MOST_CHART_ERROR_PX, _charts, bearings_at, changes_at, pixels_at
from omnilines.extraction.curves import samples
from omnilines.extraction.edgels import noise_level
from omnilines.extraction.kernels.bearing import read_pixels
from omnilines.extraction.kernels.pair import near_pairs
from omnilines.extraction.kernels.profile import mean_profiles, piece_means, profiles
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.step_edge import ROUNDS, fit_steps
from omnilines.extraction.kernels.tables import PairLimits, Picture, Ranked, Samples, Stepped, Window

EXAMPLES = [pytest.param(model, id=f"{name}-{k}") for name, _ in MODELS for k, model in enumerate(model_class(name).examples())]


def arcs_between(ends: np.ndarray) -> Arcs:
    """Arcs (n) between pairs of unit bearings (n, 2, 3)."""
    normal = np.cross(ends[:, 0], ends[:, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return arcs_of_ends(normal, ends, np.tile(np.eye(3), (len(ends), 1, 1)))


def agrees(model: CameraModel, arcs: Arcs, beyond_px: float) -> int:
    """Assert that samples are what the model says of their angles; how many are not valid."""
    at = samples(model, arcs, beyond_px)
    pixel, across, rate, valid = across_px(model, arcs, at.owner, at.angle)
    np.testing.assert_array_equal(at.valid, valid)
    off = at.pixel - pixel
    if model.PERIODIC:
        off[:, 0] -= model.image_size[0] * np.round(off[:, 0] / model.image_size[0])
    assert valid.sum() > 100
    assert np.abs(off[valid]).max() < 1e-3
    assert np.abs(at.rate / np.maximum(rate, 1e-300) - 1.0)[valid].max() < 1e-4
    assert np.abs(at.across - across)[valid].max() < 2e-4
    assert (np.diff(at.angle)[np.diff(at.owner) == 0] > 0).all()
    return int((~valid).sum())


def test_few_rays_of_a_mirror_are_asked_of_the_model() -> None:
    """A polynomial of degree 8 as calibrated from a real mirror: its bearings hardly change in the corners of the image, which
    show nothing, and fast where it shows the scene, 54 to 120 degrees off its axis."""
    radial = [-192.7, 0.29404, -0.010135898, 1.594857149e-4, -1.384587017e-6, 6.8718701986e-9, -1.831616701e-11, 2.03910864e-14]
    model = Scaramuzza([324.5, 247.5, 1.0, 0.0, 0.0, *radial], (640, 480))
    angle, around = np.radians(np.random.default_rng(0).uniform([54.0, 0.0], [120.0, 360.0], (5000, 2))).T
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)], -1)
    found, read = read_pixels(_charts(model), rays)
    asked, seen = model.project(rays)
    assert seen.all()
    assert read.mean() > 0.99
    assert np.abs(found - asked)[read].max() < 3.0 * MOST_CHART_ERROR_PX


def test_charts_of_both_half_spheres_meet() -> None:
    """Of the same mirror, whose second chart is finer than the nodes of the image: rays at a right angle to the axis."""
    radial = [-192.7, 0.29404, -0.010135898, 1.594857149e-4, -1.384587017e-6, 6.8718701986e-9, -1.831616701e-11, 2.03910864e-14]
    model = Scaramuzza([324.5, 247.5, 1.0, 0.0, 0.0, *radial], (640, 480))
    angle, around = np.radians(np.random.default_rng(0).uniform([89.98, 0.0], [90.02, 360.0], (5000, 2))).T
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)], -1)
    found, read = read_pixels(_charts(model), rays)
    assert read.mean() > 0.98
    assert np.abs(found - model.project(rays)[0])[read].max() < 3.0 * MOST_CHART_ERROR_PX


@pytest.mark.parametrize("model", EXAMPLES)
def test_samples_lie_where_the_model_says(model: CameraModel) -> None:
    """Arcs between random pixels, short ones and long ones, and beyond their ends."""
    rng = np.random.default_rng(0)
    width, height = model.image_size
    pixels = rng.uniform(0.0, 1.0, (300, 2, 2)) * np.array([width - 1.0, height - 1.0])
    pixels[100:, 1] = (pixels[100:, 0] + rng.uniform(-60.0, 60.0, (200, 2))).clip(0.0, [width - 1.0, height - 1.0])
    rays, seen = model.unproject(pixels)
    apart = np.arccos(np.clip((rays[:, 0] * rays[:, 1]).sum(-1), -1.0, 1.0))
    rays = rays[seen.all(-1) & (apart < LONGEST_RAD) & (apart > 1e-3)]
    assert len(rays) > 100
    arcs = arcs_between(rays)
    for beyond_px in (0.0, 12.0):
        agrees(model, arcs, beyond_px)


@pytest.mark.parametrize("model", EXAMPLES)
def test_samples_at_the_end_of_the_domain(model: CameraModel) -> None:
    """Arcs that leave the largest angle, that end at it, and that graze it."""
    most = model.max_angle
    axis = model.unproject(model.centre_px.numpy())[0]
    helper = np.eye(3)[np.abs(axis).argmin()]
    e1 = np.cross(axis, helper) / np.linalg.norm(np.cross(axis, helper))
    e2 = np.cross(axis, e1)

    def ray(theta: float, turn: float) -> np.ndarray:
        return math.cos(theta) * axis + math.sin(theta) * (math.cos(turn) * e1 + math.sin(turn) * e2)

    rim, _ = model.project(ray(most - 0.02, 0.3))
    if most >= math.pi or np.abs(rim).max() > 1e4:
        most = 0.5 * min(most, 2.0)
    ends = []
    for turn in np.linspace(0.0, 6.0, 9):
        ends += [
            (ray(most - 0.3, turn), ray(min(most + 0.1, 3.0), turn + 0.4)),
            (ray(most - 0.2, turn), ray(most - 1e-5, turn + 0.1)),
        ]
        # The middle of an arc between two points of a small circle lies farther in or out than they.
        ends += [(ray(most - depth, turn), ray(most - depth, turn + 0.6)) for depth in (1e-4, 1e-3, 1e-2)]
    missing = agrees(model, arcs_between(np.array(ends)), 12.0)
    assert missing > 0 or most < model.max_angle


@pytest.mark.parametrize(
    "model", [Equirectangular([], (2048, 1024)), Cylindrical.examples()[0]], ids=["equirectangular", "cylindrical"]
)
def test_samples_near_the_poles_and_across_the_seam(model: CameraModel) -> None:
    ends = []
    for turn in np.linspace(0.0, 6.0, 13):
        for beside in (0.0, 1e-6, 1e-4, 1e-2, 0.1, 0.3):
            side = np.array([math.cos(turn), 0.0, math.sin(turn)])
            over = np.array([-math.sin(turn), 0.0, math.cos(turn)])
            pole = np.array([0.0, 1.0 if turn > 3.0 else -1.0, 0.0])
            ends.append([pole + span * side + beside * over for span in (-0.61, 0.4)])
    if isinstance(model, Cylindrical):
        # Its poles are infinitely far out: only what passes beside them.
        ends = [
            [a + 0.6 * np.array([0.0, -np.sign(a[1]), 0.0]), b + 0.5 * np.array([0.0, -np.sign(b[1]), 0.0])]
            for a, b in ends[5::6]
        ]
    for height in np.linspace(-0.5, 0.5, 11):
        ends.append([np.array([-0.5, height, -1.0]), np.array([0.3, 0.2 - height, -1.0])])
    arcs = arcs_between(np.array([[ray / np.linalg.norm(ray) for ray in pair] for pair in ends]))
    assert len(arcs) > 20
    for beyond_px in (0.0, 12.0):
        agrees(model, arcs, beyond_px)


@pytest.mark.parametrize("model", EXAMPLES)
def test_bearings_of_many_places_are_those_of_the_model(model: CameraModel) -> None:
    width, height = model.image_size
    places = (
        np.random.default_rng(1).uniform(-1.0, 1.0, (40_000, 2)) * np.array([width, height]) * 0.51
        + np.array([width, height]) / 2
    )
    bearings, valid = bearings_at(model, places)
    expected, seen = model.unproject(places)
    np.testing.assert_array_equal(valid, seen)
    moved, also = model.unproject(places + np.array([1e-3, 0.0]))
    pace = np.linalg.norm(moved - expected, axis=-1) / 1e-3
    rows = seen & also & (pace > 0)
    assert rows.sum() > 10_000
    off = np.linalg.norm(bearings - expected, axis=-1)
    assert (off[rows] <= 1e-3 * pace[rows] + 1e-14).all()


@pytest.mark.parametrize("model", EXAMPLES)
def test_pixels_of_many_rays_and_their_changes_are_those_of_the_model(model: CameraModel) -> None:
    rays = np.random.default_rng(4).standard_normal((30_000, 3))
    pixels, valid = pixels_at(model, 3.0 * rays)
    expected, seen = model.project(rays)
    np.testing.assert_array_equal(valid, seen & (np.abs(expected) <= FARTHEST_PX).all(-1))
    inside = seen & (expected > -0.5).all(-1) & (expected < np.array(model.image_size) - 0.5).all(-1)
    assert inside.sum() > 200
    np.testing.assert_allclose(pixels[inside], expected[inside], rtol=0.0, atol=4e-4)
    # Circles through the rays, met where they begin.
    ray = rays[inside] / np.linalg.norm(rays[inside], axis=-1, keepdims=True)
    normal = np.cross(ray, np.roll(ray, 1, -1))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    frame = np.stack([normal, ray, np.cross(normal, ray)], -1)
    found = changes_at(model, frame, np.arange(len(ray)), np.zeros(len(ray)))
    by_ray = model.project_with_jacobians(torch.as_tensor(ray))[2].numpy()
    pace = np.linalg.norm(by_ray, axis=(1, 2))
    rows = found[3] & (pace < 20.0 * np.median(pace))
    assert rows.mean() > 0.9
    for change, way in ((found[1], frame[..., 2]), (found[2], normal)):
        off = np.linalg.norm(change - np.einsum("nij,nj->ni", by_ray, way), axis=-1)
        assert (off[rows] <= 1e-4 * pace[rows]).all()


def test_the_examples_have_domains_that_end_inside_the_image() -> None:
    """So that the test before meets grids with nodes that have no bearing."""
    inside = [model for model in (*OpenCVFisheye.examples(), *Scaramuzza.examples()) if model.max_angle < math.pi]
    assert inside
    seen = [
        bearings_at(m, np.random.default_rng(2).uniform(0.0, 1.0, (20_000, 2)) * np.array(m.image_size))[1].mean() for m in inside
    ]
    assert min(seen) < 1.0


def test_steps_are_found_where_they_are() -> None:
    """Profiles of one to three blurred steps in three channels, without noise: Gauss and Newton from beside them."""
    rng = np.random.default_rng(3)
    offsets = np.arange(-12, 20) * 0.5
    weight = np.append(np.exp(-0.25 * (offsets[:25] / 2.0) ** 2), np.zeros(7))
    count = np.repeat([1, 2, 3], 100)
    place = np.stack([rng.uniform(-0.3, 0.3, 300), rng.uniform(2.0, 2.6, 300), rng.uniform(-2.8, -2.2, 300)], -1)
    height = rng.uniform(20.0, 60.0, (300, 3, 3)) * rng.choice([-1.0, 1.0], (300, 1, 3))
    present = np.arange(3) < count[:, None]
    steps = ndtr((offsets[None, :, None] - place[:, None]) / 0.7) * present[:, None]
    profile = np.ascontiguousarray(90.0 + np.einsum("nks,nsc->nck", steps, height), np.float32)
    start = np.zeros((300, MOST_STEPS))
    start[:, :3] = place + rng.uniform(-0.2, 0.2, (300, 3))
    sigma = np.full(300, 0.01)
    stepped, window = Stepped(profile, start, count), Window(0, offsets, weight)
    found, variance, heights, left = fit_steps(stepped, sigma, window, stiff=np.array([1.0, 0.3]), blur=0.7, rounds=ROUNDS)
    assert np.abs(found[:, :3] - place)[present].max() < 4e-3
    assert np.abs(heights[:, :3] / height - 1.0)[present].max() < 2e-2
    # What a last move of 0.01 px leaves of steps of 60 in three channels.
    assert left.max() < 0.5 and (variance > 0).all()
    # Of one step: 1 / (sum of squares of the slope beside what a level and a height explain), Cramer and Rao.
    bell = np.exp(-0.5 * ((offsets - found[:100, :1]) / 0.7) ** 2) / (0.7 * math.sqrt(2.0 * math.pi)) * weight
    for n in range(100):
        design = np.stack([weight, weight * ndtr((offsets - found[n, 0]) / 0.7)], -1)
        slope = bell[n] - design @ np.linalg.lstsq(design, bell[n], rcond=None)[0]
        bound = sigma[n] ** 2 / ((slope**2).sum() * (height[n, 0] ** 2).sum())
        np.testing.assert_allclose(variance[n], bound, rtol=0.02)


@pytest.mark.parametrize("rounds", [1, 2, ROUNDS])
def test_profiles_fitted_at_once_are_those_fitted_alone(rounds: int) -> None:
    """Noise alone and steps in it, from one to MOST_STEPS, more of some than there are lanes: they need all rounds, few or half
    steps back."""
    rng = np.random.default_rng(5)
    offsets = np.arange(-12, 13) * 0.5
    count = rng.permutation(np.repeat(np.arange(1, MOST_STEPS + 1), [90, 150, 20, 17, 5, 1]))
    place = np.zeros((len(count), MOST_STEPS))
    place[:, 1:] = rng.uniform(-5.0, 5.0, (len(count), MOST_STEPS - 1))
    profile = rng.normal(0.0, 4.0, (len(count), 3, 25)).astype(np.float32)
    profile += 30.0 * ndtr((offsets - rng.uniform(-1.0, 1.0, (len(count), 1, 1))) / 0.7) * (rng.random((len(count), 1, 1)) < 0.7)
    sigma = rng.uniform(0.5, 4.0, len(count))
    window = Window(0, offsets, np.exp(-0.25 * (offsets / 2.0) ** 2))
    stiff = np.array([1.0, 0.3])

    def fitted(rows: slice) -> tuple[np.ndarray, ...]:
        return fit_steps(
            Stepped(profile[rows], place[rows], count[rows]), sigma[rows], window, stiff=stiff, blur=0.7, rounds=rounds
        )

    alone = [fitted(slice(n, n + 1)) for n in range(len(count))]
    for found, expected in zip(fitted(slice(None)), zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_noise_is_the_median_of_the_mask(dtype: type) -> None:
    """OpenCV's filter and NumPy's median of one band; and the noise that was added to a slope."""
    rng = np.random.default_rng(4)
    unit = 1.0 if dtype is np.uint8 else 257.0
    grey = 60.0 + np.arange(200.0) * 0.3 + rng.normal(0.0, 3.0, (50, 200))
    image = np.rint(grey * unit).astype(dtype)
    allowed = np.ones((50, 200), dtype=bool)
    allowed[:, 120:] = False
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6.0
    left = np.abs(cv2.filter2D(image.astype(np.float64), -1, kernel))[allowed]
    np.testing.assert_allclose(noise_level(image, allowed), np.median(left) / 0.6745 / unit, rtol=1e-9)
    np.testing.assert_allclose(noise_level(image, allowed), 3.0, rtol=0.1)
    assert noise_level(image, np.zeros_like(allowed)) == 0.0


def some_arcs(count: int, seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n, 3, 3) of arcs within `spread` of one place, many of them on nearly one circle, and half of their spans."""
    rng = np.random.default_rng(seed)
    middle = np.array([0.3, 0.2, 0.9]) + spread * rng.normal(size=(count, 3))
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    normal = np.cross(middle, rng.integers(0, 2, (count, 1)) * np.array([0.1, 0.0, 0.0]) + np.array([0.2, -0.9, 0.1]))
    normal *= rng.choice([-1.0, 1.0], (count, 1)) / np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack([normal, middle, np.cross(normal, middle)], -1), rng.uniform(0.005, 0.05, count)


@pytest.mark.parametrize(("most_gap_px", "least"), [(60.0, 200), (0.0, 30)])
def test_pairs_are_those_of_a_search_over_all(most_gap_px: float, least: int) -> None:
    """Of 400 arcs those that follow each other or overlap, none missed, and what is said of them."""
    frame, half = some_arcs(400, 5, 0.12)
    length_px, beside = 2000.0 * half, np.full(400, 0.004)
    found, values, _ = near_pairs(Ranked(frame, -half, half, length_px, beside), PairLimits(0.08, most_gap_px, 0.35, 2.6))
    expected = {}
    for a in range(400):
        for b in range(400):
            if half[a] <= half[b] or abs(frame[a, :, 0] @ frame[b, :, 0]) < 1.0 - 0.5 * 0.08**2:
                continue
            ends = np.cos(half[b]) * frame[b, :, 1] + np.outer([-np.sin(half[b]), np.sin(half[b])], frame[b, :, 2])
            low, high = np.sort(np.arctan2(ends @ frame[a, :, 2], ends @ frame[a, :, 1]))
            gap = max(low - half[a], -half[a] - high)
            follows = 1000.0 * gap < min(most_gap_px, 1000.0 * (half[a] + half[b])) and gap < 0.35
            overlaps = min(high, half[a]) - max(low, -half[a]) > 0.5 * (high - low)
            if np.abs(ends @ frame[a, :, 0]).max() <= 0.004 and (overlaps or (follows and most_gap_px > 0)):
                expected[a, b] = (low, high, gap, float(low - half[a] >= -half[a] - high))
    assert len(expected) >= least
    assert {(a, b) for a, b in found.tolist()} == set(expected) and len(found) == len(expected)
    np.testing.assert_allclose(values, [expected[a, b] for a, b in found.tolist()], atol=1e-12)


def test_pairs_looked_at_go_with_the_arcs() -> None:
    """Four times as many arcs on twice the breadth and height: four times the pairs, not sixteen times."""
    looked = []
    for count, spread in ((2000, 0.12), (8000, 0.24)):
        frame, half = some_arcs(count, 6, spread)
        half *= 0.3
        table = Ranked(frame, -half, half, 2000.0 * half, np.full(count, 0.004))
        _, _, total = near_pairs(table, PairLimits(0.08, 60.0, 0.35, 2.6))
        looked.append(total)
    assert looked[0] > 2000
    assert looked[1] < 6 * looked[0]


@pytest.mark.parametrize("channels", [1, 3])
def test_profiles_read_the_photo(channels: int) -> None:
    """Bilinear values are OpenCV's, also around the seam; cubic convolution reproduces a plane."""
    rng = np.random.default_rng(6)
    image = rng.integers(0, 256, (60, 80, channels), dtype=np.uint8)
    turn = rng.uniform(0.0, 6.28, 500)
    pixel, across = rng.uniform([0.0, 10.0], [79.0, 50.0], (500, 2)), np.stack([np.cos(turn), np.sin(turn)], -1)
    offsets = np.arange(-6, 7) * 0.5
    grey, inside = profiles(Picture(image, 1.0, True), pixel, across, offsets)
    around = np.concatenate([image[:, -20:], image, image[:, :20]], 1)
    places = pixel[:, None] + offsets[:, None] * across[:, None] + np.array([20.0, 0.0])
    for c in range(channels):
        plane = np.ascontiguousarray(around[..., c].astype(np.float32))
        expected = cv2.remap(plane, places[..., 0].astype(np.float32), places[..., 1].astype(np.float32), cv2.INTER_LINEAR)
        # OpenCV rounds places to 1/32 px.
        assert np.abs(grey[:, c] - expected).max() < 0.04 * 255
        assert np.abs(grey[:, c] - expected).mean() < 2.0
    assert inside.all()
    _, open_ended = profiles(Picture(image, 1.0, False), pixel, across, offsets)
    reach = places[..., 0] - 20.0
    np.testing.assert_array_equal(open_ended, ((reach >= 0) & (reach < 79)).all(-1))
    starts = np.arange(0, 501, 5)
    np.testing.assert_allclose(piece_means(grey, starts), grey.reshape(100, 5, channels, 13).mean(1), atol=1e-3)
    slope = (2.0 * np.arange(80.0) + np.arange(60.0)[:, None])[..., None] * np.ones(channels)
    every = np.ones(100, dtype=bool)
    at = Samples(np.zeros(500, dtype=np.int64), starts, turn, pixel, across, np.ones(500), np.ones(500, dtype=bool))
    mean, whole = mean_profiles(Picture(slope.astype(np.uint8), 1.0, False), at, starts, every, offsets)
    truth = (2.0 * reach + places[..., 1]).reshape(100, 5, 13).mean(1)
    assert whole.sum() > 20
    np.testing.assert_allclose(mean[whole], np.repeat(truth[whole, None], channels, 1), atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_mean_profiles_are_cubic_convolution_up_to_the_seam_and_the_last_pixel(channels: int) -> None:
    """Keys's kernel, written out: most pixels are read a row at once, those at seam and end one by one."""
    rng = np.random.default_rng(7)
    image = rng.integers(0, 256, (20, 30, channels), dtype=np.uint8)
    pixel, across = rng.uniform([-0.5, 1.0], [29.5, 17.9], (200, 2)), np.tile([1.0, 0.0], (200, 1))
    at = Samples(
        np.zeros(200, dtype=np.int64), np.arange(201), across[:, 0].copy(), pixel, across, np.ones(200), np.ones(200, dtype=bool)
    )
    mean, whole = mean_profiles(Picture(image, 1.0, True), at, np.arange(201), np.ones(200, dtype=bool), np.zeros(1))
    first = np.floor(pixel).astype(np.int64) - 1
    distance = np.abs(pixel[:, None] - first[:, None] - np.arange(4.0)[:, None])
    near, far = 1.0 - 2.5 * distance**2 + 1.5 * distance**3, 2.0 - 4.0 * distance + 2.5 * distance**2 - 0.5 * distance**3
    weight = np.where(distance < 1.0, near, far)
    rows, columns = first[:, 1, None] + np.arange(4), (first[:, 0, None] + np.arange(4)) % 30
    values = image[rows[:, :, None], columns[:, None]].astype(np.float64)
    expected = np.einsum("np,nq,npqc->nc", weight[..., 1], weight[..., 0], values)
    assert whole.all()
    np.testing.assert_allclose(mean[..., 0], expected, atol=1e-3)
