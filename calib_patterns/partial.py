"""The visible part of a plain checkerboard: pieces of it linked from saddle points, grown corner by corner, placed on the board.

The ids of a board that is seen in part are right up to a shift or a symmetry of the board, which the pose of a single camera
absorbs. The part is placed so that its squares have the colours of the board, as near to the first corner as that allows.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns._pattern import Detection
from calib_patterns.corner_growth import grow_corners
from calib_patterns.corner_kind import squares_kind
from calib_patterns.grid_checks import GOES_ON
from calib_patterns.local_map import KnownCorners
from calib_patterns.options import DetectionOptions, PieceOptions
from calib_patterns.saddle_points import Lattice, lattices, quarter_turn, saddle_points

BLOCK_CORNERS = 9
"""3 x 3 corners: fewer are not told from texture."""


@dataclass(frozen=True)
class _Numbering:
    """One way to count the corners of a piece: places on the board are turn * places + shift."""

    turn: Int[np.ndarray, "2 2"]
    shift: Int[np.ndarray, "2"]
    colours: bool
    """Whether its squares then have the colours of the board."""


def visible_part(
    grey: np.ndarray,
    search: np.ndarray,
    factors: Float[np.ndarray, "2"],
    nx: int,
    ny: int,
    options: DetectionOptions,
    *,
    mirrored: bool,
) -> tuple[Detection | None, str | None]:
    """The corners that are seen of a board of nx x ny, at least 3 x 3 of them with their squares.

    `search` is the photo in 8 bits, reduced; `factors` (u, v) take its scale to that of `grey`. Where there is a piece of
    checkerboard that is no part of such a board, what keeps it from being one.
    """
    flaw = None
    points = saddle_points(search, options.saddles)
    for piece in lattices(points, BLOCK_CORNERS, options.pieces.max_pieces, options.saddles):
        kept = own(piece.places, nx, ny, options.pieces)
        piece = Lattice(piece.pixels[kept], piece.places[kept], piece.bright)
        if not _has_block(piece.places):
            continue
        if len(piece.places) > (nx + 2) * (ny + 2):
            flaw = flaw or GOES_ON
            continue
        found, places = grown(grey, piece, factors, nx, ny, options)
        kept = own(places, nx, ny, options.pieces)
        if not _has_block(places[kept]):
            continue
        if not _fits(places[kept], nx, ny):
            flaw = flaw or GOES_ON
            continue
        return _placed(_rows(found, kept), places[kept], piece.bright, nx, ny, mirrored), None
    return None, flaw


def _rows(found: Detection, kept: Bool[np.ndarray, " k"]) -> Detection:
    blur_px = None if found.blur_px is None else found.blur_px[kept]
    return Detection(found.ids[kept], found.pixels[kept], found.sigma_px[kept], blur_px)


def _extent(places: Int[np.ndarray, "m 2"]) -> Int[np.ndarray, "2"]:
    return np.asarray(np.ptp(places, axis=0) + 1)


def _fits(places: Int[np.ndarray, "m 2"], nx: int, ny: int) -> bool:
    """Whether a board of nx x ny has room for the places, in either orientation."""
    wide, tall = _extent(places)
    return bool((wide <= nx and tall <= ny) or (wide <= ny and tall <= nx))


def _has_block(places: Int[np.ndarray, "m 2"]) -> bool:
    """Whether there are 3 x 3 neighbouring corners."""
    if len(places) < BLOCK_CORNERS:
        return False
    low = places.min(0)
    grid = np.zeros(np.maximum(_extent(places), 3), dtype=bool)
    grid[tuple((places - low).T)] = True
    return bool(np.lib.stride_tricks.sliding_window_view(grid, (3, 3)).all((2, 3)).any())


def own(places: Int[np.ndarray, "m 2"], nx: int, ny: int, options: PieceOptions) -> Bool[np.ndarray, " m"]:
    """Which corners are left without sparse rows and columns at the border, taken off while they are too many for the board."""
    kept = np.ones(len(places), dtype=bool)
    while kept.any() and not _fits(places[kept], nx, ny):
        before = int(kept.sum())
        for axis in (0, 1):
            along = places[:, axis]
            low = int(along[kept].min())
            counts = np.bincount(along[kept] - low)
            for end, count in ((low, counts[0]), (low + len(counts) - 1, counts[-1])):
                if count < options.sparse_share * counts.max():
                    kept &= along != end
        if int(kept.sum()) == before:
            break
    return kept


def grown(
    grey: np.ndarray,
    piece: Lattice,
    factors: Float[np.ndarray, "2"],
    nx: int,
    ny: int,
    options: DetectionOptions,
    *,
    margin: float = math.inf,
    strict: bool = True,
) -> tuple[Detection, Int[np.ndarray, "k 2"]]:
    """The corners of a piece, of what a board of nx x ny can have around it and of one row and column more, fitted, with their
    places: a board that goes on shows it there.

    `factors` as in `visible_part`; `margin`: how far tags are from the sides of white squares, in squares;
    `strict` as in `grow_corners`.
    """
    extent, low = _extent(piece.places), piece.places.min(0)
    ways = np.array([way for way in ((nx, ny), (ny, nx)) if (extent <= way).all()] or [(0, 0)])
    around = np.maximum((ways - extent).max(0), 0) + 1
    columns, rows = (np.arange(low[k] - around[k], low[k] + extent[k] + around[k]) for k in (0, 1))
    places = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    kind = squares_kind(places.astype(np.float64), _signs(places, piece.bright), 1.0, margin, options.fit)
    pixels = (piece.pixels + 0.5) * factors - 0.5
    sigma_px = np.full(len(pixels), options.saddles.sigma_px * float(factors.max()))
    seeds = KnownCorners(piece.places.astype(np.float64), pixels, sigma_px)
    found = grow_corners(grey, kind, seeds, options, strict=strict)
    return found, places[found.ids]


def _signs(places: Int[np.ndarray, "m 2"], bright: bool) -> Float[np.ndarray, " m"]:
    """+1 where the square towards larger columns and rows is bright, -1 where it is dark."""
    return np.where(places.sum(-1) % 2 == 0, 1.0, -1.0) * (1.0 if bright else -1.0)


def _placed(found: Detection, places: Int[np.ndarray, "k 2"], bright: bool, nx: int, ny: int, mirrored: bool) -> Detection | None:
    """The corners with ids of the board, None where they do not fit on it.

    Of the numberings of the board's handedness those with its colours are preferred, and among them the one whose x axis points
    most to the right and, last, the one nearest to the first corner.
    """
    design = np.concatenate([places, np.ones((len(places), 1))], 1)
    steps = np.linalg.lstsq(design, found.pixels, rcond=None)[0][:2]

    def preference(way: _Numbering) -> tuple[bool, float, int]:
        x_axis = way.turn[0] @ steps
        return way.colours, round(float(x_axis[0] / np.linalg.norm(x_axis)), 9), -int(way.shift @ way.shift)

    ways = _numberings(places, bright, nx, ny, mirrored)
    if not ways:
        return None
    way = max(ways, key=preference)
    column, row = (places @ way.turn.T + way.shift).T
    ids = row * nx + column
    ascending = np.argsort(ids)
    blur = found.blur_px
    if blur is not None and way.turn[0, 0] == 0:
        # The piece's columns are the board's rows, and so are their edges.
        blur = blur[:, ::-1]
    return Detection(
        ids[ascending], found.pixels[ascending], found.sigma_px[ascending], None if blur is None else blur[ascending]
    )


def _numberings(places: Int[np.ndarray, "k 2"], bright: bool, nx: int, ny: int, mirrored: bool) -> list[_Numbering]:
    """Quarter turns, after a reflection in a mirror's photo, each as near to the first corner as possible or one column on."""
    ways = []
    sign = _signs(places, bright)
    for quarter in range(4):
        turn = quarter_turn(quarter) @ np.diag([-1 if mirrored else 1, 1])
        turned = places @ turn.T
        if (_extent(turned) > (nx, ny)).any():
            continue
        exchanged = -1.0 if mirrored != (quarter % 2 == 1) else 1.0
        for along in (0, 1):
            shift = np.array([along, 0]) - turned.min(0)
            on_board = turned + shift
            if on_board[:, 0].max() < nx:
                # The first square of a board is black, and so is the one beyond its first corner.
                same: Bool[np.ndarray, " k"] = _signs(on_board, False) == exchanged * sign
                ways.append(_Numbering(turn, shift, bool(same.all())))
    return ways
