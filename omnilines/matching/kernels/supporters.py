"""Arcs that support the lines of others, counted and thinned out, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def supporting_photos(rows: np.ndarray, support: np.ndarray, track: np.ndarray, image: np.ndarray, images: int) -> np.ndarray:
    """Of each arc of `rows` how many photos have a supporter of it, of its own track."""
    count = np.zeros(len(rows), dtype=np.int64)
    seen = np.full(images, -1, dtype=np.int64)
    for k in range(len(rows)):
        for j in support[rows[k]]:
            if j < 0:
                break
            if track[j] == track[rows[k]] and seen[image[j]] != k:
                seen[image[j]] = k
                count[k] += 1
    return count


@njit(cache=True, nogil=True)
@no_type_check
def free_supporters(support: np.ndarray, track: np.ndarray) -> np.ndarray:
    """The supporters of every arc that have no track, -1 after the last, in their order."""
    free = np.full_like(support, -1)
    for k in range(len(support)):
        at = 0
        for j in support[k]:
            if j < 0:
                break
            if track[j] < 0:
                free[k, at] = j
                at += 1
    return free


@njit(cache=True, nogil=True)
@no_type_check
def photos_of_tracks(track: np.ndarray, image: np.ndarray, count: int) -> np.ndarray:
    """How many photos see each of `count` tracks; arcs are sorted by photo."""
    views = np.zeros(count, dtype=np.int64)
    last = np.full(count, -1, dtype=np.int64)
    for k in range(len(track)):
        if track[k] >= 0 and last[track[k]] != image[k]:
            last[track[k]] = image[k]
            views[track[k]] += 1
    return views
