"""Laws of every calibration target (adding one needs no edit here), and the checkerboard on rendered and real photos."""

import re
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
import torch

import calib_patterns
from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns.rendering import render_target
from camera_models.errors import InputError
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose

ALL = [
    pytest.param(p, id=p.specification)
    for name, _ in calib_patterns.PATTERNS
    for p in calib_patterns.pattern_class(name).examples()
]
EACH_KIND = [
    pytest.param(p, id=p.specification, marks=() if index == 0 else pytest.mark.full)
    for name, _ in calib_patterns.PATTERNS
    for index, p in enumerate(calib_patterns.pattern_class(name).examples())
]
SIZE = (960, 720)


@lru_cache(maxsize=2)
def camera(size: tuple[int, int] = SIZE) -> Pinhole:
    w, h = size
    return Pinhole.from_mapping({"fx": float(w), "fy": float(w), "cx": w / 2 - 0.5, "cy": h / 2 - 0.5}, size)


def pose_in_front(pattern: Pattern, size: tuple[int, int] = SIZE, turn: tuple[float, float, float] = (0.25, -0.2, 0.1)) -> Pose:
    """The sheet's middle on the axis, filling most of the photo."""
    middle = np.append(np.array(pattern.top_left_m) + np.array(pattern.size_m) / 2, 0.0)
    distance = 1.25 * max(pattern.size_m[0], pattern.size_m[1] * size[0] / size[1])
    rotation, _ = cv2.Rodrigues(np.array(turn))
    return Pose.of(rotation, np.array([0.0, 0.0, distance]) - rotation @ middle)


def true_pixels(pattern: Pattern, model: Pinhole, pose: Pose) -> np.ndarray:
    """By OpenCV's projection, not ours."""
    f, _, cx, cy = (model.named_parameters()[k] for k in ("fx", "fy", "cx", "cy"))
    matrix = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    rotation, _ = cv2.Rodrigues(pose.rotation.numpy())
    pixels, _ = cv2.projectPoints(pattern.points_m, rotation, pose.translation.numpy(), matrix, None)
    return pixels.reshape(-1, 2)


def errors_px(pattern: Pattern, detection: Detection, truth: np.ndarray) -> np.ndarray:
    """Against the truth in its own numbering or, for a plain board, after half a turn."""
    own, turned = (detection.pixels - truth[detection.ids], detection.pixels - truth[::-1][detection.ids])
    return own if np.abs(own).max() < np.abs(turned).max() else turned


def test_registry_names_and_laziness() -> None:
    assert ALL
    for name, _ in calib_patterns.PATTERNS:
        assert calib_patterns.pattern_class(name).NAME == name
    code = "import sys, calib_patterns; sys.exit(any(m in sys.modules for m in ('cv2', 'torch')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("pattern", ALL)
def test_specification_reads_back(pattern: Pattern) -> None:
    assert calib_patterns.pattern(pattern.specification) == pattern
    assert calib_patterns.pattern(pattern.specification).specification == pattern.specification


@pytest.mark.parametrize("pattern", ALL)
def test_geometry(pattern: Pattern) -> None:
    points = pattern.points_m
    assert points.shape[0] >= 4 and points.shape[1] == 3 and (points[:, 2] == 0).all()
    assert len(np.unique(points, axis=0)) == len(points)
    low = np.array(pattern.top_left_m)
    assert (points[:, :2] > low).all() and (points[:, :2] < low + pattern.size_m).all()


