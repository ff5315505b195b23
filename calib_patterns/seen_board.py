"""Which target a photo shows, whatever was asked for: for the answer to photos in which the target asked for is not found.

Quadrilaterals are read with every dictionary of OpenCV, as they are, as a negative and as a mirror image. Wrong dictionaries read
some of them by chance: the one whose tags chance explains least is taken, where it hardly explains them. The ids of the tags and
their places in the photo tell in how many columns they were printed. Without tags, it is the largest piece of checkerboard.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.stats import binom

from calib_patterns._pattern import check_image
from calib_patterns.aprilgrid import BORDER_BITS, FAMILIES
from calib_patterns.charuco import TAGS_OF_DICTIONARY
from calib_patterns.detection import grey_of, is_too_small, searched, stretched
from calib_patterns.options import DetectionOptions
from calib_patterns.partial import BLOCK_CORNERS, grown
from calib_patterns.saddle_points import lattices, saddle_points
from calib_patterns.tag_decoding import Codes, decode
from calib_patterns.tags import TagFamily, tag_candidates

CHANCE = 1e-6
"""Tags are those of a dictionary where chance would read as many less often than this."""
LARGEST = 30
"""Columns of a board that are tried."""
FULL_ROW_SHARE = 0.5
"""A border row of a checkerboard has so many of the corners of its fullest row."""
CLEAR_FACTOR = 0.5
"""The number of columns is known where any other leaves twice as much."""


@dataclass(frozen=True)
class SeenBoard:
    """A target as a photo shows it."""

    name: str
    """checkerboard, charuco or aprilgrid."""
    columns: int
    """Inner corners, squares or tags along x; 0 where they are not known. Of a checkerboard the larger number."""
    rows: int
    """That are seen."""
    tags: str = ""
    """Dictionary of a ChArUco board, family of an AprilGrid."""
    shown: str = ""
    """`negative` or `mirrored`, where the photo shows it so."""
    otherwise: bool = False
    """Whether tags of an AprilGrid are turned, or numbered in another order, than Kalibr prints them."""


def seen_board(image: np.ndarray, options: DetectionOptions = DetectionOptions()) -> SeenBoard | None:
    """The target that a photo shows, (h, w) grey or (h, w, 3) BGR of 8 or 16 bits; None where it shows none."""
    check_image(image)
    grey = grey_of(image)
    if is_too_small(grey, options.search):
        return None
    return _tagged(stretched(grey), options) or _checkerboard(grey, options)


def _checkerboard(grey: np.ndarray, options: DetectionOptions) -> SeenBoard | None:
    search, factors = searched(grey, options.search)
    for piece in lattices(saddle_points(search, options.saddles), BLOCK_CORNERS, 1, options.saddles):
        wide, tall = (int(extent) + 1 for extent in np.ptp(piece.places, axis=0))
        _, places = grown(grey, piece, factors, min(LARGEST, wide + 4), min(LARGEST, tall + 4), options)
        if len(places):
            rows, columns = sorted(_full_rows(places[:, axis]) for axis in (0, 1))
            return SeenBoard("checkerboard", columns, rows) if min(columns, rows) >= 3 else None
    return None


def _full_rows(along: Int[np.ndarray, " m"]) -> int:
    """How many rows there are from the first to the last that is about full."""
    counts = np.bincount(along - along.min())
    full = np.flatnonzero(counts >= FULL_ROW_SHARE * counts.max())
    return int(full[-1] - full[0]) + 1


@lru_cache(maxsize=len(TAGS_OF_DICTIONARY) + len(FAMILIES))
def _codes(family: TagFamily, count: int) -> Codes:
    return Codes(np.stack([family.bits(tag) for tag in range(count)]), family.border_bits, 0)


def _tagged(image: np.ndarray, options: DetectionOptions) -> SeenBoard | None:
    """The board of tags that chance explains least; `image` of 8 bits."""
    best, least = None, np.log(CHANCE)
    ways = {"": image, "negative": cv2.bitwise_not(image), "mirrored": np.ascontiguousarray(image[:, ::-1])}
    largest = [name for name in TAGS_OF_DICTIONARY if name[-4:] == "1000" or "X" not in name]
    for shown, turned in ways.items():
        for touching in (False, True):
            scaled, quads = tag_candidates(turned, touching, options)
            for dictionary in largest:
                april = dictionary.removeprefix("DICT_APRILTAG_")
                if touching and april not in FAMILIES:
                    continue
                family = TagFamily(dictionary.removeprefix("DICT_"), BORDER_BITS if touching else 1, touching)
                codes = _codes(family, TAGS_OF_DICTIONARY[dictionary])
                _, ids, pixels = decode(scaled, quads, codes, options.tags)
                for name, count in TAGS_OF_DICTIONARY.items():
                    if _same_codes(name, dictionary):
                        own, first = np.unique(ids[ids < count], return_index=True)
                        chance = 4.0 * count / 2.0 ** (codes.black.shape[1] - 2 * codes.border_bits) ** 2
                        by_chance = float(binom.logsf(len(own) - 1, max(len(quads), 1), min(chance, 1.0)))
                        if by_chance < least:
                            least = by_chance
                            corners = pixels[ids < count][first]
                            columns, rows = _layout(own, corners.mean(1), "aprilgrid" if touching else "charuco")
                            tags, otherwise = april if touching else name, touching and _otherwise(own, corners, columns)
                            best = SeenBoard("aprilgrid" if touching else "charuco", columns, rows, tags, shown, otherwise)
        if best is not None:
            return best
    return None


def _same_codes(name: str, dictionary: str) -> bool:
    """Whether a dictionary is another one or its first tags."""
    return name == dictionary or ("X" in name and name.rsplit("_", 1)[0] == dictionary.rsplit("_", 1)[0])


def _layout(ids: Int[np.ndarray, " k"], centres: Float[np.ndarray, "k 2"], name: str) -> tuple[int, int]:
    """Columns of tags or squares and how many rows reach to the largest id, (0, 0) where they are not known: the places that the
    ids have in the right number of columns lie in the photo as a smooth map has them."""
    left = []
    for columns in range(1 if name == "aprilgrid" else 3, LARGEST + 1):
        places = _places(ids, columns, name)
        x, y = (places - places.mean(0)).T
        design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
        if np.linalg.matrix_rank(design) == design.shape[1] < len(ids):
            residual = centres - design @ np.linalg.lstsq(design, centres, rcond=None)[0]
            left.append((float(np.median(np.hypot(*residual.T))), columns, int(places[:, 1].max()) + 1))
    left.sort()
    if not left or (len(left) > 1 and left[0][0] > CLEAR_FACTOR * left[1][0]):
        return 0, 0
    return left[0][1:]


def _otherwise(ids: Int[np.ndarray, " k"], corners: Float[np.ndarray, "k 4 2"], columns: int) -> bool:
    """Whether tags lie otherwise beside each other than in `AprilGrid.tag_corners_m`: there the top of each, from its own top
    left on, runs against the columns, and its left side with the rows."""
    if not columns:
        return False
    design = np.column_stack([np.ones(len(ids)), _places(ids, columns, "aprilgrid")])
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return False
    along = np.linalg.lstsq(design, corners.mean(1), rcond=None)[0][1:]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]], 1).mean(0)
    top, left = sides @ np.linalg.inv(along)
    return bool(top[0] > -abs(top[1]) or left[1] < abs(left[0]))


def _places(ids: Int[np.ndarray, " k"], columns: int, name: str) -> Float[np.ndarray, "k 2"]:
    """Column and row of tags with ids."""
    if name == "aprilgrid":
        return np.stack([ids % columns, ids // columns], -1).astype(np.float64)
    # The squares row by row, of which every second has a tag, the first of the first row none.
    row, column = np.divmod(np.arange(2 * (int(ids.max()) + 1) + columns + 1), columns)
    tagged = np.flatnonzero((row + column) % 2 == 1)[ids]
    return np.stack([column[tagged], row[tagged]], -1).astype(np.float64)
