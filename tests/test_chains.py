"""Smooth curves of edge points without a camera, and cameras that start from them, against curves and lenses that are known."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_photos import exif

from camera_models import CameraModel, GeometryError, InputError, OpenCVFisheye, Pinhole
from omnilines.calibration.lines.straight import ChainNodes, RadialShape, planes_of, times_seen
from omnilines.extraction.joining import joined_pieces
from omnilines.extraction.kernels.partner import PartnerLimits
from omnilines.extraction.kernels.smooth import MOST_TERMS, _fit, smooth_pieces
from omnilines.extraction.options import SmoothChainOptions
from omnilines.extraction.smooth_chains import _limits, smooth_chains
from omnilines.geometry.chains import Chains
from omnilines.pipelines.chain_starts import CameraStart, start_from_chains
from omnilines.pipelines.chains import chains_of
from omnilines.structure.meeting import Meeting
from omnilines.structure.right_angles import scale_peaks

SIZE = (640, 480)
FISHEYE = OpenCVFisheye([180.0, 180.0, 325.0, 236.0, -0.02, 0.001, 0.0, 0.0], SIZE)
WIDE = Pinhole([300.0, 300.0, 324.0, 236.0, 0.0, -0.12, 0.015, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], SIZE)
NARROW = Pinhole([620.0, 620.0, 319.5, 239.5, *[0.0] * 9], SIZE)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return turn * np.linalg.det(turn)


def across(pixels: np.ndarray) -> np.ndarray:
    along = unit(np.gradient(pixels, axis=0))
    return np.stack([-along[:, 1], along[:, 0]], -1)


def line_pixels(model: CameraModel, middle: np.ndarray, way: np.ndarray, half_rad: float) -> np.ndarray:
    """Points about a pixel apart on the great circle through `middle` towards `way`, as far as the photo shows them."""
    along = unit(way - (way @ middle) * middle)
    angle = np.linspace(-half_rad, half_rad, 3000)[:, None]
    pixels, valid = model.project(np.cos(angle) * middle + np.sin(angle) * along)
    inside = valid & (pixels > 4).all(-1) & (pixels < np.array(SIZE) - 5).all(-1)
    run = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    if not len(run):
        return np.zeros((0, 2))
    longest = int(np.argmax(run[1::2] - run[::2]))
    pixels = pixels[run[2 * longest] : run[2 * longest + 1]]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=-1))])
    return np.stack([np.interp(np.arange(0.0, length[-1], 1.0), length, pixels[:, k]) for k in (0, 1)], -1)


def chains_from(curves: list[tuple[int, np.ndarray]], photos: int, sigma_px: float, rng: np.random.Generator) -> Chains:
    parts = [(photo, curve, across(curve)) for photo, curve in curves if len(curve) >= 25]
    count = [len(curve) for _, curve, _ in parts]
    normals = np.concatenate([normal for _, _, normal in parts])
    pixels = np.concatenate([curve for _, curve, _ in parts]) + sigma_px * rng.normal(size=(sum(count), 1)) * normals
    chain = np.repeat(np.arange(len(parts)), count)
    names, sigma = tuple(f"{k}.png" for k in range(photos)), np.full(len(pixels), sigma_px)
    return Chains(names, SIZE, np.array([photo for photo, _, _ in parts]), chain, pixels, normals, sigma)


def rooms(model: CameraModel, axes: int, seed: int, photos: int = 5, each: int = 22) -> Chains:
    """Lines along some of three axes at right angles in each photo, and rings that are no lines."""
    rng, curves = np.random.default_rng(seed), list[tuple[int, np.ndarray]]()
    edge = np.stack([rng.uniform(20, SIZE[0] - 20, 4000), rng.uniform(20, SIZE[1] - 20, 4000)], -1)
    bearings, valid = model.unproject(edge)
    middles = iter(bearings[valid])
    for photo in range(photos):
        turn = random_rotation(rng)
        for axis in range(axes):
            curves += [(photo, line_pixels(model, next(middles), turn[axis], rng.uniform(0.1, 0.4))) for _ in range(each)]
        for _ in range(each):
            angle = np.arange(0.0, rng.uniform(0.5, 1.5), 0.01)[:, None]
            ring = rng.uniform(200, 400, 2) + 100.0 * np.concatenate([np.cos(angle), np.sin(angle)], -1)
            curves.append((photo, ring[(ring > 5).all(-1) & (ring < np.array(SIZE) - 5).all(-1)]))
    return chains_from(curves, photos, 0.1, rng)


def rms_deg(start: CameraStart, model: CameraModel) -> float:
    """Of bearings within what the edges reach, up to a common rotation."""
    u, v = np.meshgrid(np.linspace(5, SIZE[0] - 5, 40), np.linspace(5, SIZE[1] - 5, 30))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    found = start.camera("opencv-fisheye" if isinstance(model, OpenCVFisheye) else "pinhole")
    (a, seen), (b, also) = found.unproject(pixels), model.unproject(pixels)
    a, b = a[seen & also], b[seen & also]
    assert len(a) > 0.7 * len(pixels)
    left, _, right = np.linalg.svd(a.T @ b)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return math.degrees(math.sqrt(np.square(a @ turn - b).sum(-1).mean()))


NAMES = {"fisheye": (FISHEYE, 0.5), "wide": (WIDE, 0.4), "narrow": (NARROW, 0.4)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye", pytest.param("wide", marks=pytest.mark.full), "narrow"])
def test_rooms_start_every_lens_without_a_guess(name: str) -> None:
    model, most_deg = NAMES[name]
    start = start_from_chains(rooms(model, 3, 4, photos=4, each=18))[0]
    assert abs(start.focal_px / float(model.parameters[0]) - 1.0) < max(0.02, 3.0 * start.focal_sigma)
    assert start.focal_sigma < 0.05
    assert rms_deg(start, model) < most_deg
    rho, theta = start.curve()
    for other in ("scaramuzza", "opencv-fisheye") if name == "fisheye" else ("pinhole",):
        bearing, valid = start.camera(other).unproject(start.shape.shape.centre[None] + np.array([[100.0, 0.0]]))
        angle = math.atan2(math.hypot(bearing[0, 0], bearing[0, 1]), bearing[0, 2])
        assert valid[0] and abs(angle - float(np.interp(100.0, rho, theta))) < 0.01


def test_lines_along_one_axis_leave_the_focal_length_open() -> None:
    start = start_from_chains(rooms(FISHEYE, 1, 5, photos=3, each=40))[0]
    assert math.isinf(start.focal_sigma)
    # What is straight is known all the same: the pixels at right angles to the axis.
    rho, theta = start.curve()
    rho_90 = float(np.interp(0.5 * math.pi, theta, rho))
    true = FISHEYE.project(np.array([[1.0, 0.0, 1e-6]]))[0][0, 0] - float(FISHEYE.centre_px[0])
    assert abs(rho_90 / true - 1.0) < 0.03


def test_few_chains_are_refused() -> None:
    with pytest.raises(GeometryError, match="smooth edges were expected"):
        start_from_chains(rooms(FISHEYE, 3, 4, photos=1, each=3))


def test_curves_at_random_are_refused() -> None:
    rng, curves = np.random.default_rng(8), list[tuple[int, np.ndarray]]()
    for _ in range(150):
        begin, radius = rng.uniform(0, 2 * math.pi), rng.uniform(100.0, 250.0)
        angle = begin + np.arange(0.0, rng.uniform(0.5, 1.0), 0.005)[:, None]
        ring = radius * np.concatenate([np.cos(angle), np.sin(angle)], -1)
        ring += rng.uniform(50.0, 430.0, 2) - ring[len(ring) // 2]
        curves.append((0, ring[(ring > 5).all(-1) & (ring < np.array(SIZE) - 5).all(-1)]))
    with pytest.raises(GeometryError, match="bend as by chance"):
        start_from_chains(chains_from(curves, 1, 0.1, rng))


def test_planes_hold_what_a_shape_sees_straight() -> None:
    rng = np.random.default_rng(1)
    shape = RadialShape(np.array([325.0, 236.0]), np.array([-0.9, 0.15, -0.05]), 300.0)
    rho = np.linspace(0.0, 1.0, 400)
    assert shape.rises(1.0)
    angle = np.arctan2(rho, shape.height(rho)[0])

    def seen(rays: np.ndarray) -> np.ndarray:
        radius = np.interp(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), angle, rho)
        return shape.centre + 300.0 * radius[:, None] * unit(rays[:, :2])

    curves = []
    for _ in range(30):
        a, b = unit(rng.normal(size=(2, 3)) + np.array([0.0, 0.0, 1.0]))
        rays = unit(a + np.linspace(0.0, 1.0, 120)[:, None] * (b - a))
        if (rays[:, 2] > math.cos(angle[-1])).all():
            curves.append((0, seen(rays)))
    nodes = ChainNodes.of(chains_from(curves, 1, 0.01, rng), 100, 100.0)
    good = nodes.bend_px[:, 0] > 1.0
    assert good.sum() > 10
    assert np.abs(planes_of(nodes, shape).bend_px[good]).max() < 0.15
    other = RadialShape(shape.centre, np.array([-0.5, 0.0, 0.0]), 300.0)
    assert np.abs(planes_of(nodes, other).bend_px[good]).max() > 1.0


def test_what_stands_still_is_counted() -> None:
    rng = np.random.default_rng(2)
    still = np.stack([np.arange(100.0, 200.0), np.full(100, 50.3)], -1)
    curves = [(photo, still) for photo in range(4)] + [(photo, still + np.array([0.0, 40.0 * (photo + 1)])) for photo in range(4)]
    assert times_seen(chains_from(curves, 4, 0.05, rng)).tolist() == [4, 4, 4, 4, 1, 1, 1, 1]


def meeting(directions: np.ndarray, sigma_rad: float) -> Meeting:
    covariance = sigma_rad**2 * (np.eye(3) - directions[:, :, None] * directions[:, None])
    return Meeting(directions, covariance, np.zeros(0, dtype=np.int64), 0.0)


def test_right_angles_tell_the_scale_and_chance_does_not() -> None:
    rng, stand = np.random.default_rng(3), 0
    true = [unit(random_rotation(rng).T * np.array([1.0, 1.0, 1.3])) for _ in range(6)]
    peak = scale_peaks([meeting(one, 0.002) for one in true], np.ones(6))[0]
    assert peak.stands and abs(math.log(peak.factor * 1.3)) < 3.0 * peak.sigma < 0.03
    for _ in range(15):
        random = [meeting(unit(rng.normal(size=(3, 3))), 0.002) for _ in range(6)]
        stand += any(one.stands for one in scale_peaks(random, np.ones(6)))
    assert stand <= 1
    assert scale_peaks([], np.zeros(0)) == []


def test_the_fit_is_that_of_a_plain_one() -> None:
    rng = np.random.default_rng(4)
    along = np.sort(rng.uniform(-1, 1, 60))
    off = 3.0 * along**2 - along + 0.1 * rng.normal(size=60)
    off[7] += 2.0
    residual, coefficients = np.zeros(60), np.zeros(MOST_TERMS)
    scale = _fit(along, off, 4, residual, coefficients)
    columns, weight = along[:, None] ** np.arange(4), np.ones(60)
    for _ in range(3):
        plain = np.linalg.lstsq(columns * np.sqrt(weight)[:, None], off * np.sqrt(weight), rcond=None)[0]
        left = off - columns @ plain
        sigma = 1.4826 * np.median(np.abs(left)) * math.sqrt(60 / 56)
        weight = np.minimum(1.0, 2.0 * sigma / np.abs(left))
    assert np.allclose(residual, left, atol=1e-8) and abs(scale - sigma) < 1e-9


def pieces_of(pixels: np.ndarray) -> list[tuple[int, int]]:
    points = np.concatenate([pixels, across(pixels)], -1).astype(np.float32)
    order, starts = np.arange(len(points), dtype=np.int32), np.array([0, len(points)])
    return [(int(a), int(b)) for a, b in smooth_pieces(points, order, starts, _limits(SIZE, SmoothChainOptions()))[0]]


def test_chains_are_cut_at_corners_and_small_rings_dropped() -> None:
    rng = np.random.default_rng(5)
    run = np.arange(80.0)[:, None]
    corner = np.concatenate([[100.0, 100.0] + run * [1.0, 0.0], [179.0, 100.0] + (run + 1.0) * [math.cos(0.4), math.sin(0.4)]])
    (first, joint), (again, last) = sorted(pieces_of(corner + 0.05 * rng.normal(size=corner.shape)))
    assert (first, last) == (0, 160) and joint == again and abs(joint - 80) <= 3
    angle = np.arange(0.0, 2.0 * math.pi, 0.02)[:, None]
    ring = np.concatenate([np.cos(angle), np.sin(angle)], -1)
    assert pieces_of(300.0 + 50.0 * ring) == []
    assert len(pieces_of(300.0 + 300.0 * ring[:60])) == 1
    walk = np.cumsum(rng.normal([0.8, 0.0], 0.5, (300, 2)), axis=0)
    assert sum(b - a for a, b in pieces_of(walk)) < 100


def test_curves_are_joined_across_a_gap_where_their_bright_sides_agree() -> None:
    angle = np.concatenate([np.arange(0.0, 0.3, 0.0025), np.arange(0.35, 0.7, 0.0025)])[:, None]
    pixels = 100.0 + 400.0 * np.concatenate([np.cos(angle), np.sin(angle)], -1)
    points = np.concatenate([pixels, across(pixels)], -1).astype(np.float32)
    first, second = np.split(np.arange(len(points), dtype=np.int32), [120])
    limits = _limits(SIZE, SmoothChainOptions())
    for pieces, light, count in (
        ([first, second], [1.0, 1.0], 1),
        ([first[::-1], second], [1.0, -1.0], 1),
        ([first, second[::-1]], [1.0, -1.0], 1),
        ([first, second], [1.0, -1.0], 2),
    ):
        joints = PartnerLimits(0.5, limits.max_curvature, 0.05)
        order, starts = joined_pieces(points, pieces, np.array(light), smooth=limits, partner=joints, rounds=3)
        assert len(starts) == count + 1 and sorted(order) == list(range(len(points)))
        step = np.linalg.norm(np.diff(pixels[order], axis=0), axis=-1)
        assert count == 2 or step.max() < 25.0


def step_photo(model: CameraModel, normal: np.ndarray, half_rad: float) -> np.ndarray:
    """A plane's edge through a lens, black outside a circle about its axis."""
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    bearings, _ = model.unproject(np.stack([u.ravel(), v.ravel()], -1))
    side = (bearings @ normal * 180.0).clip(-40, 40)
    grey = 60.0 + 110.0 / (1.0 + np.exp(-side / 0.4))
    grey[np.arccos(bearings[:, 2].clip(-1, 1)) > half_rad] = 2.0
    noisy = grey + np.random.default_rng(6).normal(scale=1.0, size=grey.shape)
    return noisy.reshape(SIZE[1], SIZE[0]).round().clip(0, 255).astype(np.uint8)


