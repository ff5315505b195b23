"""Black and white prints made of axis-aligned cells: their exact mean over boxes, and their rectangles for printing.

The print is constant on the cells of a grid with unequal spacing, so that the integral of black from its top left corner to
(x, y) is bilinear inside every cell. The mean over a box is a difference of four such integrals (Crow, Summed-area tables for
texture mapping, SIGGRAPH 1984).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

MIN_WIDTH_M = 1e-7
"""Narrower boxes are points: far below ink and paper."""


@dataclass(frozen=True)
class CellGrid:
    """Cells between `x_m` and `y_m` (ascending, metres); white everywhere outside."""

    x_m: Float[np.ndarray, " nx_plus_1"]
    y_m: Float[np.ndarray, " ny_plus_1"]
    black: Bool[np.ndarray, "ny nx"]

    @staticmethod
    def of_rectangles(rectangles_m: Float[np.ndarray, "n 4"]) -> "CellGrid":
        """Black rectangles (x0, y0, x1, y1); edges within a nanometre of each other are one."""
        x, y = (_distinct(rectangles_m[:, [k, k + 2]]) for k in (0, 1))
        black = np.zeros((len(y) - 1, len(x) - 1), dtype=bool)
        columns, rows = (
            np.searchsorted(edges - 1e-9, rectangles_m[:, [k, k + 2]], "right") - 1 for k, edges in enumerate((x, y))
        )
        for (left, right), (top, bottom) in zip(columns, rows, strict=True):
            black[top:bottom, left:right] = True
        return CellGrid(x, y, black)

    @cached_property
    def _integral(self) -> Float[np.ndarray, "ny_plus_1 nx_plus_1"]:
        """Area of black above and left of every node, m^2."""
        area = self.black * np.diff(self.y_m)[:, None] * np.diff(self.x_m)
        return np.pad(area.cumsum(0).cumsum(1), ((1, 0), (1, 0)))

    def _cell(self, x: np.ndarray, edges: Float[np.ndarray, " k"]) -> tuple[Int[np.ndarray, "..."], np.ndarray]:
        """Cell and share of the way through it, clipped to the grid."""
        index = np.clip(np.searchsorted(edges, x, "right") - 1, 0, len(edges) - 2)
        return index, np.clip((x - edges[index]) / (edges[index + 1] - edges[index]), 0.0, 1.0)

    def _black_before(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Area of black left of x and above y, m^2."""
        (column, s), (row, t) = self._cell(x, self.x_m), self._cell(y, self.y_m)
        table = self._integral
        upper = table[row, column] * (1 - s) + table[row, column + 1] * s
        lower = table[row + 1, column] * (1 - s) + table[row + 1, column + 1] * s
        return upper * (1 - t) + lower * t

    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """Mean of 0 on black, 1 on white over boxes; the value at the centre of a box without extent."""
        width = np.maximum(footprint_m, MIN_WIDTH_M)
        (x0, y0), (x1, y1) = (np.moveaxis(points_m + sign * 0.5 * width, -1, 0) for sign in (-1, 1))
        corners = ((x1, y1, 1.0), (x0, y1, -1.0), (x1, y0, -1.0), (x0, y0, 1.0))
        black = sum(sign * self._black_before(x, y) for x, y, sign in corners) / width.prod(-1)
        (column, _), (row, _) = self._cell(points_m[..., 0], self.x_m), self._cell(points_m[..., 1], self.y_m)
        low, high = np.array([self.x_m[0], self.y_m[0]]), np.array([self.x_m[-1], self.y_m[-1]])
        at_centre = self.black[row, column] & ((points_m >= low) & (points_m < high)).all(-1)
        return 1.0 - np.where((footprint_m < MIN_WIDTH_M).all(-1), at_centre, np.clip(black, 0.0, 1.0))

    @property
    def rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        """The black as disjoint rectangles (x0, y0, x1, y1): one for each run of black cells of a row."""
        steps = np.diff(np.pad(self.black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        (row, first), (_, last) = np.nonzero(steps == 1), np.nonzero(steps == -1)
        return np.stack([self.x_m[first], self.y_m[row], self.x_m[last], self.y_m[row + 1]], -1)


def _distinct(values: np.ndarray) -> Float[np.ndarray, " k"]:
    """Ascending, without those that only rounding sets apart."""
    ordered = np.unique(values)
    return ordered[np.concatenate([[True], np.diff(ordered) > 1e-9])]


def bit_rectangles(bits: Bool[np.ndarray, "n n"], left_m: float, top_m: float, size_m: float) -> Float[np.ndarray, "m 4"]:
    """Rectangles of the true cells of a square tag whose top left corner is given."""
    row, column = np.nonzero(bits)
    cell = size_m / len(bits)
    low = np.stack([left_m + column * cell, top_m + row * cell], -1)
    return np.concatenate([low, low + cell], 1)
