"""ChArUco boards: OpenCV's geometry, print and numbering; detection through wide lenses, whole and in part."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from tag_views import check_partial, views

import calib_patterns
from calib_patterns import DetectionOptions
from calib_patterns.board_poses import random_board_poses
from calib_patterns.charuco import TAGS_OF_DICTIONARY, ChArUco
from calib_patterns.rendering import render_target
from calib_patterns.tags import find_tags
from camera_models.errors import InputError
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose

SPEC = "charuco:9x7:30mm:22mm:DICT_5X5_100"
BOARD = calib_patterns.pattern(SPEC)
PINHOLE = Pinhole.from_mapping({"fx": 960.0, "fy": 960.0, "cx": 479.5, "cy": 359.5}, (960, 720))


def opencv_board(board: ChArUco) -> "cv2.aruco.CharucoBoard":
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    ids = np.arange(board.first_tag, board.first_tag + len(board.tag_corners_m))
    theirs = cv2.aruco.CharucoBoard((board.nx, board.ny), board.square_m, board.marker_m, dictionary, ids)
    theirs.setLegacyPattern(board.legacy)
    return theirs


PRINTED = [board for board in ChArUco.examples() if isinstance(board, ChArUco)]


@pytest.mark.parametrize("board", PRINTED, ids=lambda board: board.specification)
def test_geometry_and_print_are_opencvs(board: ChArUco) -> None:
    theirs = opencv_board(board)
    np.testing.assert_allclose(board.points_m, np.array(theirs.getChessboardCorners()), atol=1e-7)
    assert theirs.getIds().ravel().tolist() == list(range(board.first_tag, board.first_tag + len(board.tag_corners_m)))
    np.testing.assert_allclose(board.tag_corners_m, np.array(theirs.getObjPoints())[..., :2], atol=1e-7)
    # Their picture and ours, except at the edges of bits, which theirs rounds to pixels.
    scale = 120
    printed = theirs.generateImage((board.nx * scale, board.ny * scale), marginSize=0, borderBits=1)
    u, v = np.meshgrid(np.arange(printed.shape[1]), np.arange(printed.shape[0]))
    points = np.stack([u + 0.5, v + 0.5], -1) * board.square_m / scale
    near_edge = board.reflectance(points, np.full_like(points, 4.0 * board.square_m / scale))
    same = board.reflectance(points, np.zeros_like(points)) == printed / 255.0
    assert same[(near_edge == 0) | (near_edge == 1)].all() and same.mean() > 0.95


def test_dictionaries_are_opencvs() -> None:
    for name, count in TAGS_OF_DICTIONARY.items():
        assert len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList) == count, name
    assert len(TAGS_OF_DICTIONARY) > 20


@pytest.mark.slow
def test_opencvs_detector_reads_our_photo_with_our_ids() -> None:
    rotation, _ = cv2.Rodrigues(np.array([0.2, -0.15, 0.1]))
    pose = Pose.of(rotation, np.array([0.0, 0.0, 0.45]) - rotation @ np.array([0.135, 0.105, 0.0]))
    image = render_target(BOARD, PINHOLE, pose)
    assert isinstance(BOARD, ChArUco)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(opencv_board(BOARD)).detectBoard(image)
    found, reason = BOARD.detect(image)
    assert reason is None and found.ids.tolist() == sorted(ids.ravel().tolist()) == list(range(48))
    assert np.abs(found.pixels[ids.ravel()] - corners.reshape(-1, 2)).max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["scaramuzza", pytest.param("fisheye-190", marks=pytest.mark.full)])
def test_every_corner_through_wide_lenses(camera: str) -> None:
    """Boards out to 85 degrees: all corners, right ids, hundredths of a pixel."""
    errors = []
    for view in views(SPEC, camera, 4, 12.0):
        found, reason = BOARD.detect(view.image)
        assert reason is None and len(found) == 48
        errors.append(found.pixels - view.truth)
    error = np.concatenate(errors)
    assert len(errors) == 4 and np.sqrt((error**2).mean()) < 0.03 and np.abs(error).max() < 0.3
    assert np.abs(error.mean(0)).max() < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["scaramuzza", pytest.param("fisheye-190", marks=pytest.mark.full)])
def test_part_of_the_board(camera: str) -> None:
    checked = 0
    for index, view in enumerate(views(SPEC, camera, 4, 12.0)):
        for part in (view.cropped(0.4, index % 2), view.covered(0.6, 2.0 * index, index)):
            found, reason = BOARD.detect(part.image)
            assert reason is None
            check_partial(found, part, may_miss=1)
            checked += 1
    assert checked == 8


@pytest.mark.slow
def test_one_tag_with_its_corners_is_enough() -> None:
    """Three squares by three of the board, through the fisheye."""
    view = views(SPEC, "fisheye-190", 4, 12.0)[0]
    grid = view.truth.reshape(6, 8, 2)
    window = grid[1:4, 2:5].reshape(-1, 2)
    low, high = np.floor(window.min(0) - 4).astype(int), np.ceil(window.max(0) + 4).astype(int)
    found, reason = BOARD.detect(np.ascontiguousarray(view.image[low[1] : high[1], low[0] : high[0]]))
    assert reason is None and set(np.arange(48).reshape(6, 8)[1:4, 2:5].ravel()) <= set(found.ids)
    assert np.linalg.norm(found.pixels + low - view.truth[found.ids], axis=1).max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("share", ["tag_margin_share", "least_margin_share"])
def test_no_white_beside_tags_is_an_option(share: str) -> None:
    """Black squares tell where corners are, without white ones too."""
    pose = Pose.of(torch.eye(3), BOARD.points_m.mean(0) * -1.0 + [0.0, 0.0, 0.4])
    image = render_target(BOARD, PINHOLE, pose, blur_px=0.7, seed=1)
    options = DetectionOptions()
    found, _ = BOARD.detect(image, options=replace(options, fit=options.fit._replace(**{share: 0.0})))
    usual, _ = BOARD.detect(image)
    assert len(usual) == len(BOARD.points_m) and np.isin(usual.ids, found.ids).all()
    assert np.abs(found.pixels - usual.pixels).max() < 0.1


@pytest.mark.slow
def test_squares_lead_where_no_tag_can_be_read() -> None:
    """Squares of 12 px near the rim, blurred, of which four corners in a square are all that the search for pieces finds: others
    are grown around them, and all tags together tell which part of the board it is. Not with the tags of other dictionaries."""
    model = OpenCVFisheye([230.0, 230.0, 639.5, 479.5, 0.01, -0.002, 0.0005, 0.0], (1280, 960))
    pose = random_board_poses(BOARD, model, 8, math.radians(108.0), min_spacing_px=12.0, seed=77)[3]
    image = render_target(BOARD, model, pose, blur_px=1.2, noise_grey=5.0, vignetting=0.2, seed=3)
    assert isinstance(BOARD, ChArUco)
    assert len(find_tags(image, BOARD.family, BOARD.tag_corners_m, DetectionOptions()).ids) == 0
    truth = model.project(pose.transform(torch.as_tensor(BOARD.points_m)))[0].numpy()
    found, reason = BOARD.detect(image)
    assert reason is None and found.ids.tolist() == list(range(48))
    assert np.abs(found.pixels - truth).max() < 0.25
    others = ("DICT_6X6_250", "DICT_ARUCO_ORIGINAL")
    for dictionary in others:
        assert len(calib_patterns.pattern(f"charuco:9x7:30mm:22mm:{dictionary}").detect(image)[0]) == 0
    assert len(others) == 2


@pytest.mark.parametrize("size", ["10x7", "7x9", "12x9"])
@pytest.mark.slow
def test_a_board_of_another_size_is_refused(size: str) -> None:
    """Its tags are read, but most of them lie elsewhere on the board."""
    found, reason = calib_patterns.pattern(f"charuco:{size}:30mm:22mm:DICT_5X5_100").detect(
        views(SPEC, "fisheye-190", 4, 12.0)[1].image
    )
    assert len(found) == 0 and reason is not None


@pytest.mark.slow
def test_sigma_states_the_error() -> None:
    rotation, _ = cv2.Rodrigues(np.array([0.2, -0.15, 0.1]))
    pose = Pose.of(rotation, np.array([0.0, 0.0, 0.45]) - rotation @ np.array([0.135, 0.105, 0.0]))
    clean = render_target(BOARD, PINHOLE, pose, blur_px=0.7).astype(np.float64)
    camera = np.array([[960.0, 0, 479.5], [0, 960.0, 359.5], [0, 0, 1]])
    truth = cv2.projectPoints(BOARD.points_m, rotation, pose.translation.numpy(), camera, None)[0].reshape(-1, 2)
    rng = np.random.default_rng(3)
    normalised = []
    for noise in (5.0, 10.0, 15.0):
        noisy = np.clip(np.rint(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
        found, reason = BOARD.detect(noisy)
        assert reason is None and len(found) == 48
        normalised.append((found.pixels - truth) / found.sigma_px[:, None])
    assert len(normalised) == 3 and 0.75 < np.sqrt((np.concatenate(normalised) ** 2).mean()) < 1.2


@pytest.mark.parametrize(
    "other",
    ["charuco:9x7:30mm:22mm:DICT_4X4_50", "aprilgrid:6x6:35mm:0.3:36h11", "charuco:3x3:30mm:22mm:DICT_APRILTAG_16h5"],
)
def test_nothing_is_found_on_another_target(other: str) -> None:
    found, reason = calib_patterns.pattern(other).detect(views(SPEC, "fisheye-190", 4, 12.0)[1].image)
    assert len(found) == 0 and reason is not None


@pytest.mark.slow
def test_a_mirrored_photo_needs_the_option() -> None:
    view = views(SPEC, "scaramuzza", 4, 12.0)[0]
    flipped = np.ascontiguousarray(view.image[:, ::-1])
    assert len(BOARD.detect(flipped)[0]) == 0
    found, reason = BOARD.detect(flipped, mirrored=True)
    assert reason is None and len(found) == 48
    expected = view.truth * [-1, 1] + [view.image.shape[1] - 1, 0]
    assert np.abs(found.pixels - expected).max() < 0.3


@pytest.mark.parametrize(
    "text",
    [
        "charuco:9x7:30mm:22mm",
        "charuco:9x7:22mm:30mm:DICT_5X5_100",
        "charuco:2x7:30mm:22mm:DICT_5X5_100",
        "charuco:9x7:30mm:22mm:DICT_5X5",
        "charuco:20x20:30mm:22mm:DICT_5X5_100",
        "charuco:9x7:30:22mm:DICT_5X5_100",
    ],
)
def test_malformed_specification(text: str) -> None:
    with pytest.raises(InputError) as error:
        calib_patterns.pattern(text)
    assert "\n" not in str(error.value)
