"""Arcs put together into tracks, and lines compared with the arcs of all photos, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def claim(order: np.ndarray, support: np.ndarray, image: np.ndarray, images: int, least_views: int) -> tuple[np.ndarray, int]:
    """The track of every arc (-1 for none) and how many there are: in this order, each free arc takes its free supporters."""
    track = np.full(len(image), -1, dtype=np.int64)
    seen = np.full(images, -1, dtype=np.int64)
    made = 0
    for turn in range(len(order)):
        i = order[turn]
        if track[i] >= 0:
            continue
        views = 1
        seen[image[i]] = turn
        for j in support[i]:
            if j < 0:
                break
            if track[j] < 0 and seen[image[j]] != turn:
                seen[image[j]] = turn
                views += 1
        if views < least_views:
            continue
        track[i] = made
        for j in support[i]:
            if j < 0:
                break
            if track[j] < 0:
                track[j] = made
        made += 1
    return track, made


@njit(cache=True, nogil=True)
@no_type_check
def near_lines(
    rows: np.ndarray, packed: np.ndarray, direction: np.ndarray, moment: np.ndarray, span: np.ndarray, gate_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of an arc, line): both ends within `gate_rad` of the line's great circle, and the line lies where the arc is.

    `span` holds the positions along each line between which it is known; an arc has to overlap that.
    """
    capacity = 1024
    arcs, lines = np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64)
    count = 0
    for k in range(len(rows)):
        p = packed[rows[k]]
        sine = np.sin(gate_rad[k])
        for line in range(len(direction)):
            dx, dy, dz = direction[line, 0], direction[line, 1], direction[line, 2]
            mx = moment[line, 0] - (p[10] * dz - p[11] * dy)
            my = moment[line, 1] - (p[11] * dx - p[9] * dz)
            mz = moment[line, 2] - (p[9] * dy - p[10] * dx)
            square = mx * mx + my * my + mz * mz
            limit = sine * sine * square
            h = p[0] * mx + p[1] * my + p[2] * mz
            if h * h > limit:
                continue
            h = p[3] * mx + p[4] * my + p[5] * mz
            if h * h > limit:
                continue
            # To the point of the line nearest to the centre: d x m.
            tx, ty, tz = dy * mz - dz * my, dz * mx - dx * mz, dx * my - dy * mx
            first, last = p[0] * tx + p[1] * ty + p[2] * tz, p[3] * tx + p[4] * ty + p[5] * tz
            if first <= 0.0 or last <= 0.0:
                continue
            base = p[9] * dx + p[10] * dy + p[11] * dz
            low = base + square * (p[0] * dx + p[1] * dy + p[2] * dz) / first
            high = base + square * (p[3] * dx + p[4] * dy + p[5] * dz) / last
            if high < low:
                low, high = high, low
            if min(high, span[line, 1]) <= max(low, span[line, 0]):
                continue
            if count == capacity:
                capacity *= 2
                arcs, lines = _grown(arcs, capacity), _grown(lines, capacity)
            arcs[count], lines[count] = rows[k], line
            count += 1
    return arcs[:count], lines[:count]


@njit(cache=True, nogil=True)
@no_type_check
def _grown(values: np.ndarray, capacity: int) -> np.ndarray:
    larger = np.empty(capacity, dtype=values.dtype)
    larger[: len(values)] = values
    return larger


@njit(cache=True, nogil=True)
@no_type_check
def united(order: np.ndarray, starts: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The track that every track becomes part of, its own number where of none: in this order, each that is still alone takes
    all of its others that are.

    The others of track t are others[starts[t] : starts[t + 1]]. Nothing is joined over a third: one wrong track that agrees
    with many would make one of them all.
    """
    root = np.full(len(order), -1, dtype=np.int64)
    for track in order:
        if root[track] >= 0:
            continue
        root[track] = track
        for other in others[starts[track] : starts[track + 1]]:
            if root[other] < 0:
                root[other] = track
    return root


@njit(cache=True, nogil=True)
@no_type_check
def needed(
    order: np.ndarray,
    starts: np.ndarray,
    member: np.ndarray,
    image: np.ndarray,
    images: int,
    line_starts: np.ndarray,
    lines: np.ndarray,
    enough: np.ndarray,
) -> np.ndarray:
    """Which tracks t keep enough[t] photos with an arc that no track kept before it, in this order, explains.

    The arcs of track t are member[starts[t] : starts[t + 1]], the tracks that explain arc i lines[line_starts[i] :
    line_starts[i + 1]].
    """
    kept = np.zeros(len(order), dtype=np.bool_)
    seen = np.full(images, -1, dtype=np.int64)
    for track in order:
        views = 0
        for i in member[starts[track] : starts[track + 1]]:
            if seen[image[i]] == track:
                continue
            free = True
            for line in lines[line_starts[i] : line_starts[i + 1]]:
                if kept[line]:
                    free = False
                    break
            if free:
                seen[image[i]] = track
                views += 1
        kept[track] = views >= enough[track]
    return kept
