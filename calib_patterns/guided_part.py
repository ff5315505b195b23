"""Guided search of a plain board of which only a part was found: its ids are right up to a shift, which what is gained decides.

The corners are looked for all around the part, on a board so large that the part may lie anywhere on the true one. Of the places
that the true board can then have, the one that holds most corners is taken, of several the one nearest to what was thought.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from calib_patterns._pattern import Detection, Pattern
from calib_patterns.guided import GuidedCorners, guided_search
from calib_patterns.options import DetectionOptions
from camera_models._model import CameraModel
from camera_models.pose import Pose


def guided_search_of_part(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    cam_from_board: Pose,
    found: Detection,
    options: DetectionOptions = DetectionOptions(),
) -> GuidedCorners:
    """`guided_search`, with ids that are free to shift where a plain board was found in part.

    Arguments and errors are those of `guided_search`. The corners found come back as they were, but for their ids; the pose is
    that of the new ids.
    """
    grid = pattern.plain_grid
    if grid is None or not len(found):
        return guided_search(image, pattern, model, cam_from_board, found, options)
    places = np.stack([found.ids % grid.columns, found.ids // grid.columns], -1)
    low, high = places.min(0), places.max(0)
    board = np.array([grid.columns, grid.rows])
    # By so much the board can be shifted towards smaller columns and rows, and towards larger ones, and still hold the part.
    before, after = board - 1 - high, low
    if not (before.any() or after.any()):
        return guided_search(image, pattern, model, cam_from_board, found, options)
    room = board + before + after
    columns, rows = (int(count) for count in room)
    shifted = replace(found, ids=_ids(places + before, columns))
    start = cam_from_board @ _moved(-before, grid.pitch_m)
    search = guided_search(image, pattern.resized(columns, rows), model, start, shifted, options)
    if not search.fits:
        return GuidedCorners(found, cam_from_board, 0, False)
    all_places = np.stack([search.detection.ids % columns, search.detection.ids // columns], -1)
    first = _best_window(all_places, board, room, before)
    kept = ((all_places >= first) & (all_places < first + board)).all(1)
    whole = search.detection
    detection = Detection(
        _ids(all_places[kept] - first, grid.columns),
        whole.pixels[kept],
        whole.sigma_px[kept],
        None if whole.blur_px is None else whole.blur_px[kept],
    )
    return GuidedCorners(detection, search.cam_from_board @ _moved(first, grid.pitch_m), len(detection) - len(found), True)


def _ids(places: Int[np.ndarray, "k 2"], columns: int) -> Int[np.ndarray, " k"]:
    return places[:, 1] * columns + places[:, 0]


def _moved(places: Int[np.ndarray, "2"], pitch_m: float) -> Pose:
    """The pose of a board whose first corner is so many columns and rows on."""
    return Pose.of(torch.eye(3, dtype=torch.float64), pitch_m * np.append(places, 0).astype(np.float64))


def _best_window(
    places: Int[np.ndarray, "k 2"], board: Int[np.ndarray, "2"], room: Int[np.ndarray, "2"], before: Int[np.ndarray, "2"]
) -> Int[np.ndarray, "2"]:
    """First place of the board of which most corners are seen, of those the one nearest to where it was thought to be."""
    seen = np.zeros(room[::-1], dtype=np.int64)
    seen[places[:, 1], places[:, 0]] = 1
    held = np.lib.stride_tricks.sliding_window_view(seen, tuple(board[::-1])).sum((2, 3))
    row, column = np.nonzero(held == held.max())
    windows = np.stack([column, row], -1)
    return np.asarray(windows[np.abs(windows - before).sum(1).argmin()])
