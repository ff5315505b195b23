"""ChArUco: a checkerboard with a tag in every white square, `charuco:9x7:30mm:22mm:DICT_5X5_100` has 9 x 7 squares of 30 mm,
tags of 22 mm.

Geometry, ids and frame are those of OpenCV's CharucoBoard: the origin is the top left corner of the top left square, which is
black; the inner corners are numbered along x first; the white squares hold tags 0, 1, 2, ... row by row. With `:legacy` they are
those of OpenCV before 4.6 (`setLegacyPattern`): with an even number of rows the top left square is white. With `:start=N` the
first tag is N of the dictionary.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from calib_patterns._cells import CellGrid, bit_rectangles
from calib_patterns._pattern import Pattern, format_length_mm, format_start, parse_length
from calib_patterns.corner_kind import CornerKind, squares_kind
from calib_patterns.inverted import Inverted
from calib_patterns.options import DetectionOptions, FitOptions
from calib_patterns.partial import grown, own
from calib_patterns.saddle_points import Lattice
from calib_patterns.tag_board import TagBoard, require_tags
from calib_patterns.tags import TagFamily
from camera_models.errors import InputError

TAGS_OF_DICTIONARY = {
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
"""OpenCV's dictionaries and how many tags each has."""


@dataclass(frozen=True)
class ChArUco(TagBoard):
    """nx x ny squares within a white margin of half a square; (nx - 1) x (ny - 1) inner corners."""

    NAME = "charuco"

    nx: int
    ny: int
    square_m: float
    marker_m: float
    dictionary: str
    legacy: bool = False
    """Whether it has the layout of OpenCV before 4.6."""
    first_tag: int = 0

    def __post_init__(self) -> None:
        if min(self.nx, self.ny) < 3 or not 0.3 * self.square_m <= self.marker_m <= 0.95 * self.square_m:
            raise InputError(
                f"A ChArUco board needs at least 3x3 squares and tags of 0.3 to 0.95 of a square, found {self.nx}x{self.ny}, "
                f"squares of {self.square_m} m and tags of {self.marker_m} m; measure both on the print."
            )
        tags = self.first_tag + len(self._squares(white=True))
        require_tags("dictionary of OpenCV", self.dictionary, TAGS_OF_DICTIONARY, tags)

    @classmethod
    def _from_arguments(cls, arguments: str) -> "ChArUco":
        match = re.fullmatch(
            r"\s*(\d{1,3})\s*[xX]\s*(\d{1,3})\s*:([^:]*):([^:]*):\s*(\w+)\s*(:\s*legacy\s*)?(?::\s*start=(\d{1,4})\s*)?",
            arguments,
        )
        if not match:
            raise InputError(
                f"Expected charuco:NXxNY:SQUARE:TAG:DICTIONARY such as charuco:9x7:30mm:22mm:DICT_5X5_100 (squares along x and "
                f"y, sizes of squares and tags; after it :legacy, :start=N or :inverted where the board is so), found "
                f"'charuco:{arguments}'; write it in that form."
            )
        nx, ny, square, tag, dictionary, legacy, first_tag = match.groups()
        square_m, tag_m = (parse_length(text, f"charuco:{arguments}") for text in (square, tag))
        return cls(int(nx), int(ny), square_m, tag_m, dictionary, legacy is not None, int(first_tag or 0))

    @classmethod
    def examples(cls) -> "Sequence[Pattern]":
        """Odd and even counts, large and small tags, the old layout, white on black, other tags."""
        return (
            cls(9, 7, 0.03, 0.022, "DICT_5X5_100"),
            cls(8, 6, 0.04, 0.03, "DICT_4X4_50"),
            cls(5, 8, 0.035, 0.021, "DICT_APRILTAG_36h11"),
            cls(8, 6, 0.04, 0.03, "DICT_4X4_50", legacy=True),
            Inverted(cls(4, 5, 0.054, 0.0405, "DICT_4X4_1000", first_tag=20)),
        )

    @property
    def specification(self) -> str:
        lengths = f"{format_length_mm(self.square_m)}:{format_length_mm(self.marker_m)}"
        layout = ":legacy" if self.legacy else ""
        return f"{self.NAME}:{self.nx}x{self.ny}:{lengths}:{self.dictionary}{layout}{format_start(self.first_tag)}"

    @property
    def points_m(self) -> Float[np.ndarray, "n 3"]:
        x, y = np.meshgrid(np.arange(1, self.nx), np.arange(1, self.ny))
        return self.square_m * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float64)

    @property
    def size_m(self) -> tuple[float, float]:
        return (self.nx + 1) * self.square_m, (self.ny + 1) * self.square_m

    @property
    def top_left_m(self) -> tuple[float, float]:
        return -0.5 * self.square_m, -0.5 * self.square_m

    @property
    def family(self) -> TagFamily:
        return TagFamily(self.dictionary.removeprefix("DICT_"), 1, touching=False, first=self.first_tag)

    @property
    def layouts(self) -> "tuple[ChArUco, ...]":
        # With an odd number of rows both are the same.
        return (self,) if self.ny % 2 else (self, replace(self, legacy=not self.legacy))

    def with_first_tag(self, tag: int) -> "ChArUco":
        return replace(self, first_tag=tag)

    @property
    def _first_white(self) -> int:
        """The column, 0 or 1, of the first white square of the first row."""
        return 0 if self.legacy and self.ny % 2 == 0 else 1

    def _squares(self, white: bool) -> Float[np.ndarray, "n 2"]:
        """Column and row of the white or black squares, row by row."""
        row, column = np.mgrid[: self.ny, : self.nx]
        chosen = ((row + column) % 2 == self._first_white) == white
        return np.stack([column[chosen], row[chosen]], -1).astype(np.float64)

    @property
    def tag_corners_m(self) -> Float[np.ndarray, "tags 4 2"]:
        low = self.square_m * self._squares(white=True) + 0.5 * (self.square_m - self.marker_m)
        return low[:, None] + self.marker_m * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    @property
    def lines_m(self) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
        return self.square_m * np.arange(self.nx + 1.0), self.square_m * np.arange(self.ny + 1.0)

    @cached_property
    def cells(self) -> CellGrid:
        squares = self._squares(white=False)
        black = [self.square_m * np.concatenate([squares, squares + 1], 1)]
        for tag, (left, top) in enumerate(self.tag_corners_m[:, 0]):
            black.append(bit_rectangles(self.family.bits(tag), float(left), float(top), self.marker_m))
        return CellGrid.of_rectangles(np.concatenate(black))

    @property
    def _margin(self) -> float:
        """How far tags are from the sides of their white squares, in squares."""
        return 0.5 * (1.0 - self.marker_m / self.square_m)

    def corner_kind(self, options: FitOptions) -> CornerKind:
        corners = self.points_m[:, :2]
        column, row = np.rint(corners / self.square_m).astype(np.int64).T
        return squares_kind(
            corners, np.where((column + row) % 2 == self._first_white, 1.0, -1.0), self.square_m, self._margin, options
        )

    def _with_more_corners(
        self, grey: np.ndarray, piece: Lattice, factors: Float[np.ndarray, "2"], options: DetectionOptions
    ) -> Lattice:
        if len(piece.places) > self.nx * self.ny:
            return piece
        # The corners of all squares are alike: no id is needed to find those around a piece. What is invented at the end of the
        # board does not matter, since they are found once more with their ids.
        found, places = grown(grey, piece, factors, self.nx - 1, self.ny - 1, options, margin=self._margin, strict=False)
        kept = own(places, self.nx - 1, self.ny - 1, options.pieces)
        return Lattice((found.pixels[kept] + 0.5) / factors - 0.5, places[kept], piece.bright)
