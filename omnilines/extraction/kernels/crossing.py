"""Which arcs cross the profiles of others, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from omnilines.extraction.compiled import REORDERED
from omnilines.extraction.kernels.step_algebra import MOST_STEPS
from omnilines.extraction.kernels.tables import Crossed


@njit(cache=True, nogil=True, **REORDERED)
@no_type_check
def crossings(
    profiles: Crossed, others: Crossed, size: tuple[int, int], closed: bool, reach_px: float, min_cosine: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where m profiles are crossed: places (m, s), the first 0 for the arc of the profile itself, then its nearest neighbours
    among points a pixel apart on all arcs; and the number of places. `size` is the width and height of the image."""
    own, pixel, across = profiles
    other, other_pixel, other_across = others
    width, height = size
    cell, half = 8, 4.5
    rows, columns = height // cell + 2, width // cell + 2
    head = np.full((rows, columns), -1, dtype=np.int32)
    following = np.full(len(other), -1, dtype=np.int32)
    for n in range(len(other)):
        i, j = int(other_pixel[n, 1]) // cell, int(other_pixel[n, 0]) // cell
        if 0 <= i < rows and 0 <= j < columns:
            following[n] = head[i, j]
            head[i, j] = n
    place, count = np.zeros((len(pixel), MOST_STEPS)), np.ones(len(pixel), dtype=np.int64)
    arcs, along_of, offset_of = np.empty(64, dtype=np.int64), np.empty(64), np.empty(64)
    last, slanted = width // cell, math.sqrt(max(1.0 / max(min_cosine, 1e-6) ** 2 - 1.0, 0.0))
    for n in range(len(pixel)):
        u, v, x, y = pixel[n, 0], pixel[n, 1], across[n, 0], across[n, 1]
        found, wide = 0, half * (abs(x) + abs(y))
        row, column = int(v) // cell, int(u) // cell
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for shifted in range(column - 2, column + 3):
                j = shifted
                if closed:
                    j = shifted % (last + 1)
                elif shifted < column - 1 or shifted > column + 1 or shifted < 0 or shifted >= columns:
                    continue
                # A cell that the profile does not pass: none of its points is near enough.
                du, dv = cell * j + 0.5 * cell - u, cell * i + 0.5 * cell - v
                if closed:
                    du -= width * round(du / width)
                if abs(x * dv - y * du) > 1.0 + wide or abs(x * du + y * dv) > reach_px + slanted + wide:
                    continue
                k = head[i, j]
                while k >= 0:
                    du, dv = other_pixel[k, 0] - u, other_pixel[k, 1] - v
                    if closed:
                        du -= width * round(du / width)
                    along, offset = -y * du + x * dv, x * du + y * dv
                    cosine = x * other_across[k, 0] + y * other_across[k, 1]
                    if other[k] != own[n] and abs(along) <= 1.0 and abs(cosine) >= min_cosine:
                        # Along the neighbour to where it meets the profile.
                        sine = -y * other_across[k, 0] + x * other_across[k, 1]
                        offset += along * sine / cosine
                        if abs(offset) <= reach_px:
                            index = 0
                            while index < found and arcs[index] != other[k]:
                                index += 1
                            if index == found and found < 64:
                                arcs[index], along_of[index] = other[k], np.inf
                                found += 1
                            if index < found and abs(along) < along_of[index]:
                                along_of[index], offset_of[index] = abs(along), offset
                    k = following[k]
        while count[n] < MOST_STEPS and found > 0:
            best = 0
            for index in range(1, found):
                if abs(offset_of[index]) < abs(offset_of[best]):
                    best = index
            place[n, count[n]] = offset_of[best]
            count[n] += 1
            found -= 1
            arcs[best], offset_of[best] = arcs[found], offset_of[found]
    return place, count
