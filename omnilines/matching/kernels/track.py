"""Arcs put together into tracks, and lines compared with the arcs of all photos, compiled.

`no_type_check` keeps the type checker of the tests from wrapping what numba compiles.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def claim(order: np.ndarray, support: np.ndarray, image: np.ndarray, images: int, min_views: int) -> tuple[np.ndarray, int]:
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
        if views < min_views:
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
    rows: np.ndarray,
    image: np.ndarray,
    packed: np.ndarray,
    direction: np.ndarray,
    moment: np.ndarray,
    span: np.ndarray,
    gate_rad: np.ndarray,
    starts: np.ndarray,
    asked: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of an arc, line): both ends within `gate_rad` of the line's great circle, and the line lies where the arc is.

    `span` holds the positions along each line between which it is known; an arc has to overlap that. The arcs of photo p are
    compared with the lines asked[starts[p] : starts[p + 1]]; rows of one photo stand together.
    """
    capacity = 1024
    arcs, lines = np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64)
    count, photo = 0, -1
    own, most = asked[:0], np.max(starts[1:] - starts[:-1])
    about, close = np.empty((4, most)), np.empty(most, dtype=np.bool_)
    for k in range(len(rows)):
        p = packed[rows[k]]
        if image[rows[k]] != photo:
            photo = image[rows[k]]
            own = asked[starts[photo] : starts[photo + 1]]
            _moments_about(p[9:12], own, direction, moment, about)
        _within(p, about, np.sin(gate_rad[k]) ** 2, close[: len(own)])
        for place in range(len(own)):
            line = own[place]
            if not close[place] or not _overlaps(p, direction[line], about[:, place], span[line]):
                continue
            if count == capacity:
                capacity *= 2
                arcs, lines = _grown(arcs, capacity), _grown(lines, capacity)
            arcs[count], lines[count] = rows[k], line
            count += 1
    return arcs[:count], lines[:count]


@njit(cache=True, nogil=True)
@no_type_check
def _moments_about(centre: np.ndarray, own: np.ndarray, direction: np.ndarray, moment: np.ndarray, about: np.ndarray) -> None:
    """Columns of each line of `own`: its moment about a centre, and the square of that, the distance from the centre."""
    for place in range(len(own)):
        line = own[place]
        dx, dy, dz = direction[line, 0], direction[line, 1], direction[line, 2]
        mx = moment[line, 0] - (centre[1] * dz - centre[2] * dy)
        my = moment[line, 1] - (centre[2] * dx - centre[0] * dz)
        mz = moment[line, 2] - (centre[0] * dy - centre[1] * dx)
        about[0, place], about[1, place], about[2, place] = mx, my, mz
        about[3, place] = mx * mx + my * my + mz * mz


@njit(cache=True, nogil=True)
@no_type_check
def _within(p: np.ndarray, about: np.ndarray, square_sine: float, close: np.ndarray) -> None:
    """Whether both ends of an arc lie near the great circle of each line. Asked of every arc and every line: without a branch, it
    is compiled to vector instructions."""
    mx, my, mz, square = about[0], about[1], about[2], about[3]
    ax, ay, az, bx, by, bz = p[0], p[1], p[2], p[3], p[4], p[5]
    for line in range(len(close)):
        limit = square_sine * square[line]
        first = ax * mx[line] + ay * my[line] + az * mz[line]
        last = bx * mx[line] + by * my[line] + bz * mz[line]
        close[line] = (first * first <= limit) & (last * last <= limit)


@njit(cache=True, nogil=True)
@no_type_check
def _overlaps(p: np.ndarray, d: np.ndarray, about: np.ndarray, span: np.ndarray) -> bool:
    """Whether a line is known where an arc on it lies, in front of the camera."""
    mx, my, mz, square = about[0], about[1], about[2], about[3]
    # To the point of the line nearest to the centre: d x m.
    tx, ty, tz = d[1] * mz - d[2] * my, d[2] * mx - d[0] * mz, d[0] * my - d[1] * mx
    first, last = p[0] * tx + p[1] * ty + p[2] * tz, p[3] * tx + p[4] * ty + p[5] * tz
    if first <= 0.0 or last <= 0.0:
        return False
    base = p[9] * d[0] + p[10] * d[1] + p[11] * d[2]
    low = base + square * (p[0] * d[0] + p[1] * d[1] + p[2] * d[2]) / first
    high = base + square * (p[3] * d[0] + p[4] * d[1] + p[5] * d[2]) / last
    if high < low:
        low, high = high, low
    return min(high, span[1]) > max(low, span[0])


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