@pytest.mark.parametrize("pattern", ALL)
def test_what_a_target_says_of_itself_is_what_its_print_shows(pattern: Pattern) -> None:
    """Its kind of corners, its grid and its symmetry."""
    rng = np.random.default_rng(2)
    corners, kind = pattern.points_m[:, :2], pattern.corner_kind(DetectionOptions().fit)
    np.testing.assert_array_equal(kind.corners_m, corners)
    for quadrant in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        beside = corners + 0.05 * kind.square_m * np.array(quadrant)
        white = pattern.reflectance(beside, np.zeros_like(beside)) > 0.5
        np.testing.assert_array_equal(white, kind.sign * quadrant[0] * quadrant[1] > 0)
    low, size = np.array(pattern.top_left_m), np.array(pattern.size_m)
    points = low + size * rng.uniform(0.02, 0.98, (4000, 2))
    turned = 2.0 * (low + 0.5 * size) - points
    same = (pattern.reflectance(points, np.zeros_like(points)) == pattern.reflectance(turned, np.zeros_like(points))).mean()
    assert (same > 0.999) == pattern.looks_same_turned
    grid = pattern.plain_grid
    if grid is None:
        with pytest.raises(NotImplementedError):
            pattern.resized(8, 6)
        return
    row, column = np.divmod(np.arange(grid.columns * grid.rows), grid.columns)
    np.testing.assert_allclose(corners - corners[0], grid.pitch_m * np.stack([column, row], 1), atol=1e-12)
    larger = pattern.resized(grid.columns + 3, grid.rows + 1)
    assert larger.plain_grid == replace(grid, columns=grid.columns + 3, rows=grid.rows + 1)


@pytest.mark.parametrize("pattern", EACH_KIND)
def test_a_target_agrees_with_a_photo_of_itself_only(pattern: Pattern) -> None:
    model, pose = camera(), pose_in_front(pattern)
    image = render_target(pattern, model, pose)
    seen = pattern.marks_agree(image, lambda points: projected(model, pose, points), DetectionOptions())
    assert seen and pattern.may_be_in(image, DetectionOptions())
    if pattern.plain_grid is None:
        aside = pose @ Pose.of(np.eye(3), np.append(0.3 * np.array(pattern.size_m), 0.0))
        assert not pattern.marks_agree(image, lambda points: projected(model, aside, points), DetectionOptions())
    else:
        assert not pattern.may_be_in(np.full_like(image, 100), DetectionOptions())


