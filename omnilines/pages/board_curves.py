"""The rows and columns of a board as a camera sees them."""

import numpy as np
import torch
from jaxtyping import Float

from camera_models import CameraModel
from camera_models.pose import Pose

STEPS_PER_LINE = 40
"""Points per reprojected board line: a fisheye bends it."""


def grid_curves_px(model: CameraModel, cam_from_board: Pose, board_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k s 2"]:
    """The rows and columns through these corners as curves in the image; NaN where they have none."""
    ends = grid_lines(board_m)
    steps = np.linspace(0, 1, STEPS_PER_LINE)[:, None]
    points = ends[:, None, 0] * (1 - steps) + ends[:, None, 1] * steps
    pixels, valid = model.project(cam_from_board.transform(torch.as_tensor(points.reshape(-1, 3))).numpy())
    return np.where(valid[:, None], pixels, np.nan).reshape(len(ends), STEPS_PER_LINE, 2)


def grid_lines(board_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 2 3"]:
    """End points of the straight lines through corners with the same y, and with the same x, at least two corners each."""
    lines = []
    for across, along in ((1, 0), (0, 1)):
        for value in np.unique(np.round(board_m[:, across], 9)):
            row = board_m[np.abs(board_m[:, across] - value) < 1e-8]
            if len(row) > 1:
                lines.append([row[np.argmin(row[:, along])], row[np.argmax(row[:, along])]])
    return np.array(lines).reshape(-1, 2, 3)
