"""Boards with tags in another print than the one given: white on black, in the old layout, with other tags; and several boards of
one dictionary."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_patterns import camera, errors_px, pose_in_front, true_pixels

import omnilines as ol
from calib_patterns import pattern
from calib_patterns.rendering import render_target

PRINTS = [
    ("charuco:8x6:40mm:30mm:DICT_4X4_50", "charuco:8x6:40mm:30mm:DICT_4X4_50:legacy"),
    ("charuco:8x6:40mm:30mm:DICT_4X4_50:legacy", "charuco:8x6:40mm:30mm:DICT_4X4_50"),
    ("charuco:4x5:54mm:40.5mm:DICT_4X4_1000", "charuco:4x5:54mm:40.5mm:DICT_4X4_1000:inverted"),
    ("charuco:4x6:54mm:40.5mm:DICT_4X4_1000", "charuco:4x6:54mm:40.5mm:DICT_4X4_1000:legacy:start=12:inverted"),
    ("charuco:4x5:54mm:40.5mm:DICT_4X4_50:inverted", "charuco:4x5:54mm:40.5mm:DICT_4X4_50"),
    ("aprilgrid:4x3:60mm:0.3:36h11", "aprilgrid:4x3:60mm:0.3:36h11:inverted"),
    ("aprilgrid:4x3:60mm:0.3:36h11", "aprilgrid:4x3:60mm:0.3:36h11:start=24"),
    ("aprilgrid:4x3:60mm:0.3:36h11:start=24", "aprilgrid:4x3:60mm:0.3:36h11:start=5"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("given", "printed"), PRINTS)
def test_a_board_is_taken_for_what_the_photos_show(given: str, printed: str) -> None:
    board = pattern(printed)
    pose = pose_in_front(board)
    photo = render_target(board, camera(), pose)
    empty = np.full_like(photo, 120)
    found = ol.detect({"a": empty, "b": photo, "c": empty}, given)
    assert found.pattern == board and found.inputs["pattern"] == printed
    assert len(found.notes) == 1 and f"The board is {printed}, not {given}" in found.notes[0]
    detection = found.detection("b")
    assert len(detection) == len(board.points_m)
    assert np.abs(errors_px(board, detection, true_pixels(board, camera(), pose))).max() < 0.1
    assert ol.detect({"b": photo}, printed).notes == ()


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("size", [(8, 6), (5, 8), (9, 7), (7, 9)])
def test_layouts_are_those_of_opencv(size: tuple[int, int], legacy: bool) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    peer = cv2.aruco.CharucoBoard(size, 0.03, 0.022, dictionary, np.arange(7, 7 + size[0] * size[1] // 2))
    peer.setLegacyPattern(legacy)
    ours = pattern(f"charuco:{size[0]}x{size[1]}:30mm:22mm:DICT_5X5_100{':legacy' if legacy else ''}:start=7")
    np.testing.assert_allclose(np.array(peer.getObjPoints())[..., :2], ours.tag_corners_m, atol=1e-8)  # type: ignore[attr-defined]
    np.testing.assert_allclose(peer.getChessboardCorners(), ours.points_m, atol=1e-8)
    # What OpenCV draws is found, at its own pixels: a square is 40 px, the margin of OpenCV's drawing 30.
    drawn = peer.generateImage((size[0] * 40 + 60, size[1] * 40 + 60), marginSize=30)
    for image, board in ((drawn, ours), (255 - drawn, pattern(f"{ours.specification}:inverted"))):
        found, reason = board.detect(cv2.GaussianBlur(image, (0, 0), 0.7))
        assert reason is None and found.ids.tolist() == list(range(len(ours.points_m)))
        assert np.abs(found.pixels - (ours.points_m[:, :2] / 0.03 * 40 + 29.5)).max() < 0.1


@pytest.mark.slow
def test_the_wrong_layout_is_refused_by_a_board_alone() -> None:
    """Every other row of its tags agrees, which is half of them."""
    board = pattern("charuco:8x6:40mm:30mm:DICT_4X4_50:legacy")
    photo = render_target(board, camera(), pose_in_front(board))
    found, reason = pattern("charuco:8x6:40mm:30mm:DICT_4X4_50").detect(photo)
    assert len(found) == 0 and reason is not None


@pytest.mark.slow
def test_boards_of_one_dictionary_are_told_apart_by_their_tags() -> None:
    """Two sides of a cube in one photo."""
    sides = [pattern(f"aprilgrid:4x3:60mm:0.3:36h11{start}") for start in ("", ":start=12")]
    poses = [pose_in_front(side) for side in sides]
    photos = [render_target(side, camera(), pose) for side, pose in zip(sides, poses, strict=True)]
    width = photos[0].shape[1]
    both = {"left": {"1": np.hstack(photos)}, "right": {"1": np.hstack(photos[::-1])}}
    found = ol.detect_rig(both, [side.specification for side in sides])
    assert not found.notes and len(found.cameras) == 4
    for item in found.cameras:
        k = sides.index(item.pattern)
        detection = item.found.detection(f"{item.camera}/1")
        shift = width * (k if item.camera == "left" else 1 - k)
        assert len(detection) == 48
        error = detection.pixels - [shift, 0] - true_pixels(sides[k], camera(), poses[k])[detection.ids]
        assert np.abs(error).max() < 0.1


RIGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "rigs"


@pytest.mark.full
@pytest.mark.skipif(not RIGS.is_dir(), reason="shared data are not there")
def test_a_real_board_is_taken_for_what_it_is() -> None:
    """Photos of the current layout, given as the old one."""
    spec = "charuco:20x20:4mm:3.2mm:DICT_4X4_1000"
    found = ol.detect([RIGS / "charuco_close" / "1" / f"cal{k}.jpg" for k in (1, 5)], f"{spec}:legacy")
    assert found.inputs["pattern"] == spec and len(found.corners.images) == 2 and len(found.corners) > 200