def test_a_line_through_a_fisheye_is_one_chain_and_the_rim_none() -> None:
    normal = unit(np.array([0.1, 1.0, 0.5]))
    found = smooth_chains(step_photo(FISHEYE, normal, 1.2))
    rim = FISHEYE.project(np.array([[math.sin(1.2), 0.0, math.cos(1.2)]]))[0][0, 0] - float(FISHEYE.centre_px[0])
    assert found.circle is not None and abs(found.circle[2] - rim) < 3
    count = np.bincount(found.chain)
    longest = found.chain == int(np.argmax(count))
    assert count.max() > 300 and count.max() > 0.9 * len(found.chain)
    ends = found.pixels[longest]
    at, _ = FISHEYE.unproject(ends + 0.5 * found.normals[longest])
    below, _ = FISHEYE.unproject(ends - 0.5 * found.normals[longest])
    off = (at @ normal + below @ normal) / (at @ normal - below @ normal) * 0.5
    assert np.abs(off.mean()) < 0.05 and off.std() < 0.15
    assert (at @ normal > below @ normal).all()
    sigma = found.sigma_px[longest]
    assert 0.7 * off.std() < sigma[0] < 4.0 * off.std()


def test_photos_without_edges_have_no_chains() -> None:
    noise = np.random.default_rng(7).normal(120.0, 3.0, (200, 300)).round().astype(np.uint8)
    for photo in (noise, np.zeros((50, 40), np.uint8), np.full((30, 30, 3), 200, np.uint8), np.zeros((2, 3), np.uint8)):
        assert smooth_chains(photo).count == 0


