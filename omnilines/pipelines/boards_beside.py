"""Photos of lines with boards beside: what corners have said of the camera counts, and the edges of boards do not count again."""

from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from camera_models import InputError
from camera_models.wording import rounded
from omnilines.calibration.lines.check import line_check
from omnilines.calibration.lines.prior import CameraPrior
from omnilines.geometry.chains import Chains
from omnilines.pipelines.calibrate import CalibrationResult
from omnilines.pipelines.check_options import CheckOptions
from omnilines.pipelines.line_camera import prior_with_boards
from omnilines.pipelines.line_options import LinesOptions
from omnilines.pipelines.line_scale import asked_by_lines
from omnilines.progress import ProgressCallback

OUTLINE_POINTS = 40
"""Of each side of a board, whose sides are seen bent."""


def require_global_shutter(boards: CalibrationResult) -> None:
    """Raises InputError where boards were calibrated with a line delay, which lines do not know."""
    if boards.line_delay is not None and boards.line_delay.modelled:
        raise InputError("Boards without a line delay were expected with lines, found `rolling_shutter`; leave one of both out.")


def off_boards(chains: Chains, boards: CalibrationResult, margin_squares: float) -> Chains:
    """The chains that are not of a board, which reaches beyond its outermost corners by a margin."""
    corners, place = boards.found.corners, {name: k for k, name in enumerate(chains.images)}
    outline = torch.as_tensor(_outline(corners.board_m, margin_squares))
    inside = np.zeros(len(chains.chain), dtype=bool)
    for view in boards.views:
        if not view.used or view.cam_from_board is None or view.image not in place:
            continue
        seen, valid = boards.camera.project(view.cam_from_board.transform(outline))
        polygon = seen[valid].numpy()
        if len(polygon) < 3:
            continue
        own = np.flatnonzero(chains.image[chains.chain] == place[view.image])
        inside[own] |= _within(polygon, chains.pixels[own], chains.image_size)
    share = np.bincount(chains.chain, inside, chains.count) / np.maximum(np.bincount(chains.chain, minlength=chains.count), 1)
    return chains.of_chains(share < 0.5)


def _outline(board_m: Float[np.ndarray, "n 3"], margin_squares: float) -> Float[np.ndarray, "m 3"]:
    """The rectangle about corners in the plane of the board, with a margin."""
    steps = [np.diff(np.unique(np.round(board_m[:, axis], 9))) for axis in (0, 1)]
    margin = margin_squares * max(float(step.max(initial=0.0)) for step in steps)
    low, high = board_m[:, :2].min(0) - margin, board_m[:, :2].max(0) + margin
    part = np.linspace(0.0, 1.0, OUTLINE_POINTS, endpoint=False)[:, None]
    ends = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    sides = np.concatenate([a + part * (b - a) for a, b in pairwise(ends)])
    return np.pad(sides, ((0, 0), (0, 1)))


def _within(polygon: Float[np.ndarray, "m 2"], pixels: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> Bool[np.ndarray, " n"]:
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 1)
    u, v = np.clip(np.round(pixels).astype(np.int64), 0, np.array(size) - 1).T
    return mask[v, u] > 0


def prior_of_boards(boards: CalibrationResult, chains: Chains, lines: LinesOptions) -> CameraPrior:
    """What the boards say of the camera, for an adjustment to chains."""
    return prior_with_boards(boards.camera, torch.as_tensor(boards.covariance), chains, lines.adjustment)


def contradiction(boards: CalibrationResult, chains: Chains, lines: LinesOptions, progress: ProgressCallback) -> tuple[str, ...]:
    """One sentence where lines refuse the camera of the boards, beyond what its covariance allows."""
    asked, _ = asked_by_lines(boards.camera, chains, lines, progress)
    limits = CheckOptions()
    model, known = boards.camera.calibrated_form(), torch.as_tensor(boards.covariance)
    found = line_check(model, asked, known, significance=limits.significance)
    if not found.refused(limits.significance, limits.tolerance_px):
        return ()
    return (
        f"Lines and boards contradict one another: lines ask for a drift of at least {rounded(found.least_drift_px)} px "
        "(root mean "
        f"square) from the camera of the boards, which chance makes in {found.probability:.1g} of cases; check that the board is "
        "flat, and as large as stated both ways, and leave out photos of bent things; standard deviations do not hold.",
    )
