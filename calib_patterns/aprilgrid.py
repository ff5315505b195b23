"""AprilGrid, Kalibr's target: `aprilgrid:6x6:35mm:0.3:36h11` has 6 x 6 tags of 35 mm with gaps of 0.3 of a tag.

As `kalibr_create_target_pdf` prints it: tag ids run from the bottom left along the rows upwards, borders are two bits wide, and
every corner of a tag touches a black square as wide as the gap, so that corners are saddles. Corner ids are Kalibr's: the rows of
tag corners from the bottom upwards, each from left to right. The origin is the bottom left corner of tag 0, as in Kalibr; y runs
down and z into the board, where Kalibr's run up and out of it: corners have y <= 0. With `:start=N` the first tag is N of the
family.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from calib_patterns._cells import CellGrid, bit_rectangles
from calib_patterns._pattern import Pattern, format_length_mm, format_start, parse_length
from calib_patterns.corner_kind import CornerKind
from calib_patterns.inverted import Inverted
from calib_patterns.options import FitOptions
from calib_patterns.tag_board import TagBoard, require_tags
from calib_patterns.tags import TagFamily
from camera_models.errors import InputError

BORDER_BITS = 2
FAMILIES = {"36h11": (6, 587), "36h10": (6, 2320), "25h9": (5, 35), "16h5": (4, 30)}
"""Bits along a side and number of tags of each family that OpenCV has."""


@dataclass(frozen=True)
class AprilGrid(TagBoard):
    """nx x ny tags with black squares between and around them, within a white margin as wide as the gap."""

    NAME = "aprilgrid"

    nx: int
    ny: int
    tag_m: float
    gap: float
    """Distance between tags over their size."""
    tag_family: str
    first_tag: int = 0

    def __post_init__(self) -> None:
        if min(self.nx, self.ny) < 1 or not self.tag_m > 0 or not 0.05 <= self.gap <= 1.0:
            raise InputError(
                f"An AprilGrid needs at least one tag of positive size and gaps of 0.05 to 1 of it, found "
                f"{self.nx}x{self.ny} tags of {self.tag_m} m with gaps of {self.gap}; measure both on the print."
            )
        counts = {name: count for name, (_, count) in FAMILIES.items()}
        require_tags("family", self.tag_family, counts, self.first_tag + self.nx * self.ny)

    @classmethod
    def _from_arguments(cls, arguments: str) -> "AprilGrid":
        match = re.fullmatch(
            r"\s*(\d{1,3})\s*[xX]\s*(\d{1,3})\s*:([^:]*):\s*(\d*\.?\d+)\s*:\s*(\w+)\s*(?::\s*start=(\d{1,4})\s*)?",
            arguments,
        )
        if not match:
            raise InputError(
                f"Expected aprilgrid:NXxNY:TAG:GAP:FAMILY such as aprilgrid:6x6:35mm:0.3:36h11 (tags along x and y, their size, "
                f"the gap as a share of it; after it :start=N or :inverted where the board is so), found "
                f"'aprilgrid:{arguments}'; write it in that form."
            )
        nx, ny, tag, gap, family, first_tag = match.groups()
        return cls(int(nx), int(ny), parse_length(tag, f"aprilgrid:{arguments}"), float(gap), family, int(first_tag or 0))

    @classmethod
    def examples(cls) -> "Sequence[Pattern]":
        """Kalibr's own, an oblong one, tags of few bits, other tags, and white on black."""
        return (
            cls(6, 6, 0.035, 0.3, "36h11"),
            cls(4, 3, 0.06, 0.25, "25h9"),
            cls(5, 4, 0.05, 0.3, "16h5"),
            cls(4, 4, 0.05, 0.3, "36h11", first_tag=36),
            Inverted(cls(4, 3, 0.06, 0.3, "36h11")),
        )

    @property
    def specification(self) -> str:
        tags = f"{self.tag_family}{format_start(self.first_tag)}"
        return f"{self.NAME}:{self.nx}x{self.ny}:{format_length_mm(self.tag_m)}:{self.gap!r}:{tags}"

    @property
    def _pitch_m(self) -> float:
        return (1.0 + self.gap) * self.tag_m

    @property
    def points_m(self) -> Float[np.ndarray, "n 3"]:
        x, up = (self._pitch_m * (np.arange(2 * n) // 2) + self.tag_m * (np.arange(2 * n) % 2) for n in (self.nx, self.ny))
        x, up = np.meshgrid(x, up)
        return np.stack([x, -up, np.zeros_like(x)], -1).reshape(-1, 3)

    @property
    def size_m(self) -> tuple[float, float]:
        # A black square and a margin on either side.
        across, down = (n * self._pitch_m + 3.0 * self.gap * self.tag_m for n in (self.nx, self.ny))
        return across, down

    @property
    def top_left_m(self) -> tuple[float, float]:
        edge = 2.0 * self.gap * self.tag_m
        return -edge, edge - self.size_m[1]

    @property
    def family(self) -> TagFamily:
        return TagFamily(f"APRILTAG_{self.tag_family}", BORDER_BITS, touching=True, first=self.first_tag)

    @property
    def layouts(self) -> "tuple[AprilGrid, ...]":
        return (self,)

    def with_first_tag(self, tag: int) -> "AprilGrid":
        return replace(self, first_tag=tag)

    @property
    def _tag_top_left_m(self) -> Float[np.ndarray, "tags 2"]:
        column, row = np.meshgrid(np.arange(self.nx), np.arange(self.ny))
        return np.stack([self._pitch_m * column, -self._pitch_m * row - self.tag_m], -1).reshape(-1, 2)

    @property
    def tag_corners_m(self) -> Float[np.ndarray, "tags 4 2"]:
        # Kalibr prints the tags half a turn from OpenCV's orientation: OpenCV's top left is the bottom right of the print.
        order = np.array([[1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 0.0]])
        return self._tag_top_left_m[:, None] + self.tag_m * order

    @property
    def lines_m(self) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
        # Both sides of each gap, also of those around the board.
        x, up = (
            np.sort(np.concatenate([places - self.gap * self.tag_m, places]))
            for places in (self._pitch_m * np.arange(n + 1) for n in (self.nx, self.ny))
        )
        return x, -up[::-1]

    @cached_property
    def cells(self) -> CellGrid:
        """The black cells of all tags, and the squares at the crossings of the gaps."""
        black = []
        for tag, (left, top) in enumerate(self._tag_top_left_m):
            bits = self.family.bits(tag)[::-1, ::-1]
            black.append(bit_rectangles(bits, float(left), float(top), self.tag_m))
        gap = self.gap * self.tag_m
        # A square at each crossing of gaps, also around the board.
        x, y = np.meshgrid(self._pitch_m * np.arange(self.nx + 1) - gap, -self._pitch_m * np.arange(self.ny + 1))
        low = np.stack([x, y], -1).reshape(-1, 2)
        black.append(np.concatenate([low, low + gap], 1))
        return CellGrid.of_rectangles(np.concatenate(black))

    def corner_kind(self, options: FitOptions) -> CornerKind:
        corners = self.points_m[:, :2]
        right, top = (np.mgrid[: 2 * self.ny, : 2 * self.nx].reshape(2, -1) % 2)[::-1]
        border = BORDER_BITS / (FAMILIES[self.tag_family][0] + 2 * BORDER_BITS)
        square = options.window_gap_share / options.window_squares * min(self.gap, border) * self.tag_m
        # Bottom left: the tag lies towards +x and -y, its square opposite, so the quadrant (+, +) is white.
        sign = np.where(right == top, 1.0, -1.0)
        return CornerKind(corners, sign, np.full((len(corners), 2, 2), np.inf), square, 0.5 * self._pitch_m)