def test_photos_that_exif_turns_otherwise_are_left_out(tmp_path: Path) -> None:
    """Half a turn leaves the size as it is, and gives other pixels of the sensor."""
    photo = step_photo(FISHEYE, unit(np.array([0.1, 1.0, 0.5])), 3.2)
    for name, pixels in (("a", photo), ("b", photo[:, ::-1]), ("half", photo[::-1])):
        jpeg = cv2.imencode(".jpg", np.ascontiguousarray(pixels))[1].tobytes()
        (tmp_path / f"{name}.jpg").write_bytes(jpeg[:2] + (exif(3) if name == "half" else b"") + jpeg[2:])
    found = chains_of(tmp_path)
    assert found.chains.images == ("a.jpg", "b.jpg")
    assert [one.photo for one in found.skipped] == ["half.jpg"] and "turns it by 180 degrees" in found.skipped[0].text


def test_photos_of_another_size_are_left_out(tmp_path: Path) -> None:
    photo = step_photo(FISHEYE, unit(np.array([0.1, 1.0, 0.5])), 3.2)
    found = chains_of({"a.png": photo, "b.png": np.ascontiguousarray(photo[:, ::-1]), "c.png": photo[:-1]})
    assert found.chains.images == ("a.png", "b.png") and found.chains.image_size == SIZE
    assert [one.photo for one in found.skipped] == ["c.png"]
    assert np.array_equal(np.unique(found.chains.image), [0, 1])
    with pytest.raises(InputError, match="mask"):
        chains_of({"a.png": photo}, mask=np.ones((3, 3), dtype=bool))
    with pytest.raises(InputError, match="can be used"):
        (tmp_path / "bad.png").write_bytes(b"no photo")
        chains_of(tmp_path)
