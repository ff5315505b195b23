"""The contract of every calibration target.

Board frame: the first corner at the origin or near it, x to the right and y down as printed, z = 0 on the printed surface;
by the right-hand rule z points into the board, away from who looks at its front.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns.options import DetectionOptions, FitOptions
from camera_models.errors import InputError

if TYPE_CHECKING:
    from calib_patterns.corner_kind import CornerKind

METRES_PER_UNIT = {"mm": -3, "cm": -2, "m": 0}
"""Decimal exponent of each unit of length that a specification may use."""


@dataclass(frozen=True)
class Detection:
    """Corners of one target found in one photo; empty when there are none."""

    ids: Int[np.ndarray, " n"]
    """Rows of `Pattern.points_m`, ascending."""
    pixels: Float[np.ndarray, "n 2"]
    """(u, v), the centre of the first pixel at (0, 0)."""
    sigma_px: Float[np.ndarray, " n"]
    """Standard deviation of each coordinate, root mean square of both axes."""
    blur_px: Float[np.ndarray, "n 2"] | None = None
    """Standard deviation of the profile across both edges that cross in the corner: across the edge along the board's x, then
    across that along its y. Photo noise aside, its square is the sum of those of lens, pixel, defocus and the motion across
    the edge. None where the detector does not know it."""

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def empty() -> "Detection":
        """No corner."""
        return Detection(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))


Project = Callable[[Float[np.ndarray, "n k 3"]], tuple[Float[np.ndarray, "n k 2"], Bool[np.ndarray, "n k"]]]
"""Where a camera has points of the board (metres) in its photo, and which of them it sees."""


@dataclass(frozen=True)
class PlainGrid:
    """Corners without marks, counted along the columns first: id = row * columns + column."""

    columns: int
    rows: int
    pitch_m: float


class Pattern(ABC):
    """A flat calibration target whose corners have names (row indices) and known positions."""

    NAME: ClassVar[str]

    @classmethod
    @abstractmethod
    def _from_arguments(cls, arguments: str) -> "Pattern":
        """The pattern of what follows `name:` in a specification; raises InputError with one sentence when malformed."""

    @classmethod
    @abstractmethod
    def examples(cls) -> "Sequence[Pattern]":
        """Realistic instances, looped over by the law suite."""

    @property
    @abstractmethod
    def specification(self) -> str:
        """The text that `calib_patterns.pattern` reads back to an equal pattern."""

    @property
    @abstractmethod
    def points_m(self) -> Float[np.ndarray, "n 3"]:
        """Corner positions in the board frame, metres, z = 0; the row index is the corner's id."""

    @property
    @abstractmethod
    def size_m(self) -> tuple[float, float]:
        """Printed extent along x and y including its white margin."""

    @property
    @abstractmethod
    def top_left_m(self) -> tuple[float, float]:
        """Where the printed extent begins in the board frame: its smallest x and y."""

    @abstractmethod
    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """Mean reflectance in [0, 1] over boxes of widths `footprint_m` along x and y centred at `points_m` on the board plane.

        Exact for boxes of any size, zero included. Defined inside the printed extent; outside it continues the margin's white.
        """

    @property
    @abstractmethod
    def black_rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        """What is printed black, as disjoint rectangles (x0, y0, x1, y1) on the board, x0 < x1 and y0 < y1, metres."""

    @abstractmethod
    def corner_kind(self, options: FitOptions) -> "CornerKind":
        """What the print looks like around the corners, rows by id."""

    @abstractmethod
    def detect(
        self, image: np.ndarray, *, mirrored: bool = False, options: DetectionOptions = DetectionOptions()
    ) -> tuple[Detection, str | None]:
        """The corners seen in a photo, and otherwise one sentence saying why there are none.

        `image`: (h, w) grey or (h, w, 3) BGR, uint8 or uint16; InputError for anything else. `mirrored` states that the photo
        was taken through an odd number of mirrors, so that the target's handedness is reversed in it.
        """

    @property
    def plain_grid(self) -> PlainGrid | None:
        """The grid of a target whose corners carry no names: the ids of a part of it are right up to a shift, and it may begin
        with either colour. None where marks name every corner."""
        return None

    def resized(self, columns: int, rows: int) -> "Pattern":
        """The same print with another number of corners, of targets with a `plain_grid`."""
        raise NotImplementedError(f"{self.specification} has no plain grid")

    @property
    def looks_same_turned(self) -> bool:
        """Whether the print looks the same after half a turn."""
        return False

    def may_be_in(self, grey: np.ndarray, options: DetectionOptions) -> bool:
        """Whether `detect` is worth its time, which is longest where there is no target; a quick look."""
        return True

    def marks_agree(self, grey: np.ndarray, project: Project, options: DetectionOptions) -> bool:
        """Whether a photo shows the marks of the target where a camera has them; also where it has none to show."""
        return True

    def ids_are_known(self, ids: Int[np.ndarray, " n"]) -> bool:
        """Whether every id names a corner of this pattern."""
        return bool(np.all((ids >= 0) & (ids < len(self.points_m))))


def parse_length(text: str, specification: str) -> float:
    """Metres of a positive length such as `32.5mm`; raises InputError naming the whole specification."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", text)
    length = float(Decimal(match[1]).scaleb(METRES_PER_UNIT[match[2]])) if match else 0.0
    if not length > 0:
        raise InputError(
            f"Pattern '{specification}' needs a positive length in mm, cm or m, found '{text}'; write it like 32.5mm."
        )
    return length


def format_length_mm(length_m: float) -> str:
    """The shortest text in millimetres that `parse_length` reads back to the same number."""
    return f"{Decimal(repr(length_m)).scaleb(3).normalize():f}mm"


def format_start(first_tag: int) -> str:
    """The part of a specification that says which tag of its dictionary is the first of a board."""
    return f":start={first_tag}" if first_tag else ""


def check_image(image: np.ndarray) -> None:
    """Raise InputError unless the image is (h, w) or (h, w, 3) of uint8 or uint16."""
    shape_is_right = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not shape_is_right or image.dtype not in (np.uint8, np.uint16) or image.size == 0:
        raise InputError(
            f"Expected a photo as (height, width) or (height, width, 3) of 8 or 16 bit, found {image.dtype} of shape "
            f"{tuple(image.shape)}; read it with cv2.imread."
        )
