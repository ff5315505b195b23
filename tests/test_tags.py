"""Reading tags and mapping boards locally, against closed forms."""

import cv2
import numpy as np
import pytest

from calib_patterns import DetectionOptions
from calib_patterns._cells import CellGrid
from calib_patterns.local_map import KnownCorners, disagreement, local_map
from calib_patterns.tag_decoding import Codes, decode
from calib_patterns.tags import TagFamily, find_tags

OPTIONS = DetectionOptions()
FAMILY = TagFamily("APRILTAG_36h11", 2, touching=False)
CODES = Codes(np.stack([FAMILY.bits(tag) for tag in range(40)]), 2, 3)


def sheet(tag: int, wrong: int = 0, cell: int = 6, seed: int = 0) -> np.ndarray:
    """A tag with some inner bits turned over, at (40, 40) on white."""
    bits = FAMILY.bits(tag).copy()
    inner = np.stack(np.meshgrid(np.arange(2, 8), np.arange(2, 8)), -1).reshape(-1, 2)
    for row, column in np.random.default_rng(seed).permutation(inner)[:wrong]:
        bits[row, column] ^= True
    image = np.full((40 + 10 * cell + 40,) * 2, 220, dtype=np.uint8)
    image[40 : 40 + 10 * cell, 40 : 40 + 10 * cell] = np.where(np.kron(bits, np.ones((cell, cell))), 30, 220)
    return image


QUAD = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0]]) + 39.5


@pytest.mark.parametrize("turn", range(4))
def test_tags_are_read_in_every_turn(turn: int) -> None:
    """The corners come back in the tag's own order, whichever corner of the quadrilateral is the first."""
    for tag in (0, 7, 39):
        rows, ids, corners = decode(sheet(tag), np.roll(QUAD, turn, axis=0)[None], CODES, OPTIONS.tags)
        assert rows.tolist() == [0] and ids.tolist() == [tag]
        np.testing.assert_allclose(corners[0], QUAD)


def test_wrong_bits_are_put_right_up_to_the_limit() -> None:
    for wrong, reads in ((0, True), (3, True), (4, False)):
        rows, ids, _ = decode(sheet(5, wrong), QUAD[None], CODES, OPTIONS.tags)
        assert (ids.tolist() == [5]) if reads else (len(rows) == 0)


def test_no_tag_reads_as_none() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (140, 140)).astype(np.uint8)
    black = np.zeros((140, 140), dtype=np.uint8)
    mirrored = np.ascontiguousarray(sheet(5)[:, ::-1])
    for image in (noise, black, 255 - sheet(5), mirrored):
        assert len(decode(image, QUAD[None], CODES, OPTIONS.tags)[0]) == 0
    assert len(decode(noise, np.zeros((0, 4, 2)), CODES, OPTIONS.tags)[0]) == 0


