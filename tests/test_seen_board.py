"""Photos that show another target than the one asked for are answered with what they show."""

from functools import partial

import numpy as np
import pytest

import calib_patterns
import omnilines as ol
from calib_patterns import DetectionOptions
from calib_patterns.seen_board import SeenBoard, seen_board
from camera_models import InputError, OmnilinesError
from omnilines.files import photos_of
from omnilines.pipelines.detect import detect
from omnilines.pipelines.photo_corners import counts_remark
from omnilines.pipelines.seen_boards import other_board
from omnilines.progress import silent

BOARDS = {
    "checkerboard:8x6:30mm": SeenBoard("checkerboard", 8, 6),
    "charuco:9x7:30mm:22mm:DICT_5X5_100": SeenBoard("charuco", 9, 7, "DICT_5X5_50"),
    "charuco:5x8:35mm:25mm:DICT_APRILTAG_36h11": SeenBoard("charuco", 5, 8, "DICT_APRILTAG_36h11"),
    "aprilgrid:6x5:35mm:0.3:36h11": SeenBoard("aprilgrid", 6, 5, "36h11"),
}
NEGATIVE = "charuco:4x5:54mm:40.5mm:DICT_4X4_1000:inverted"


def photo(specification: str, seed: int = 0, pixels: int = 640) -> np.ndarray:
    """The target seen straight on, with noise."""
    board = calib_patterns.pattern(specification)
    step = max(board.size_m) / pixels
    x, y = (low + step * (np.arange(size / step) + 0.5) for low, size in zip(board.top_left_m, board.size_m, strict=True))
    points = np.stack(np.meshgrid(x, y), -1)
    noise = np.random.default_rng(seed).normal(0, 3, points.shape[:2])
    return np.clip(30 + 190 * board.reflectance(points, np.full_like(points, step)) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("specification", BOARDS)
def test_what_a_photo_shows_is_named(specification):
    assert seen_board(photo(specification)) == BOARDS[specification]


@pytest.mark.slow
def test_a_negative_and_a_mirror_image_are_told_and_texture_is_nothing():
    tagged = photo("charuco:9x7:30mm:22mm:DICT_5X5_100")
    assert seen_board(255 - tagged) == SeenBoard("charuco", 9, 7, "DICT_5X5_50", "negative")
    assert seen_board(np.ascontiguousarray(tagged[:, ::-1])) == SeenBoard("charuco", 9, 7, "DICT_5X5_50", "mirrored")
    assert seen_board(np.random.default_rng(1).integers(0, 255, (200, 300), dtype=np.uint8)) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shown", "asked", "said"),
    [
        ("checkerboard:8x6:30mm", "checkerboard:7x5:30mm", "look like a checkerboard of 8x6 inner corners"),
        ("checkerboard:8x6:30mm", "aprilgrid:6x6:35mm:0.3:36h11", "give checkerboard:8x6:SQUARE"),
        ("charuco:9x7:30mm:22mm:DICT_5X5_100", "charuco:9x7:30mm:22mm:DICT_4X4_50", "with tags of DICT_5X5_50"),
        ("aprilgrid:6x5:35mm:0.3:36h11", "charuco:9x7:30mm:22mm:DICT_4X4_50", "look like an AprilGrid of 6x5 tags of 36h11"),
        (NEGATIVE, "aprilgrid:6x6:35mm:0.3:36h11", r"white on black: .*give charuco:4x5:SQUARE:TAG:DICT_4X4_50:inverted\."),
        (NEGATIVE, "charuco:6x6:54mm:40mm:DICT_5X5_50", r"give charuco:4x5:54mm:40mm:DICT_4X4_50:inverted\."),
    ],
)
def test_the_error_says_what_the_photos_show(shown, asked, said):
    with pytest.raises(InputError, match=said):
        detect({f"{k}.png": photo(shown, k) for k in range(2)}, asked)


