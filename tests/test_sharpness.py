"""The blur of edges against closed forms, and the photos that are named as blurred against those that were."""

import math
import pathlib
import re
from functools import lru_cache

import cv2
import numpy as np
import pytest

from calib_patterns import Detection, DetectionOptions, pattern
from calib_patterns.board_poses import random_board_poses
from calib_patterns.rendering import render_target
from calib_patterns.sharpness import blur_remarks
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose
from camera_models.unified import Unified
from omnilines.commands.detect import detect
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.records import Corners

MIN_CORNERS, MIN_PHOTOS = DetectionOptions().min_corners, DetectionOptions().sharpness.min_photos
BOARD = pattern("checkerboard:6x5:30mm")
SIZE = (512, 384)
LENSES = {
    "fisheye": (OpenCVFisheye([150.0, 150.5, 255.5, 191.5, -0.01, 0.003, -0.001, 0.0001], SIZE), math.radians(85.0)),
    "pinhole": (Pinhole.from_mapping({"fx": 380.0, "fy": 380.0, "cx": 257.0, "cy": 190.0, "k1": -0.1}, SIZE), 0.6),
    "unified": (
        Unified.from_mapping({"fx": 330.0, "fy": 330.0, "cx": 254.0, "cy": 193.0, "skew": 0.0, "xi": 1.2}, SIZE),
        math.radians(75.0),
    ),
}
PHOTOS = 12


def line_kernel(length_px: float, angle: float) -> np.ndarray:
    """Motion by `length_px` at `angle` from u to v, shared out to the four pixels around each of its points."""
    kernel, middle = np.zeros((17, 17)), 8
    steps = (np.arange(400) + 0.5) / 400 - 0.5
    along = middle + length_px * steps[:, None] * np.array([math.cos(angle), math.sin(angle)])
    low = np.floor(along).astype(int)
    part = along - low
    for dv in (0, 1):
        for du in (0, 1):
            share = (part[:, 0] if du else 1 - part[:, 0]) * (part[:, 1] if dv else 1 - part[:, 1])
            np.add.at(kernel, (low[:, 1] + dv, low[:, 0] + du), share)
    return kernel / kernel.sum()


def variance_px2(kernel: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Of the kernel along unit vectors (..., 2)."""
    u, v = np.meshgrid(np.arange(17) - 8.0, np.arange(17) - 8.0)
    moments = np.array([[(kernel * u * u).sum(), (kernel * u * v).sum()], [(kernel * u * v).sum(), (kernel * v * v).sum()]])
    return np.einsum("...i,ij,...j->...", normal, moments, normal)


@lru_cache(maxsize=3)
def photos(lens: str) -> tuple[np.ndarray, ...]:
    """Sharp photos, without noise."""
    model, angle = LENSES[lens]
    poses = random_board_poses(BOARD, model, PHOTOS, angle, min_spacing_px=18.0, seed=7)
    return tuple(render_target(BOARD, model, poses[k], blur_px=0.6, seed=k) for k in range(PHOTOS))


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    return np.clip(image + np.random.default_rng(seed).normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def seen(image: np.ndarray, seed: int) -> Detection:
    detection, reason = BOARD.detect(noisy(image, seed))
    assert reason is None
    return detection


@lru_cache(maxsize=3)
def sharp(lens: str) -> tuple[Detection, ...]:
    return tuple(seen(image, 100 + k) for k, image in enumerate(photos(lens)))


def remarks(detections: list[Detection]) -> tuple[str | None, ...]:
    view = np.repeat(np.arange(len(detections)), [len(d) for d in detections])
    return blur_remarks(view, np.concatenate([d.blur_px for d in detections if d.blur_px is not None]), len(detections))


def edge_normals(detection: Detection) -> np.ndarray:
    """(edge along x, edge along y; normal) in the image, the mean over the board, from the corners found."""
    grid = np.full((len(BOARD.points_m), 2), np.nan)
    grid[detection.ids] = detection.pixels
    grid = grid.reshape(5, 6, 2)
    tangents = np.stack([np.nanmean(np.diff(grid, axis=1), (0, 1)), np.nanmean(np.diff(grid, axis=0), (0, 1))])
    return np.stack([-tangents[:, 1], tangents[:, 0]], 1) / np.linalg.norm(tangents, axis=1, keepdims=True)


@pytest.mark.parametrize("specification", ["checkerboard:6x5:30mm", "checkerboard:5x5:30mm"])
@pytest.mark.parametrize("roll_deg", [0.0, 20.0, 70.0, 110.0, 200.0])
def test_blur_of_each_edge_is_the_motion_across_it(specification: str, roll_deg: float) -> None:
    """A board square on: w^2 of each edge grows by the kernel's variance across that edge of the board, however it is rolled."""
    board = pattern(specification)
    model = Pinhole.from_mapping({"fx": 400.0, "fy": 400.0, "cx": 200.3, "cy": 179.8}, (400, 360))
    rotation, _ = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(roll_deg)]))
    pose = Pose.of(rotation, np.array([0.0, 0.0, 0.3]) - rotation @ board.points_m.mean(0))
    image = render_target(board, model, pose, blur_px=0.7)
    kernel = line_kernel(6.0, math.radians(5.0))
    before, after = board.detect(image)[0], board.detect(cv2.filter2D(image, -1, kernel))[0]
    assert before.blur_px is not None and after.blur_px is not None and len(after) == len(board.points_m)
    # Directions in the image of the board's x and y, by the ids alone.
    grid = after.pixels.reshape(5, -1, 2)
    tangents = np.stack([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]])
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], 1) / np.linalg.norm(tangents, axis=1, keepdims=True)
    expected = np.sqrt(np.median(before.blur_px, 0) ** 2 + variance_px2(kernel, normals))
    # A line's profile is not normal: the fitted width is within a tenth of its standard deviation.
    np.testing.assert_allclose(np.median(after.blur_px, 0), expected, rtol=0.12)
    assert np.median(before.blur_px) == pytest.approx(math.hypot(0.7, 12**-0.5), rel=0.12)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.slow