def test_a_tag_that_disagrees_with_its_neighbours_is_left_out() -> None:
    """Nine tags on a grid, the middle one printed in the wrong place as well."""
    board = np.array([[[k % 3, k // 3]] for k in range(9)]) + 0.6 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    image = np.full((500, 900), 220, dtype=np.uint8)
    for tag in range(9):
        x, y = 20 + 100 * (tag % 3), 20 + 100 * (tag // 3)
        image[y : y + 60, x : x + 60] = sheet(tag)[40:100, 40:100]
    image[400:460, 700:760] = sheet(4)[40:100, 40:100]
    found = find_tags(image, FAMILY, board, OPTIONS)
    assert found.ids.tolist() == list(range(9))
    np.testing.assert_allclose(found.pixels, 100.0 * board + 19.5, atol=1.5)
    image[120:180, 120:180] = 220
    assert find_tags(image, FAMILY, board, OPTIONS).ids.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def fisheye(board: np.ndarray) -> np.ndarray:
    """A plane at distance 0.12 through r = 300 theta, in closed form."""
    ray = np.stack([board[..., 0] + 0.05, board[..., 1] - 0.02, np.full(board.shape[:-1], 0.12)], -1)
    radius = np.linalg.norm(ray[..., :2], axis=-1)
    return 300.0 * (np.arctan2(radius, ray[..., 2]) / radius)[..., None] * ray[..., :2] + 500.0


GRID = 0.03 * np.stack(np.meshgrid(np.arange(-3.0, 4.0), np.arange(-2.0, 3.0)), -1).reshape(-1, 2)


def test_local_map_of_a_fisheye_with_its_derivatives() -> None:
    known = KnownCorners(GRID, fisheye(GRID), np.full(len(GRID), 0.02))
    inner = np.flatnonzero((np.abs(GRID[:, 0]) < 0.07) & (np.abs(GRID[:, 1]) < 0.04))
    fitted = local_map(known, GRID[inner], 0.03, OPTIONS.map)
    h, steps = 1e-4, np.eye(2) * 1e-4
    plus, minus, here = (fisheye(GRID[inner][:, None] + step) for step in (steps, -steps, 0.0 * steps))
    np.testing.assert_allclose(fitted.pixels, here[:, 0], atol=0.03)
    np.testing.assert_allclose(fitted.first, np.swapaxes((plus - minus) / (2 * h) * 0.03, 1, 2), atol=0.25)
    second = np.swapaxes((plus + minus - 2 * here) / h**2 * 0.03**2, 1, 2)
    np.testing.assert_allclose(fitted.second, second, atol=0.5)
    assert np.abs(second).max() > 10  # a homography fitted to a square would not know


def test_predictions_state_their_error() -> None:
    """Left out in turn, with noise: errors within the stated deviation, which grows away from what is known."""
    rng = np.random.default_rng(2)
    normalised = []
    for _ in range(20):
        noisy = fisheye(GRID) + rng.normal(0.0, 0.2, GRID.shape)
        known = KnownCorners(GRID, noisy, np.full(len(GRID), 0.2))
        predicted = local_map(known, GRID, 0.03, OPTIONS.map, leave_out=True)
        normalised.append((predicted.pixels - fisheye(GRID)) / predicted.sigma_px[:, None])
    assert 0.3 < np.sqrt((np.concatenate(normalised) ** 2).mean()) < 1.1
    few = np.array([0, 1, 7, 8])
    known = KnownCorners(GRID[few], fisheye(GRID[few]), np.full(4, 0.2))
    far = local_map(known, GRID[[8, 16, 24, 32]], 0.03, OPTIONS.map).sigma_px
    assert far[0] < 0.25 and (np.diff(far) > 1.0).all()


def test_a_wrong_corner_disagrees() -> None:
    pixels = fisheye(GRID)
    pixels[17] += [6.0, -4.0]
    over = disagreement(KnownCorners(GRID, pixels, np.full(len(GRID), 0.05)), 0.03, OPTIONS.map)
    assert over.argmax() == 17 and over[17] > 1.0
    assert disagreement(KnownCorners(GRID, fisheye(GRID), np.full(len(GRID), 0.05)), 0.03, OPTIONS.map).max() < 1.0


def test_cells_merge_edges_that_only_rounding_sets_apart() -> None:
    cells = CellGrid.of_rectangles(np.array([[0.0, 0.0, 0.1 + 0.2, 1.0], [0.3, 0.0, 1.0, 1.0]]))
    assert cells.black.shape == (1, 2) and len(cells.rectangles_m) == 1
    thin = cells.reflectance(np.array([[1.0, 0.5], [0.5, 0.5], [2.0, 0.5]]), np.array([[0.5, 0.0], [0.0, 0.0], [0.1, 0.1]]))
    np.testing.assert_allclose(thin, [0.5, 0.0, 1.0], atol=1e-9)


def test_one_tag_of_few_bits_is_no_evidence() -> None:
    """Sixteen bits are read in clutter now and then, thirty-six are not."""
    board = np.array([[[k % 3, k // 3]] for k in range(30)]) + 0.6 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    counts = {}
    for name in ("16h5", "36h11"):
        family = TagFamily(f"APRILTAG_{name}", 2, touching=False)
        image = np.full((200, 400), 220, dtype=np.uint8)
        for tags in (1, 2):
            cells = np.kron(family.bits(tags - 1), np.ones((8, 8)))
            left = 40 + int((tags - 1) * len(cells) / 0.6)
            image[40 : 40 + len(cells), left : left + len(cells)] = np.where(cells, 30, 220)
            counts[name, tags] = len(find_tags(image, family, board, OPTIONS).ids)
    assert counts == {("16h5", 1): 0, ("16h5", 2): 2, ("36h11", 1): 1, ("36h11", 2): 2}


def test_opencv_and_our_reading_agree() -> None:
    """On OpenCV's own picture of a tag, turned and scaled."""
    matrix = cv2.getRotationMatrix2D((70, 70), 33.0, 0.8)
    image = cv2.warpAffine(sheet(11), matrix, (140, 140), flags=cv2.INTER_AREA, borderValue=220.0)
    found = find_tags(image, FAMILY, np.tile(QUAD / 100.0, (40, 1, 1)), OPTIONS)
    assert found.ids.tolist() == [11]
    np.testing.assert_allclose(found.pixels[0], QUAD @ matrix[:, :2].T + matrix[:, 2], atol=1.5)
