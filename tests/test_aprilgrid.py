"""AprilGrids: Kalibr's print and numbering; detection through wide lenses, whole and in part."""

import math

import cv2
import numpy as np
import pytest
import torch
from tag_views import CAMERAS, check_partial, views

import calib_patterns
from calib_patterns import DetectionOptions
from calib_patterns.aprilgrid import FAMILIES, AprilGrid
from calib_patterns.board_poses import random_board_poses
from calib_patterns.corner_growth import grow_corners
from calib_patterns.local_map import KnownCorners
from calib_patterns.rendering import render_target
from camera_models.errors import InputError

OPTIONS = DetectionOptions()
SPEC = "aprilgrid:6x6:35mm:0.3:36h11"
BOARD = calib_patterns.pattern(SPEC)
# The first codes of each family as published with AprilTag.
CODES = {
    "36h11": (6, (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)),
    "25h9": (5, (0x155CBF1, 0x1E4D1B6, 0x17B0B68, 0x1EAC9CD)),
    "16h5": (4, (0x231B, 0x2EA5, 0x346A, 0x45B9)),
}


@pytest.mark.parametrize("family", CODES)
def test_tags_are_printed_as_kalibr_does(family: str) -> None:
    """Kalibr draws bit s i + j of a code, black where it is 0, into row i and column j, then turns by 180 degrees."""
    side, codes = CODES[family]
    board = AprilGrid(2, 2, 0.05, 0.3, family)
    cells = side + 4
    middle = (np.arange(cells) + 0.5) * board.tag_m / cells
    for tag, code in enumerate(codes):
        left, bottom = (tag % 2) * 1.3 * board.tag_m, -(tag // 2) * 1.3 * board.tag_m
        x, y = np.meshgrid(left + middle, bottom - board.tag_m + middle)
        points = np.stack([x, y], -1)
        printed = board.reflectance(points, np.zeros_like(points)) == 0
        bits = np.array([[not code >> (side * i + j) & 1 for j in range(side)] for i in range(side)])
        np.testing.assert_array_equal(printed[2:-2, 2:-2], bits[::-1, ::-1])
        assert printed[:2].all() and printed[-2:].all() and printed[:, :2].all() and printed[:, -2:].all()


def test_corners_are_numbered_as_kalibrs() -> None:
    """Kalibr's grid of twice as many corners as tags, from its source: x right, y up."""
    board = AprilGrid(4, 3, 0.06, 0.25, "25h9")
    rows, columns = 6, 8
    kalibr = np.zeros((rows * columns, 3))
    for r in range(rows):
        for c in range(columns):
            x, y = (int(k / 2) * (1 + 0.25) * 0.06 + (k % 2) * 0.06 for k in (c, r))
            kalibr[r * columns + c] = x, y, 0.0
    np.testing.assert_allclose(board.points_m * [1, -1, 1], kalibr, atol=1e-12)


def test_every_corner_touches_a_black_square() -> None:
    assert isinstance(BOARD, AprilGrid)
    step = 0.25 * BOARD.gap * BOARD.tag_m
    around = BOARD.points_m[:, None, :2] + step * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
    colours = BOARD.reflectance(around, np.zeros_like(around))
    np.testing.assert_array_equal(colours[:, 0], colours[:, 3])
    np.testing.assert_array_equal(colours[:, 1], 1 - colours[:, 0])
    assert len(colours) == 144 and set(colours.ravel()) == {0.0, 1.0}


def test_families_are_opencvs() -> None:
    for name, (bits, count) in FAMILIES.items():
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{name}"))
        assert (dictionary.markerSize, len(dictionary.bytesList)) == (bits, count)
    assert len(FAMILIES) == 4


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["fisheye-190", pytest.param("scaramuzza", marks=pytest.mark.full)])
def test_every_corner_through_wide_lenses(camera: str) -> None:
    """Boards out to 85 degrees, tags down to 26 px: all corners, right ids, hundredths of a pixel."""
    errors = []
    for view in views(SPEC, camera, 4, 8.0):
        found, reason = BOARD.detect(view.image)
        assert reason is None and len(found) == 144
        errors.append(found.pixels - view.truth)
    error = np.concatenate(errors)
    assert len(errors) == 4 and np.sqrt((error**2).mean()) < 0.03 and np.abs(error).max() < 0.3
    assert np.abs(error.mean(0)).max() < 0.006


