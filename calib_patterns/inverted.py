"""A target printed white on black: `charuco:4x5:54mm:40.5mm:DICT_4X4_1000:inverted` is the negative of the one without that.

Corners, ids and frame are those of the target. Its negative reaches to the end of its white margin; around that is the white of
the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from calib_patterns import INVERTED
from calib_patterns._cells import CellGrid
from calib_patterns._pattern import Detection, Pattern, PlainGrid, Project, check_image
from calib_patterns.corner_kind import CornerKind
from calib_patterns.detection import grey_of, photo_flaw
from calib_patterns.options import DetectionOptions, FitOptions

_PAPER = 0.05
"""Width of the white around the negative, as a share of the negative's larger side."""


def negative(image: np.ndarray) -> np.ndarray:
    """Black for white; of the image's own depth."""
    return np.asarray(np.iinfo(image.dtype).max - image)


@dataclass(frozen=True)
class Inverted(Pattern):
    """The negative of a target."""

    NAME = INVERTED

    printed: Pattern
    """What is black on white."""

    @classmethod
    def _from_arguments(cls, arguments: str) -> "Pattern":
        raise NotImplementedError("calib_patterns.pattern takes it as the last part of a specification")

    @classmethod
    def examples(cls) -> "Sequence[Pattern]":
        """Those of the targets."""
        raise NotImplementedError("the targets have inverted ones among their examples")

    @property
    def specification(self) -> str:
        return f"{self.printed.specification}:{INVERTED}"

    @property
    def points_m(self) -> Float[np.ndarray, "n 3"]:
        return self.printed.points_m

    @property
    def _paper_m(self) -> float:
        return _PAPER * max(self.printed.size_m)

    @property
    def size_m(self) -> tuple[float, float]:
        across, down = self.printed.size_m
        return across + 2 * self._paper_m, down + 2 * self._paper_m

    @property
    def top_left_m(self) -> tuple[float, float]:
        left, top = self.printed.top_left_m
        return left - self._paper_m, top - self._paper_m

    @cached_property
    def _cells(self) -> CellGrid:
        grid = CellGrid.of_rectangles(self.printed.black_rectangles_m)
        (left, top), (across, down) = self.printed.top_left_m, self.printed.size_m
        return CellGrid(
            np.concatenate([[left], grid.x_m, [left + across]]),
            np.concatenate([[top], grid.y_m, [top + down]]),
            ~np.pad(grid.black, 1),
        )

    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """0 on black, 1 on white, from a summed-area table."""
        return self._cells.reflectance(points_m, footprint_m)

    @property
    def black_rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        return self._cells.rectangles_m

    def corner_kind(self, options: FitOptions) -> CornerKind:
        kind = self.printed.corner_kind(options)
        return replace(kind, sign=-kind.sign)

    def detect(
        self, image: np.ndarray, *, mirrored: bool = False, options: DetectionOptions = DetectionOptions()
    ) -> tuple[Detection, str | None]:
        """The target in the negative of the photo."""
        check_image(image)
        found, reason = self.printed.detect(negative(image), mirrored=mirrored, options=options)
        if reason is None:
            return found, None
        return found, photo_flaw(grey_of(image), f"{self.printed.NAME} printed white on black", options.search) or reason

    @property
    def plain_grid(self) -> PlainGrid | None:
        return self.printed.plain_grid

    def resized(self, columns: int, rows: int) -> "Inverted":
        return Inverted(self.printed.resized(columns, rows))

    @property
    def looks_same_turned(self) -> bool:
        return self.printed.looks_same_turned

    def may_be_in(self, grey: np.ndarray, options: DetectionOptions) -> bool:
        return self.printed.may_be_in(negative(grey), options)

    def marks_agree(self, grey: np.ndarray, project: Project, options: DetectionOptions) -> bool:
        return self.printed.marks_agree(negative(grey), project, options)
