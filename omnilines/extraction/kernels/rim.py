"""The first light on rays from the border of a photo inwards, and how much of it lies outside a circle; compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

WINDOW, LEAST_LIGHT = 4, 3
"""Light begins where so many of so many pixels in a row are light."""


class Rays(NamedTuple):
    """Ray n goes from centre + border_px[n] way[n] to the centre (u, v) and stays there."""

    centre: Float[np.ndarray, "2"]
    way: Float[np.ndarray, "n 2"]
    border_px: Float[np.ndarray, " n"]


@njit(cache=True, nogil=True)
@no_type_check
def _light(image: np.ndarray, u: float, v: float, threshold: float) -> int:
    """1 where a channel of the nearest pixel is above the threshold, else 0."""
    i, j = round(v), round(u)
    for c in range(image.shape[2]):
        if image[i, j, c] > threshold:
            return 1
    return 0


@njit(cache=True, nogil=True)
@no_type_check
def first_light(image: np.ndarray, rays: Rays, depths: int, threshold: float) -> np.ndarray:
    """Pixels from the border inwards to the first light on each ray (n), `depths` where there is none."""
    centre, way, border = rays
    found = np.full(len(way), depths)
    for n in range(len(way)):
        # A bit for each of the last WINDOW pixels.
        seen = 0
        for k in range(-(WINDOW // 2), depths + WINDOW // 2 - 1):
            radius = max(border[n] - min(max(k, 0), depths - 1), 0.0)
            light = _light(image, centre[0] + radius * way[n, 0], centre[1] + radius * way[n, 1], threshold)
            seen, depth, total = (2 * seen + light) % 2**WINDOW, k - WINDOW // 2 + 1, 0
            for bit in range(WINDOW):
                total += (seen >> bit) & 1
            if depth >= 0 and total >= LEAST_LIGHT:
                found[n] = depth
                break
    return found


@njit(cache=True, nogil=True)
@no_type_check
def light_outside(image: np.ndarray, step: int, u: float, v: float, radius: float, threshold: float) -> tuple[int, int]:
    """Of every so many pixels down and across those farther than a radius from (u, v): how many there are, and are light."""
    outside, light = 0, 0
    for i in range(0, image.shape[0], step):
        for j in range(0, image.shape[1], step):
            if (j - u) ** 2 + (i - v) ** 2 > radius**2:
                outside += 1
                light += _light(image, j, i, threshold)
    return outside, light