def projected(model: Pinhole, pose: Pose, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pixels, valid = model.project(pose.transform(torch.as_tensor(points.reshape(-1, 3))))
    return pixels.numpy().reshape(*points.shape[:2], 2), valid.numpy().reshape(points.shape[:2])


@pytest.mark.parametrize("pattern", ALL)
def test_reflectance_is_the_mean_over_boxes(pattern: Pattern) -> None:
    rng = np.random.default_rng(1)
    low, size = np.array(pattern.top_left_m), np.array(pattern.size_m)
    centres = low + size * rng.uniform(0.1, 0.9, (40, 2))
    widths = size * rng.uniform(0.002, 0.2, (40, 2))
    mean = pattern.reflectance(centres, widths)
    # One sample somewhere in each of 100 x 100 cells: as accurate as one in the middle of each of 400 x 400.
    cells = np.stack(np.meshgrid(np.arange(100), np.arange(100)), -1).reshape(-1, 2)
    places = (cells + rng.uniform(size=(40, len(cells), 2))) / 100 - 0.5
    points = centres[:, None] + widths[:, None] * places
    sampled = pattern.reflectance(points, np.zeros_like(points))
    assert set(np.unique(sampled)) == {0.0, 1.0}
    np.testing.assert_allclose(mean, sampled.mean(1), atol=6e-3)
    assert pattern.reflectance(low[None] + 0.01 * size, np.zeros((1, 2)))[0] == 1.0  # the margin


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("pattern", ALL)
@pytest.mark.slow
def test_finds_every_corner_of_a_clean_photo(pattern: Pattern, mirrored: bool) -> None:
    model, pose = camera(), pose_in_front(pattern)
    image = render_target(pattern, model, pose)
    truth = true_pixels(pattern, model, pose)
    if mirrored:
        image, truth = np.ascontiguousarray(image[:, ::-1]), np.array([SIZE[0] - 1, 0]) + truth * [-1, 1]
    detection, reason = pattern.detect(image, mirrored=mirrored)
    assert reason is None and pattern.ids_are_known(detection.ids)
    assert detection.ids.tolist() == list(range(len(pattern.points_m)))
    error = errors_px(pattern, detection, truth)
    assert np.sqrt((error**2).mean()) < 0.02 and np.abs(error.mean(0)).max() < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("pattern", EACH_KIND)
def test_every_depth_and_colour_gives_the_same_corners(pattern: Pattern) -> None:
    grey = render_target(pattern, camera(), pose_in_front(pattern))
    wanted, _ = pattern.detect(grey)
    for image in (grey.astype(np.uint16) * 257, cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), (grey // 4 + 10).astype(np.uint16)):
        found, reason = pattern.detect(image)
        assert reason is None
        np.testing.assert_allclose(found.pixels, wanted.pixels, atol=0.03)


@pytest.mark.parametrize("pattern", EACH_KIND)
@pytest.mark.slow
def test_says_why_nothing_was_found(pattern: Pattern) -> None:
    rng = np.random.default_rng(0)
    pure_noise = rng.integers(0, 256, (240, 320)).astype(np.uint8)
    sharp = cv2.resize(render_target(pattern, camera(), pose_in_front(pattern)), (320, 240), interpolation=cv2.INTER_AREA)
    cases = {
        "too dark .* 99 percent of it is below 2 percent": np.full((240, 320), 4, dtype=np.uint8),
        "too dark .*: it is black": np.zeros((240, 320), dtype=np.uint16),
        "overexposed: 99 percent of it is above 99 percent": np.full((240, 320), 254, dtype=np.uint8),
        "overexposed: it is white": np.full((240, 320), 255, dtype=np.uint8),
        "too little contrast": np.full((240, 320), 120, dtype=np.uint8),
        "too blurred": cv2.GaussianBlur(sharp, (0, 0), 20),
        "No ": pure_noise,
    }
    for words, image in cases.items():
        detection, reason = pattern.detect(image)
        assert len(detection) == 0 and reason is not None and re.search(words, reason) and reason.endswith(".")


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4), np.uint8)])
def test_rejects_what_is_no_photo(image: np.ndarray) -> None:
    with pytest.raises(InputError, match="Expected a photo"):
        ALL[0].values[0].detect(image)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "charuco:20x20:30mm:22mm:DICT_5X5_100",
            "at least 200 tags was expected, found 'DICT_5X5_100'; use one of DICT_4X4_250,",
        ),
        (
            "charuco:90x70:30mm:22mm:DICT_5X5_100",
            "at least 3150 tags .* the largest, DICT_APRILTAG_36h10, has 2320: make a smaller",
        ),
        ("aprilgrid:7x6:35mm:0.3:16h5", "at least 42 tags .* use one of 36h11, 36h10."),
        ("aprilgrid:60x60:35mm:0.3:36h11", "at least 3600 tags .* the largest, 36h10, has 2320: make a smaller board"),
        ("aprilgrid:6x6:35mm:0.3:37h11", "found '37h11'; use one of 36h11, 36h10"),
    ],
)
def test_a_set_of_too_few_tags(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        calib_patterns.pattern(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "chessboard:8x6:3mm",
        "checkerboard",
        "checkerboard:8x6",
        "checkerboard:8:6:3mm",
        "checkerboard:2x6:3mm",
        "checkerboard:8x6:0mm",
        "checkerboard:8x6:-3mm",
        "checkerboard:8x6:3",
        "checkerboard:8x6:3inch",
        "checkerboard:8x6:nanmm",
    ],
)
def test_malformed_specification(text: str) -> None:
    with pytest.raises(InputError) as error:
        calib_patterns.pattern(text)
    assert "\n" not in str(error.value)


def test_units() -> None:
    assert {
        calib_patterns.pattern(f"checkerboard:8x6:{s}").specification for s in ("32.5mm", "3.25cm", "0.0325m", " 32.50 mm")
    } == {"checkerboard:8x6:32.5mm"}


@pytest.mark.slow
def test_black_first_square_settles_the_half_turn() -> None:
    """For nx + ny odd the numbering is that of the print, whichever way the board is turned."""
    pattern, model = calib_patterns.pattern("checkerboard:7x6:30mm"), camera()
    for angle in (0.1, 1.4, 3.0, -1.7):
        pose = pose_in_front(pattern, turn=(0.0, 0.1, angle))
        detection, reason = pattern.detect(render_target(pattern, model, pose))
        assert reason is None
        np.testing.assert_allclose(detection.pixels, true_pixels(pattern, model, pose), atol=0.1)


