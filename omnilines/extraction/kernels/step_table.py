"""One blurred step read from a table, for profiles that are looked at one after another; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED

_FARTHEST_PX, _WIDEST_PX = 12.0, 12.0
"""Places of steps and offsets that the table of a blurred step reaches."""
_FLAT = 9.0
"""Blurs from a step where it is flat to the last digit."""
_PARTS = 32
"""Rows of the table between two offsets."""


class Table(NamedTuple):
    """Blurred steps of 1 about 0 and their derivatives, at many distances."""

    half: Float[np.ndarray, " n"]
    bell: Float[np.ndarray, " n"]
    columns: int
    """Of each row; row after row."""
    blur: float


@njit(cache=True, nogil=True)
@no_type_check
def blurred_steps(blur: float, between: float) -> Table:
    """A blurred step of 1 about 0 and its derivative at the distances (j / _PARTS + i) between - _FARTHEST_PX - _WIDEST_PX, in
    row j and column i: a step at any place is read from the row next to it, at as many columns as there are offsets."""
    columns = int(2.0 * (_FARTHEST_PX + _WIDEST_PX) / between) + 2
    half, bell = np.empty((_PARTS + 1, columns)), np.empty((_PARTS + 1, columns))
    for j in range(_PARTS + 1):
        for i in range(columns):
            x = ((j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX) / blur
            if abs(x) > _FLAT:
                half[j, i], bell[j, i] = math.copysign(0.5, x), 0.0
                continue
            half[j, i] = 0.5 * math.erf(x * 0.7071067811865476)
            bell[j, i] = math.exp(-0.5 * x * x) / (blur * 2.5066282746310002)
    return Table(half.ravel(), bell.ravel(), columns, blur)


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def row_of(first_px: float, between: float, place: float, table: Table) -> tuple[int, float, float]:
    """Where a step at a place is read from the table at offsets from `first_px` on: the first value, how far from there it is
    wanted, and the distance from the step there; both in blurs."""
    # In this order a place that is no number has a row as well.
    x = (first_px - min(max(-_FARTHEST_PX, place), _FARTHEST_PX) + _FARTHEST_PX + _WIDEST_PX) / between
    i = int(x)
    y = (x - i) * _PARTS
    j = int(y + 0.5)
    over = 1.0 / table.blur
    there_px = (j / _PARTS + i) * between - _FARTHEST_PX - _WIDEST_PX
    return j * table.columns + i, (y - j) * between / _PARTS * over, there_px * over


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def step_at(table: Table, at: int, shift: float, there: float) -> tuple[float, float]:
    """A step of 1 about 0 and its derivative by the offset, `shift` blurs from a value of the table that lies `there` from the
    step: by Taylor's series, good to 1e-8 and 4e-6."""
    bell, curved = table.bell[at], shift * shift * (there * there - 1.0)
    turn = shift * there
    step = table.half[at] + shift * table.blur * bell * (1.0 - 0.5 * turn + curved / 6.0)
    return step, bell * (1.0 - turn + 0.5 * curved)
