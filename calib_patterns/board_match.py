"""Which part of a board with tags a piece of its corners is, where blur or noise leaves its tags unread.

The corners of such a board lie on lines along x and along y. The cells between these lines are the squares of a ChArUco board or
the tags and gaps of an AprilGrid. Those of the piece are sampled in the photo and compared, all at once, with what every
numbering of the piece expects there. A tag whose bits run into each other still looks more like itself than like another, and a
whole board of them more so.
"""

import cv2
import numpy as np
from jaxtyping import Float, Int

from calib_patterns._pattern import Pattern
from calib_patterns.local_map import KnownCorners
from calib_patterns.options import AppearanceOptions, DetectionOptions
from calib_patterns.saddle_points import Lattice, quarter_turn

SAMPLES = 8
"""Along each side of a cell."""
LEAST_CELLS = 4
"""Fewer look like too many parts of a board."""


def matched(
    search: np.ndarray,
    piece: Lattice,
    board: Pattern,
    lines_m: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]],
    options: DetectionOptions,
) -> KnownCorners | None:
    """The corners of the piece as places of the board, None where no numbering stands out.

    `search`: the photo in 8 bits in which the piece was found, not mirrored; `lines_m`: the x and the y of the lines that the
    board's corners lie on, and of the ends of the outermost cells, ascending.
    """
    if not len(piece.places):
        return None
    (x_m, y_m), low = lines_m, piece.places.min(0)
    wide, tall = np.ptp(piece.places, axis=0) + 1
    grid = np.full((tall, wide, 2), np.nan)
    grid[piece.places[:, 1] - low[1], piece.places[:, 0] - low[0]] = piece.pixels
    whole = np.isfinite(grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]).all(-1)
    if whole.sum() < LEAST_CELLS:
        return None
    row, column = np.nonzero(whole)
    seen = _seen(search, grid, row, column)
    expected = _expected(board, x_m, y_m, options.appearance.blur_cells)
    best = _best_numbering(seen, np.stack([column, row], -1), expected, options.appearance)
    if best is None:
        return None
    turn, shift = best
    # A cell's place is that of its first corner; both turn about the cell's middle.
    lines = np.rint((piece.places - low - 0.5) @ turn.T + shift + 0.5).astype(np.int64)
    on_board = ((lines >= 0) & (lines < (len(x_m), len(y_m)))).all(1)
    corners_m = np.stack([x_m[lines[on_board, 0]], y_m[lines[on_board, 1]]], -1)
    return KnownCorners(corners_m, piece.pixels[on_board], np.full(len(corners_m), options.saddles.sigma_px))


def _seen(
    search: np.ndarray, grid: Float[np.ndarray, "tall wide 2"], row: Int[np.ndarray, " k"], column: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k s s"]:
    """Grey levels inside each cell, [y, x], the photo taken as bilinear between its corners."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = np.meshgrid(share, share)
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    corners = np.stack([grid[row, column], grid[row, column + 1], grid[row + 1, column], grid[row + 1, column + 1]], 1)
    pixels = np.einsum("nqc,qyx->nyxc", corners, weights).astype(np.float32).reshape(len(row), -1, 2)
    grey = cv2.remap(search, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return grey.reshape(-1, SAMPLES, SAMPLES).astype(np.float64)


def _expected(
    board: Pattern, x_m: Float[np.ndarray, " nx"], y_m: Float[np.ndarray, " ny"], blur_cells: float
) -> Float[np.ndarray, "rows columns s s"]:
    """Reflectance inside each cell of the board, [y, x]."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = (lines[:-1, None] + np.diff(lines)[:, None] * share for lines in (x_m, y_m))
    points = np.stack(np.broadcast_arrays(x[None, :, None, :], y[:, None, :, None]), -1)
    return board.reflectance(points, np.full(points.shape, blur_cells * float(np.diff(x_m).max())))


def _best_numbering(
    seen: Float[np.ndarray, "k s s"],
    places: Int[np.ndarray, "k 2"],
    expected: Float[np.ndarray, "rows columns s s"],
    options: AppearanceOptions,
) -> tuple[Int[np.ndarray, "2 2"], Int[np.ndarray, "2"]] | None:
    """Turn and shift that take columns and rows of seen cells to those of the board, where they stand out."""
    ny, nx = expected.shape[:2]
    scores: list[float] = []
    ways: list[tuple[np.ndarray, np.ndarray]] = []
    level = seen.ravel() - seen.mean()
    level = level / max(float(np.linalg.norm(level)), 1e-9)
    for quarter in range(4):
        turn = quarter_turn(quarter)
        turned = places @ turn.T
        turned = turned - turned.min(0)
        room = np.array([nx, ny]) - turned.max(0)
        if (room <= 0).any():
            continue
        # What a turned cell shows, in the order of the samples of the seen one.
        of_board = np.rot90(expected, quarter, axes=(2, 3))
        shifts = np.stack(np.meshgrid(np.arange(room[0]), np.arange(room[1])), -1).reshape(-1, 2)
        at = turned + shifts[:, None]
        print_ = of_board[at[..., 1], at[..., 0]].reshape(len(shifts), -1)
        print_ = print_ - print_.mean(1, keepdims=True)
        scores += list(print_ @ level / np.maximum(np.linalg.norm(print_, axis=1), 1e-9))
        ways += [(turn, shift - (places @ turn.T).min(0)) for shift in shifts]
    if not scores:
        return None
    order = np.argsort(scores)[::-1]
    best = scores[order[0]]
    next_best = scores[order[1]] if len(order) > 1 else 0.0
    # Logarithm of the ratio of likelihoods; what neither explains is no white noise, so it counts for an eighth of the samples.
    lead = seen.size / 16 * np.log((1.0 - next_best**2) / max(1.0 - best**2, 1e-9))
    if best < options.min_correlation or lead < options.clear_lead + options.clear_lead_per_cell * len(seen):
        return None
    return ways[order[0]]