@pytest.mark.slow
def test_heavily_blurred_and_noisy() -> None:
    """Blur of 2 px and noise of 8 grey levels: the board is recognised though hardly a tag is read, to a quarter of a pixel."""
    board, (model, _) = calib_patterns.pattern("aprilgrid:4x3:35mm:0.3:36h11"), CAMERAS["fisheye-190"]
    poses = random_board_poses(board, model, 3, math.radians(65.0), min_spacing_px=10.0, seed=21)
    errors = []
    for index in range(3):
        image = render_target(board, model, poses[index], blur_px=2.0, noise_grey=8.0, seed=index)
        truth = model.project(poses[index].transform(torch.as_tensor(board.points_m)))[0].numpy()
        found, reason = board.detect(image)
        assert reason is None and len(found) >= 44
        errors.append(found.pixels - truth[found.ids])
    error = np.concatenate(errors)
    assert len(errors) == 3 and np.sqrt((error**2).mean()) < 0.25 and np.abs(error).max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["fisheye-190", pytest.param("scaramuzza", marks=pytest.mark.full)])
def test_part_of_the_board(camera: str) -> None:
    checked = 0
    for index, view in enumerate(views(SPEC, camera, 4, 8.0)):
        for part in (view.cropped(0.35, index % 2), view.covered(0.65, 2.0 * index, index)):
            found, reason = BOARD.detect(part.image)
            assert reason is None
            check_partial(found, part, may_miss=3)
            checked += 1
    assert checked == 8


@pytest.mark.slow
def test_one_tag_is_enough() -> None:
    view = views(SPEC, "fisheye-190", 4, 8.0)[0]
    # Tag 14 of the third row: its corners by Kalibr's rule, and the gap around it.
    ids = np.array([4 * 12 + 4, 4 * 12 + 5, 5 * 12 + 4, 5 * 12 + 5])
    corners = view.truth[ids]
    low, high = np.floor(corners.min(0) - 7).astype(int), np.ceil(corners.max(0) + 7).astype(int)
    found, reason = BOARD.detect(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]))
    assert reason is None and set(ids.tolist()) <= set(found.ids.tolist())
    assert np.linalg.norm(found.pixels + low - view.truth[found.ids], axis=1).max() < 0.3


@pytest.mark.parametrize("other", ["aprilgrid:6x5:35mm:0.3:25h9", "charuco:9x7:30mm:22mm:DICT_5X5_100"])
def test_nothing_is_found_on_another_target(other: str) -> None:
    found, reason = calib_patterns.pattern(other).detect(views(SPEC, "fisheye-190", 4, 8.0)[1].image)
    assert len(found) == 0 and reason is not None


def test_another_family_of_tags_is_refused() -> None:
    """Tags of few bits are read in other tags now and then, and the corners around them are the same: every tag of the board is
    compared with what is seen in its place."""
    board, (model, _) = calib_patterns.pattern("aprilgrid:4x3:35mm:0.3:36h11"), CAMERAS["fisheye-190"]
    other = calib_patterns.pattern("aprilgrid:4x3:35mm:0.3:16h5")
    poses = random_board_poses(board, model, 2, math.radians(65.0), min_spacing_px=10.0, seed=21)
    refused = 0
    for index in range(2):
        image = render_target(board, model, poses[index], blur_px=0.5, noise_grey=2.0, seed=index)
        truth = model.project(poses[index].transform(torch.as_tensor(board.points_m)))[0].numpy()
        assert isinstance(other, AprilGrid) and isinstance(board, AprilGrid)
        for shift in (0, 1, 8):
            # As if one tag were read: corners grown from it would be those of the board, with its ids or others.
            seeds = KnownCorners(
                board.points_m[[18, 19, 26, 27], :2], truth[np.array([18, 19, 26, 27]) + 2 * shift], np.full(4, 0.7)
            )
            assert len(grow_corners(image, other.corner_kind(OPTIONS.fit), seeds, OPTIONS)) > 20
            assert len(other._grown(image, seeds, OPTIONS)) == 0
            assert (len(board._grown(image, seeds, OPTIONS)) > 20) == (shift == 0)
            refused += 1
    assert refused == 6


@pytest.mark.parametrize(
    "text",
    [
        "aprilgrid:6x6:35mm:0.3",
        "aprilgrid:0x6:35mm:0.3:36h11",
        "aprilgrid:6x6:35mm:0.3:25h7",
        "aprilgrid:6x6:35mm:0.3:25h9",
        "aprilgrid:6x6:35mm:3:36h11",
        "aprilgrid:6x6:0mm:0.3:36h11",
        "aprilgrid:6x6:35mm:-0.3:36h11",
    ],
)
def test_malformed_specification(text: str) -> None:
    with pytest.raises(InputError) as error:
        calib_patterns.pattern(text)
    assert "\n" not in str(error.value)
