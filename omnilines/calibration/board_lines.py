"""The rows and columns of a plane target as straight lines: segments between the first and the last corner seen of each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models.errors import InputError
from omnilines.records import Corners, Segments

SAME_LINE_M = 1e-7
"""Corners whose coordinates differ by less lie on the same row or column."""


@dataclass(frozen=True)
class BoardLines:
    """Observed segments of the rows and columns of a board, and where these lie on it. Track k of the segments is line k."""

    segments: Segments
    ends_m: Float[np.ndarray, "t 2 3"]
    """First and last corner of each line that any photo shows, board frame."""
    column: Bool[np.ndarray, " t"]
    """True for columns (lines along y), false for rows (along x); each family is in the order of the board."""


def board_lines(corners: Corners, chosen: Bool[np.ndarray, " n"]) -> BoardLines:
    """The lines of the chosen corners, named row0, row1, ..., col0, col1, ...

    A row holds the corners of one board y, a column those of one board x. A view of a line is the segment between the first
    and the last chosen corner on it; a view with one corner is left out. Raises InputError where the board is not plane
    (z = 0), where a photo holds two views, or where fewer than two rows or two columns are seen.
    """
    _require_plane_and_single(corners, chosen)
    rows = _family(corners, chosen, along=0, first_track=0)
    columns = _family(corners, chosen, along=1, first_track=len(rows.ends_m))
    counts = len(rows.ends_m), len(columns.ends_m)
    if min(counts) < 2:
        raise InputError(
            f"A board with at least 2 rows and 2 columns of corners was expected, found {counts[0]} and {counts[1]}; "
            "check the pattern or the board coordinates in corners.csv."
        )
    tracks = tuple(f"row{k}" for k in range(counts[0])) + tuple(f"col{k}" for k in range(counts[1]))
    segments = Segments(
        np.concatenate([rows.view, columns.view]),
        corners.images,
        np.concatenate([rows.track, columns.track]),
        tracks,
        np.concatenate([rows.endpoints_px, columns.endpoints_px]),
    )
    return BoardLines(segments, np.concatenate([rows.ends_m, columns.ends_m]), np.arange(sum(counts)) >= counts[0])


@dataclass(frozen=True)
class _Family:
    view: Int[np.ndarray, " s"]
    track: Int[np.ndarray, " s"]
    endpoints_px: Float[np.ndarray, "s 2 2"]
    ends_m: Float[np.ndarray, "t 2 3"]


def _family(corners: Corners, chosen: Bool[np.ndarray, " n"], along: int, first_track: int) -> _Family:
    """The lines along one axis of the board, in the order of the other."""
    board, pixels, view = corners.board_m[chosen], corners.pixels[chosen], corners.view[chosen]
    _, line = np.unique(np.round(board[:, 1 - along] / SAME_LINE_M), return_inverse=True)
    lines = int(line.max(initial=-1)) + 1
    # Sorted by segment and position along it, so that the first and the last row of a segment are its ends.
    order = np.lexsort((board[:, along], line, view))
    _, start, count = np.unique((view * lines + line)[order], return_index=True, return_counts=True)
    first, last = order[start], order[start + count - 1]
    seen = first != last
    first, last = first[seen], last[seen]
    used, track = np.unique(line[first], return_inverse=True)
    ends = np.zeros((len(used), 2, 3))
    ends[:, :, along] = np.stack([np.full(len(used), np.inf), np.full(len(used), -np.inf)], 1)
    np.minimum.at(ends[:, 0, along], track, board[first, along])
    np.maximum.at(ends[:, 1, along], track, board[last, along])
    ends[track, :, 1 - along] = board[first, None, 1 - along]
    return _Family(view[first], first_track + track, np.stack([pixels[first], pixels[last]], 1), ends)


def _require_plane_and_single(corners: Corners, chosen: Bool[np.ndarray, " n"]) -> None:
    height = np.abs(corners.board_m[chosen, 2]).max(initial=0.0)
    if height > 0:
        raise InputError(f"A plane board (z = 0) was expected, found corners up to {height:g} m off it; use a plane target.")
    images = [corners.images[v] for v in np.unique(corners.view[chosen])]
    twice = [image for k, image in enumerate(images) if image in images[:k]]
    if twice:
        raise InputError(f"One view of the board in each photo was expected, found two in {twice[0]}; give each its own photo.")