@pytest.mark.parametrize("counts", ["7x6", "8x5", "7x5", "4x4"])
def test_part_of_a_larger_board_is_not_a_hit(counts: str) -> None:
    board = calib_patterns.pattern("checkerboard:8x6:32.5mm")
    image = render_target(board, camera(), pose_in_front(board))
    detection, reason = calib_patterns.pattern(f"checkerboard:{counts}:32.5mm").detect(image)
    assert len(detection) == 0 and reason is not None


@pytest.mark.parametrize("pattern", ALL, ids=lambda p: p.specification)
@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (3, 200), (20, 23)])
def test_tiny_photos_show_nothing(pattern: Pattern, shape: tuple[int, int]) -> None:
    detection, reason = pattern.detect(np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8))
    assert len(detection) == 0 and reason is not None and ("too small" in reason) == (min(shape) < 20)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 480), (3200, 2400), pytest.param((5600, 4200), marks=pytest.mark.full)])
def test_small_and_very_large_photos(size: tuple[int, int]) -> None:
    """0.3, 8 and 24 megapixels; the reduced search brings no half-pixel shift."""
    pattern, model = calib_patterns.pattern("checkerboard:8x6:32.5mm"), camera(size)
    pose = pose_in_front(pattern, size)
    sharpness = size[0] / 2000
    image = render_target(pattern, model, pose, supersample=2, blur_px=0.5 + sharpness, noise_grey=2.0)
    detection, reason = pattern.detect(image)
    assert reason is None and len(detection) == 48
    error = errors_px(pattern, detection, true_pixels(pattern, model, pose))
    assert np.sqrt((error**2).mean()) < 0.06 and np.abs(error.mean(0)).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "specification", "at_least"),
    [
        ("fisheye1", "checkerboard:8x6:32.5mm", 15),
        ("fisheye190", "checkerboard:7x6:30mm", 8),
        ("kaidan", "checkerboard:11x7:30mm", 16),
    ],
)
def test_real_photos(shared_data, folder: str, specification: str, at_least: int) -> None:
    """Hits, and where another detector's corners are known, agreement with them."""
    pattern = calib_patterns.pattern(specification)
    images = sorted((shared_data / "calibration" / folder / "images").glob("*.jpg"))
    table = shared_data / "calibration" / folder / "corners.csv"
    known = np.genfromtxt(table, delimiter=",", names=True, dtype=None, encoding="utf-8") if table.exists() else None
    hits, compared, share = 0, 0, []
    for path in images:
        detection, reason = pattern.detect(cv2.imread(str(path)))
        hits += reason is None
        share.append(len(detection) / len(pattern.points_m))
        if known is None or reason is not None or path.name not in known["image"]:
            continue
        rows = known[known["image"] == path.name]
        theirs = np.stack([rows["u_px"], rows["v_px"]], -1)
        distance = np.linalg.norm(detection.pixels[:, None] - theirs, axis=2).min(1)
        assert np.sqrt((distance**2).mean()) < 0.35
        compared += 1
    assert hits >= at_least
    assert np.median(share) > 0.97
    assert known is None or compared >= 6


def test_sigma_states_the_error() -> None:
    """Over many noisy photos, errors divided by their stated sigma have unit root mean square within the floor's caution."""
    pattern, model = calib_patterns.pattern("checkerboard:8x6:32.5mm"), camera((640, 480))
    pose = pose_in_front(pattern, (640, 480))
    truth = true_pixels(pattern, model, pose)
    clean = render_target(pattern, model, pose, blur_px=0.7).astype(np.float64)
    rng = np.random.default_rng(3)
    normalised = []
    for noise in (5.0, 10.0, 15.0):
        noisy = np.clip(np.rint(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
        detection, reason = pattern.detect(noisy)
        assert reason is None
        normalised.append(errors_px(pattern, detection, truth) / detection.sigma_px[:, None])
    assert len(normalised) == 3
    assert 0.75 < np.sqrt((np.concatenate(normalised) ** 2).mean()) < 1.2