def test_a_board_of_other_sizes_is_to_be_measured() -> None:
    """Its tags are those asked for: no other board is named, and only where no photo has a corner are the sizes doubted."""
    photos, asked = photos_of({f"{k}.png": photo(NEGATIVE, k) for k in range(2)}), NEGATIVE.replace("40.5", "30")
    look = partial(other_board, photos, calib_patterns.pattern(asked), False, DetectionOptions(), silent)
    assert look(in_no_photo=False) is None
    assert look(in_no_photo=True) == (
        "The photos show its tags, but not its corners where these sizes have them: measure squares and tags."
    )


@pytest.mark.parametrize("way", [(1, -1), (-1, 1), (-1, -1)])
def test_tags_of_an_aprilgrid_that_lie_otherwise_are_said_to(way: tuple[int, int]) -> None:
    """Each tag by itself in a mirror or turned; a tag in a mirror is none, so that the whole board is put in another one."""
    board = calib_patterns.pattern("aprilgrid:6x5:35mm:0.3:36h11")
    shown = photo(board.specification, pixels=900)
    # Half a turn of the board leaves the ids in their places and turns every tag.
    step = max(board.size_m) / 900
    left, top = board.top_left_m
    for x, y in board._tag_top_left_m:
        column, row = round((x - left) / step), round((y - top) / step)
        side = round(board.tag_m / step)
        tag = shown[row : row + side, column : column + side]
        tag[:] = tag[:: way[0], :: way[1]].copy()
    turned = np.ascontiguousarray(shown[:, ::-1]) if way != (-1, -1) else shown
    found = seen_board(turned)
    assert found is not None and found.otherwise and found.shown == "" and (found.columns, found.rows) == (6, 5)
    said = other_board(photos_of([turned]), board, False, DetectionOptions(), silent, in_no_photo=True)
    assert said is not None and said.startswith("The photos show its tags turned, or numbered in another order")


@pytest.mark.slow
def test_a_wrong_layout_is_said_before_what_geometry_says_of_it() -> None:
    """Some tags of another layout agree with the one given: their corners leave any camera open."""
    asked = NEGATIVE.replace("4x5", "6x7")
    photos = {f"{k}.png": photo(NEGATIVE, k) for k in range(4)}
    said = rf"^The photos look like a ChArUco board of 4x5 .*give {NEGATIVE}\. .* those of {asked} leave the camera open \("
    with pytest.raises(OmnilinesError, match=said):
        ol.calibrate(photos, asked, model="pinhole")
    rig = {"left": photos, "right": photos}
    with pytest.raises(OmnilinesError, match=rf"^Camera left: {said[1:]}"):
        ol.calibrate_rig(ol.detect_rig(rig, asked), model="pinhole")


@pytest.mark.parametrize(
    "asked", ["charuco:4x5:54mm:40.5mm:DICT_4X4_1000:start=20", "charuco:4x6:54mm:40.5mm:DICT_4X4_50:legacy"]
)
@pytest.mark.slow
def test_tags_that_are_numbered_otherwise_are_no_other_board(asked: str) -> None:
    photos = {f"{k}.png": photo(asked, k) for k in range(4)}
    with pytest.raises(OmnilinesError) as refused:
        ol.calibrate(photos, asked, model="pinhole")
    assert "look like" not in str(refused.value)


@pytest.mark.slow
def test_photos_that_were_flipped_are_said_to_be() -> None:
    """Whose tags read as the board asked for, in a mirror: flipped by software or a mirror, no board with other tags."""
    asked = "charuco:9x7:30mm:22mm:DICT_5X5_100"
    flipped = {f"{k}.png": np.ascontiguousarray(photo(asked, k)[:, ::-1]) for k in range(2)}
    with pytest.raises(
        InputError, match=r"look like charuco:9x7:30mm:22mm:DICT_5X5_100 in a mirror: .*flip them back; .*`mirrored`"
    ):
        detect(flipped, asked)


def test_a_board_given_too_large_is_named_although_one_photo_shows_less():
    photos = {f"{k}.png": photo("checkerboard:8x6:30mm", k) for k in range(4)}
    photos["3.png"][300:] = 220
    found = detect(photos, "checkerboard:9x7:30mm")
    assert found.notes == (counts_remark(found.pattern, found.corners),) and "3 of 4 photos show 8x6" in found.notes[0]