def test_sharp_photos_of_a_set_are_not_named(lens: str) -> None:
    assert remarks(list(sharp(lens))) == (None,) * PHOTOS


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("share", "seed"), [(1, 0), (3, 1), (5, 2)])
def test_exactly_the_moved_photos_are_named(lens: str, share: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    moved = rng.choice(PHOTOS, share, replace=False)
    lengths = np.linspace(3.0, 10.0, share) if share > 1 else [6.0]
    detections, kinds = list(sharp(lens)), {}
    for k, length in zip(moved, lengths, strict=True):
        kernel = line_kernel(length, rng.uniform(0, math.pi))
        detections[k] = seen(cv2.filter2D(photos(lens)[k], -1, kernel), int(k))
        across = np.sqrt(0.65**2 + variance_px2(kernel, edge_normals(detections[k])))
        kinds[int(k)] = across.max() / across.min()
    found = remarks(detections)
    assert {k for k, remark in enumerate(found) if remark} == set(moved.tolist())
    for k, ratio in kinds.items():
        # In between it is for the photo to say: edges turn over the field of a wide lens.
        if ratio > 1.7:
            assert str(found[k]).startswith("motion-blurred: its edges are blurred by ")
        if ratio < 1.05:
            assert str(found[k]).startswith("blurred, out of focus or by motion along a diagonal")


def test_defocus_is_not_called_motion_and_figures_are_those_of_the_photo() -> None:
    detections = list(sharp("pinhole"))
    detections[4] = seen(cv2.GaussianBlur(photos("pinhole")[4], (0, 0), 1.8), 4)
    found = remarks(detections)
    assert [k for k, remark in enumerate(found) if remark] == [4]
    assert found[4] is not None and found[4].startswith("blurred")
    figures = [float(text) for text in re.findall(r"([\d.]+) px", found[4])]
    assert figures[0] == pytest.approx(math.hypot(1.8, 0.65), rel=0.08) and figures[1] == pytest.approx(0.65, rel=0.1)


def table(blur_px: np.ndarray, corners: int = MIN_CORNERS) -> tuple[np.ndarray, np.ndarray]:
    """Every corner of a photo with the same blur."""
    return np.repeat(np.arange(len(blur_px)), corners), np.repeat(blur_px, corners, axis=0)


def test_sentence_gives_both_directions_and_the_other_photos() -> None:
    blur = np.full((8, 2), 0.9)
    blur[5] = 3.1, 1.1
    blur[2] = 2.0, 2.1
    found = blur_remarks(*table(blur), 8)
    assert found[5] == (
        "motion-blurred: its edges are blurred by 3.1 px (standard deviation) in one direction and 1.1 px in the other, those of "
        "the other photos by 0.9 px"
    )
    assert found[2] == (
        "blurred, out of focus or by motion along a diagonal of the board: its edges are blurred by 2.1 px (standard deviation), "
        "those of the other photos by 0.9 px"
    )
    assert [k for k in range(8) if found[k]] == [2, 5]


def test_rows_may_come_in_any_order_and_few_corners_or_photos_are_not_judged() -> None:
    rng = np.random.default_rng(3)
    blur = np.full((9, 2), 0.7)
    blur[1], blur[8] = (2.5, 0.7), (0.8, 4.0)
    view, rows = table(blur, 20)
    order = rng.permutation(len(view))
    assert blur_remarks(view[order], rows[order], 9) == blur_remarks(view, rows, 9)
    thin = (view != 8) | (np.cumsum(view == 8) < MIN_CORNERS)
    found = blur_remarks(view[thin], rows[thin], 10)
    assert [k for k, remark in enumerate(found) if remark] == [1] and len(found) == 10
    few = view < MIN_PHOTOS - 1
    assert blur_remarks(view[few], rows[few], MIN_PHOTOS - 1) == (None,) * (MIN_PHOTOS - 1)
    assert blur_remarks(view[:0], rows[:0], 0) == ()


def test_sets_that_vary_naturally_are_rarely_named() -> None:
    """Varied by 3 to 20 percent, at most a photo in 100 is named; of 3 in 15 with 4 times the blur hardly one is missed."""
    rng = np.random.default_rng(0)
    named, missed, sets = 0, 0, 0
    for spread in (0.03, 0.1, 0.2):
        for base in (0.6, 2.5):
            for _ in range(40):
                blur = base * np.exp(spread * rng.standard_normal((15, 1)) + spread / 3 * rng.standard_normal((15, 2)))
                named += sum(remark is not None for remark in blur_remarks(*table(blur), 15))
                blur[:3] *= 4.0
                missed += sum(remark is None for remark in blur_remarks(*table(blur), 15)[:3])
                sets += 1
    assert sets == 240
    assert named <= 0.01 * 15 * sets
    assert missed <= 0.02 * 3 * sets


@pytest.mark.parametrize(("folder", "specification"), [("fisheye190", "checkerboard:7x6:30mm")])
def test_real_photos(folder: str, specification: str, shared_data: pathlib.Path) -> None:
    """Sharp as they are, none is named; two that are moved afterwards are."""
    board = pattern(specification)
    files = sorted((shared_data / "calibration" / folder / "images").iterdir())
    images = [cv2.imread(str(file)) for file in files]
    assert len(images) == 8
    detections = [board.detect(image)[0] for image in images]
    assert all(len(d) > 30 for d in detections)
    assert remarks(detections) == (None,) * 8
    for k, angle in ((1, 1.7), (5, 0.6)):
        detections[k] = board.detect(cv2.filter2D(images[k], -1, line_kernel(6.0, angle)))[0]
        assert len(detections[k]) > 30
    assert [k for k, remark in enumerate(remarks(detections)) if remark] == [1, 5]


def test_detect_tells_of_the_blurred_photo_and_uses_it(tmp_path: pathlib.Path) -> None:
    names = [f"{k}.png" for k in range(8)]
    for k, name in enumerate(names):
        image = photos("unified")[k]
        image = cv2.filter2D(image, -1, line_kernel(8.0, 0.4)) if k == 3 else image
        assert cv2.imwrite(str(tmp_path / name), noisy(image, k))
    assert cv2.imwrite(str(tmp_path / "empty.png"), np.full(SIZE[::-1], 120, np.uint8))
    result = detect([tmp_path], BOARD.specification, tmp_path / "out")
    rows = dict(result.summaries[0].rows)
    assert rows["2.png"] == "30 corners" and list(rows) == names
    assert [one.photo for one in result.details] == ["empty.png"] and result.details[0].text.startswith("empty.png is skipped: ")
    found = {photo["image"]: photo for photo in result.data["photos"]}
    assert list(found) == [*names, "empty.png"] and all(
        set(p) == {"image", "corners", "reason", "remark"} for p in found.values()
    )
    assert [name for name, photo in found.items() if photo["remark"]] == ["3.png"]
    remark = found["3.png"]["remark"]
    assert "blurred" in remark and found["3.png"]["corners"] == 30
    assert rows["3.png"] == f"30 corners; {remark}"


def test_nothing_is_said_where_the_blur_is_not_known() -> None:
    corners = Corners(np.repeat([0, 1], 30), ("a", "b"), ("a", "b"), np.tile(BOARD.points_m, (2, 1)), np.zeros((60, 2)))
    assert PhotoCorners(corners, SIZE).remarks == (None, None)
