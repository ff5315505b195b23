"""Simulated cameras with rolling shutters: a board in hand, of which each row of an image is seen later than the one above."""

from dataclasses import replace

import numpy as np
import torch
from clock_views import CAM_FROM_RIG, FRAMES_PER_S, MODELS, HandMotion
from jaxtyping import Float
from rig_views import BOARD, table_of
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.records import Corners

ROWS, COLUMNS = 1, 0
SCANS = 8
"""A row says when a corner is seen, and that in which row: so often in turn."""


def seen_in_rows(
    motion: HandMotion,
    line_delays_s: tuple[float, ...],
    *,
    axis: int = ROWS,
    offsets_s: tuple[float, ...] = (0.0, 0.0),
    models: tuple[CameraModel, ...] = MODELS,
    cam_from_rig: Pose = CAM_FROM_RIG,
    runs: int = 16,
    frames_of_run: int = 5,
) -> Corners:
    """Corners without noise of runs of consecutive frames every two seconds. Camera c exposes its middle row (column) at the time
    of the frame, and each other `line_delays_s[c]` after the one before."""
    views: list[tuple[str, str]] = []
    times, parts = [], []
    for c, model in enumerate(models):
        for run in range(runs):
            for number in range(60 * run, 60 * run + frames_of_run):
                clock_s = number / FRAMES_PER_S
                pixels, valid = _scanned(motion, clock_s - offsets_s[c], line_delays_s[c], axis, model, cam_from_rig[c])
                limit = torch.tensor(model.image_size, dtype=torch.float64) - 3
                inside = (valid & ((pixels >= 2) & (pixels <= limit)).all(-1)).numpy()
                if inside.sum() >= 20:
                    parts.append((len(views), BOARD[inside], pixels[inside].numpy()))
                    views.append((f"cam{c}", f"{number:05d}"))
                    times.append(clock_s)
    return replace(table_of(views, parts), times_s=np.array(times))


def _scanned(
    motion: HandMotion, middle_s: float, line_delay_s: float, axis: int, model: CameraModel, cam_from_rig: Pose
) -> tuple[Float[Tensor, "n 2"], Tensor]:
    """Where the corners are seen in a frame, each when the row that it is in is exposed."""
    board, middle_px = torch.as_tensor(BOARD), 0.5 * (model.image_size[axis] - 1)
    seen_s = np.full(len(BOARD), middle_s)
    for _ in range(SCANS):
        pose = cam_from_rig @ motion.at(seen_s)
        pixels, valid = model.project((pose.rotation @ board[..., None])[..., 0] + pose.translation)
        row = torch.where(valid, pixels[:, axis], middle_px).numpy().clip(0, model.image_size[axis])
        seen_s = middle_s + line_delay_s * (row - middle_px)
    return pixels, valid
