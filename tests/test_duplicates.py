"""Duplicate views: copies with and without noise, partial views, drift, half turns, against a search over all pairs."""

import itertools

import numpy as np
import pytest
import torch
from board_views import BOARD, COLUMNS, board_corners, board_views

from camera_models.errors import InputError
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pose import Pose
from omnilines.calibration.duplicates import duplicate_views
from omnilines.records import Corners

LENS = OpenCVFisheye([320.0, 320.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0], (1280, 960))
SIGMA_PX = 0.2
CORNERS = len(BOARD)


def of_views(pixels: np.ndarray, board_m: np.ndarray = BOARD) -> Corners:
    """(views, corners, 2) as a table."""
    views = len(pixels)
    names = tuple(map(str, range(views)))
    return Corners(np.repeat(np.arange(views), len(board_m)), names, names, np.tile(board_m, (views, 1)), pixels.reshape(-1, 2))


def rows_of(corners: Corners, keep: np.ndarray) -> Corners:
    return Corners(corners.view[keep], corners.view_names, corners.images, corners.board_m[keep], corners.pixels[keep])


def some_views(views: int, seed: int = 0) -> np.ndarray:
    """Different views with noise, (views, corners, 2)."""
    poses = board_views(LENS, 80.0, views, seed)
    return board_corners(LENS, poses, SIGMA_PX, seed).pixels.reshape(views, -1, 2)


def by_all_pairs(corners: Corners, sigma_px: float) -> list[tuple[int, int]]:
    """The definition, one pair after the other."""
    views = [
        {tuple(b): p for b, p in zip(corners.board_m[corners.view == v].tolist(), corners.pixels[corners.view == v], strict=True)}
        for v in range(len(corners.images))
    ]
    found: dict[int, int] = {}
    for i, j in itertools.combinations(range(len(views)), 2):
        common = views[i].keys() & views[j].keys()
        if i in found or j in found or len(common) < 6 or 2 * len(common) <= max(len(views[i]), len(views[j])):
            continue
        difference = np.array([views[i][c] - views[j][c] for c in common])
        if np.sqrt((difference**2).mean()) <= max(3 * sigma_px, 0.1):
            found[j] = i
    return sorted((i, j) for j, i in found.items())


def test_different_views_are_no_duplicates() -> None:
    assert duplicate_views(of_views(some_views(40)), SIGMA_PX) == []


@pytest.mark.parametrize("noise_px", [0.0, SIGMA_PX])
def test_copies_are_paired_with_the_first(noise_px: float) -> None:
    pixels = some_views(12)
    copies = {3: (7, 9), 0: (11,), 5: (6,)}
    rng = np.random.default_rng(1)
    for first, later in copies.items():
        for k in later:
            pixels[k] = pixels[first] + noise_px * rng.standard_normal(pixels[first].shape)
    expected = [(0, 11), (3, 7), (3, 9), (5, 6)]
    assert duplicate_views(of_views(pixels), SIGMA_PX) == expected
    assert duplicate_views(of_views(pixels), 0.0) == (expected if noise_px == 0.0 else [])
    # The order of the rows is nobody's business.
    shuffled = rng.permutation(12 * CORNERS)
    assert duplicate_views(rows_of(of_views(pixels), shuffled), SIGMA_PX) == expected


def test_hand_held_shots_of_one_scene_are_no_duplicates() -> None:
    """3 px apart, by a shift of the image and by a small motion of the board."""
    pixels = some_views(4)
    rng = np.random.default_rng(2)
    shifted = pixels + 3.0 * np.array([0.8, -0.6]) + SIGMA_PX * rng.standard_normal(pixels.shape)
    pose = board_views(LENS, 60.0, 1, 5)[0]
    moved = Pose(pose.rotation, pose.translation * torch.tensor([1.0, 1.0, 1.02], dtype=torch.float64))
    pair = np.stack([LENS.project(p.transform(torch.as_tensor(BOARD)))[0].numpy() for p in (pose, moved)])
    assert 1.0 < np.sqrt(((pair[0] - pair[1]) ** 2).mean()) < 6.0
    assert duplicate_views(of_views(np.concatenate([pixels, shifted, pair])), SIGMA_PX) == []


