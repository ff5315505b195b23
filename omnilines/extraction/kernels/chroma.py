"""What colour without brightness adds to the places of an edge, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import BORROWED, REORDERED
from omnilines.extraction.kernels.circle import LEFT, OFF, WEIGHT

LUMA = np.array([0.114, 0.587, 0.299], dtype=np.float32)
"""Of blue, green and red, as JPEG has it (ITU-R BT.601)."""


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def _luma_shift(grey: np.ndarray, row: np.ndarray) -> float:
    """Grey levels times px: what a filter's row (k) says of the luma of a profile (c, k)."""
    total = np.float32(0.0)
    for c in range(len(LUMA)):
        for k in range(len(row)):
            total += LUMA[c] * row[k] * grey[c, k]
    return total


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def chroma_noise(
    grey: np.ndarray, difference: np.ndarray, row: np.ndarray, room: np.ndarray, chosen: np.ndarray, places: int
) -> tuple[float, float, float, float]:
    """Of an arc, whose places are in the room of `circle.py` after the fit: the share of chroma in what tells them; the sum of
    what it adds to their residuals and the sum of the squares of that; and that of the squares of the residuals.

    A place is D'Gr / D'D of the profile G (c, k) with the difference D (c) between its sides and the filter's row r (k). In
    channels of luma l, G = 1 (l'G) + chroma: luma says (1'D) (l'Gr) / D'D of it, with a share of (1'D) (l'D) / D'D.
    `grey` (m, c, k) and `difference` (m, c) are of all samples. Grey photos have no chroma.
    """
    share, total, squares, every, kept = 0.0, 0.0, 0.0, 0.0, 0
    if grey.shape[1] != len(LUMA):
        return 0.0, 0.0, 0.0, 0.0
    for i in range(places):
        if room[WEIGHT, i] == 0.0:
            continue
        n, level, step, square = chosen[i], 0.0, 0.0, 1e-6
        for c in range(len(LUMA)):
            level += difference[n, c]
            step += LUMA[c] * difference[n, c]
            square += difference[n, c] * difference[n, c]
        own = 1.0 - level * step / square
        off, left = room[OFF, i], room[LEFT, i]
        # What chroma says, less its share of where the circle is.
        noise = off - level / square * _luma_shift(grey[n], row) - own * (off - left)
        share, total, squares, every, kept = share + own, total + noise, squares + noise * noise, every + left * left, kept + 1
    return share / max(kept, 1), total, squares, every
