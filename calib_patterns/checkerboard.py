"""A plain checkerboard, named by its inner corners: `checkerboard:8x6:32.5mm` has 8 along x, 6 along y, squares of 32.5 mm."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calib_patterns._pattern import Detection, Pattern, PlainGrid, check_image, format_length_mm, parse_length
from calib_patterns.corner_kind import CornerKind
from calib_patterns.detection import detect_checkerboard, stretched
from calib_patterns.inverted import Inverted
from calib_patterns.options import DetectionOptions, FitOptions
from calib_patterns.partial import BLOCK_CORNERS
from calib_patterns.saddle_points import lattices, saddle_points
from camera_models.errors import InputError


def _even_squares_integral(x: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Integral from 0 to x of the square wave that is +1 in [0, 1), -1 in [1, 2), and so on."""
    return 1.0 - np.abs(np.mod(x, 2.0) - 1.0)


def _mean_square_wave(centre: Float[np.ndarray, "*batch"], width: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Mean of that square wave over an interval; its value at the centre when the width is zero."""
    safe = np.maximum(width, 1e-9)
    mean = (_even_squares_integral(centre + 0.5 * safe) - _even_squares_integral(centre - 0.5 * safe)) / safe
    return np.where(width < 1e-9, 1.0 - 2.0 * np.mod(np.floor(centre), 2.0), mean)


@dataclass(frozen=True)
class Checkerboard(Pattern):
    """(nx + 1) x (ny + 1) alternating squares within a white margin of one square; the first square (top left) is black.

    Corner ids run along x first: id = iy nx + ix. The first inner corner is the origin.
    """

    NAME = "checkerboard"

    nx: int
    ny: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.nx, self.ny) < 3 or not self.square_m > 0:
            raise InputError(
                f"A checkerboard needs at least 3x3 inner corners and a positive square, found {self.nx}x{self.ny} of "
                f"{self.square_m} m; count the corners where four squares meet."
            )

    @classmethod
    def _from_arguments(cls, arguments: str) -> "Checkerboard":
        match = re.fullmatch(r"\s*(\d{1,4})\s*[xX]\s*(\d{1,4})\s*:([^:]*)", arguments)
        if not match:
            raise InputError(
                f"Expected checkerboard:NXxNY:SQUARE such as checkerboard:8x6:32.5mm (inner corners along x and y, square size), "
                f"found 'checkerboard:{arguments}'; write it in that form."
            )
        return cls(int(match[1]), int(match[2]), parse_length(match[3], f"checkerboard:{arguments}"))

    @classmethod
    def examples(cls) -> "Sequence[Pattern]":
        """Even, odd and mixed counts, a square grid, and white on black."""
        plain = (cls(8, 6, 0.0325), cls(11, 7, 0.03), cls(7, 6, 0.03), cls(5, 5, 0.1), cls(4, 9, 0.0123))
        return (*plain, Inverted(cls(7, 6, 0.03)))

    @property
    def specification(self) -> str:
        return f"{self.NAME}:{self.nx}x{self.ny}:{format_length_mm(self.square_m)}"

    @property
    def points_m(self) -> Float[np.ndarray, "n 3"]:
        x, y = np.meshgrid(np.arange(self.nx), np.arange(self.ny))
        return self.square_m * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float64)

    @property
    def size_m(self) -> tuple[float, float]:
        return (self.nx + 3) * self.square_m, (self.ny + 3) * self.square_m

    @property
    def top_left_m(self) -> tuple[float, float]:
        return -2 * self.square_m, -2 * self.square_m

    @property
    def black_rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        row, column = np.mgrid[: self.ny + 1, : self.nx + 1]
        black = (row + column) % 2 == 0
        low = np.stack([column[black], row[black]], -1) - 1.0
        return self.square_m * np.concatenate([low, low + 1.0], 1)

    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """0 on black, 1 on white. The board is a product of two square waves, and so is its mean over a box."""
        centre, width = points_m / self.square_m, footprint_m / self.square_m
        low, high = centre - 0.5 * width, centre + 0.5 * width
        # The part of the box that lies on the squares; the rest is white margin.
        inner_low, inner_high = np.maximum(low, -1.0), np.minimum(high, np.array([self.nx, self.ny], dtype=np.float64))
        inner = np.maximum(inner_high - inner_low, 0.0)
        share = np.where(width < 1e-9, (inner_high >= inner_low), inner / np.maximum(width, 1e-9))
        waves = _mean_square_wave(0.5 * (inner_low + inner_high), inner)
        return 1.0 - share.prod(-1) * 0.5 * (1.0 + waves.prod(-1))

    @property
    def plain_grid(self) -> PlainGrid:
        return PlainGrid(self.nx, self.ny, self.square_m)

    def resized(self, columns: int, rows: int) -> "Checkerboard":
        return replace(self, nx=columns, ny=rows)

    @property
    def looks_same_turned(self) -> bool:
        return (self.nx + self.ny) % 2 == 0

    def corner_kind(self, options: FitOptions) -> CornerKind:
        corners = self.points_m[:, :2]
        row, column = np.divmod(np.arange(len(corners)), self.nx)
        # The first square is black, and so is the one beyond its first corner.
        white = (row + column) % 2 == 1
        plain = np.full((len(corners), 2, 2), np.inf)
        return CornerKind(corners, np.where(white, 1.0, -1.0), plain, self.square_m, self.square_m)

    def may_be_in(self, grey: np.ndarray, options: DetectionOptions) -> bool:
        """A few squares are seen."""
        return bool(lattices(saddle_points(stretched(grey), options.saddles), BLOCK_CORNERS, 1, options.saddles))

    def detect(
        self, image: np.ndarray, *, mirrored: bool = False, options: DetectionOptions = DetectionOptions()
    ) -> tuple[Detection, str | None]:
        """The whole board or nothing, but for corners that are covered or washed out, which are left out.

        Numbering: as seen from the front, x to y turns like u to v (the other way when `mirrored`). Of the numberings this
        leaves, those with a black first square are preferred, and among them the one whose x axis points most to the right.
        For nx + ny odd this is unique; otherwise a plain board looks the same after half a turn, and either is right.
        """
        check_image(image)
        return detect_checkerboard(image, self.nx, self.ny, options, mirrored=mirrored)