@pytest.mark.parametrize(("offset_px", "is_duplicate"), [(0.59, True), (0.61, False)])
def test_limit_is_three_sigma_rms_per_axis(offset_px: float, is_duplicate: bool) -> None:
    first = some_views(1)[0]
    for direction in ([1.0, 1.0], [np.sqrt(2.0), 0.0]):
        pixels = np.stack([first, first + offset_px * np.array(direction)])
        assert duplicate_views(of_views(pixels), SIGMA_PX) == ([(0, 1)] if is_duplicate else [])
    assert duplicate_views(of_views(np.stack([first, first + 0.099])), 0.0) == [(0, 1)]
    assert duplicate_views(of_views(np.stack([first, first + 0.101])), 0.0) == []


def test_numbering_from_the_other_end_is_another_view() -> None:
    first = some_views(1)[0]
    turned = first.reshape(-1, COLUMNS, 2)[::-1, ::-1].reshape(-1, 2)
    assert duplicate_views(of_views(np.stack([first, turned])), SIGMA_PX) == []


def test_most_corners_of_both_views_must_be_common() -> None:
    first = some_views(1)[0]
    corners = of_views(np.stack([first, first]))
    index = np.tile(np.arange(CORNERS), 2)
    for from_first, to_second, expected in ((20, 41, [(0, 1)]), (20, 40, []), (0, 27, []), (0, 28, [(0, 1)]), (33, 30, [])):
        keep = np.where(corners.view == 0, index >= from_first, index < to_second)
        counts, common = (CORNERS - from_first, to_second), to_second - from_first
        assert (common >= 6 and 2 * common > max(counts)) == bool(expected)
        assert duplicate_views(rows_of(corners, keep), SIGMA_PX) == expected
    few = index < 5
    assert duplicate_views(rows_of(corners, few), SIGMA_PX) == []


def test_slow_drift_is_cut_into_pieces() -> None:
    """Frames 0.21 px apart in u and v, limit 0.6 px: the third after the first of a piece begins the next one."""
    first = some_views(1)[0]
    pixels = np.stack([first + 0.21 * k for k in range(12)])
    expected = [(0, 1), (0, 2), (3, 4), (3, 5), (6, 7), (6, 8), (9, 10), (9, 11)]
    assert duplicate_views(of_views(pixels), SIGMA_PX) == expected


@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_a_search_over_all_pairs(seed: int) -> None:
    """Clusters of copies around the limit, with corners left out at random."""
    rng = np.random.default_rng(seed)
    parents = some_views(8, seed)
    parent = rng.integers(0, 8, 60)
    shift = rng.uniform(0, 0.5, (60, 1, 1)) * rng.standard_normal((60, 1, 2))
    corners = of_views(parents[parent] + shift + 0.15 * rng.standard_normal((60, CORNERS, 2)))
    seen = rng.uniform(size=len(corners)) < rng.uniform(0.3, 1.0, 60)[corners.view]
    found = duplicate_views(rows_of(corners, seen), SIGMA_PX)
    assert found == by_all_pairs(rows_of(corners, seen), SIGMA_PX)
    assert 20 < len(found) < 55


def test_copies_are_found_among_many_views() -> None:
    views = some_views(500)
    rng = np.random.default_rng(0)
    still = views[:1] + SIGMA_PX * rng.standard_normal((500, CORNERS, 2))
    assert duplicate_views(of_views(views), SIGMA_PX) == []
    assert duplicate_views(of_views(still), SIGMA_PX) == [(0, k) for k in range(1, 500)]


def test_nothing_and_nonsense() -> None:
    empty = rows_of(of_views(some_views(1)), np.zeros(CORNERS, dtype=bool))
    assert duplicate_views(empty, SIGMA_PX) == []
    for sigma in (-1.0, float("nan")):
        with pytest.raises(InputError, match="at least 0, found"):
            duplicate_views(empty, sigma)
