"""What colour without brightness says of the place of an edge, compiled.

JPEG, HEIC and videos keep brightness (luma) at every pixel, and what is left of the colours (chroma) mostly at a quarter of them,
smoothed and quantised in larger blocks. The place of an edge, a sum over the channels, is a part from luma plus a part from
chroma; the noise of the latter is alike over many pixels.

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
def luma_shift(grey: np.ndarray, row: np.ndarray) -> float:
    """Luma times shift (px) of a profile (c, k), by a filter's row (k)."""
    total = np.float32(0.0)
    for c in range(len(LUMA)):
        for k in range(len(row)):
            total += LUMA[c] * row[k] * grey[c, k]
    return total


@njit(cache=True, nogil=True, **REORDERED, **BORROWED)
@no_type_check
def chroma_noise(
    grey: np.ndarray, difference: np.ndarray, strength: np.ndarray, row: np.ndarray, room: np.ndarray, chosen: np.ndarray, places: int
) -> tuple[float, float, float, float]:
    """Of the places of an arc in the room of `circle.py`, after the fit: the share of chroma in what tells the place; the sum of
    what noise of chroma adds to the residuals, the sum of its squares, and that of the squares of the residuals (px).

    Profiles (m, c, k), differences (m, c) between their sides and the squares of these (m); `row` (k) turned profiles into shifts.
    """
    share, total, squares, every, kept = 0.0, 0.0, 0.0, 0.0, 0
    if grey.shape[1] != len(LUMA):
        return 0.0, 0.0, 0.0, 1.0
    for i in range(places):
        if room[WEIGHT, i] == 0.0:
            continue
        n, level, step = chosen[i], 0.0, 0.0
        for c in range(len(LUMA)):
            level += difference[n, c]
            step += LUMA[c] * difference[n, c]
        own = 1.0 - level * step / strength[n]
        off, left = room[OFF, i], room[LEFT, i]
        # The part of chroma in the place, less its part of where the circle is.
        noise = off - level / strength[n] * luma_shift(grey[n], row) - own * (off - left)
        share, total, squares, every, kept = share + own, total + noise, squares + noise * noise, every + left * left, kept + 1
    return share / max(kept, 1), total, squares, every
