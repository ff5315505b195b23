"""Simulated rigs whose cameras run freely: a board in hand that never rests, seen by each camera at times of its own."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from rig_views import BOARD, FISHEYE_220, PINHOLE, looking_along, table_of

from camera_models import CameraModel
from camera_models.pose import Pose, rotation_from_vector
from omnilines.records import Corners

FRAMES_PER_S = 30.0
MODELS = (PINHOLE, FISHEYE_220)
"""Side by side."""
CAM_FROM_RIG = (lambda poses: poses @ poses[0].inverse())(
    looking_along(np.array([[0.0, 0, 1], [0.2, 0.05, 1.0]]), np.array([[0.0, 0, 0], [0.2, 0.02, 0.01]]))
)


@dataclass(frozen=True)
class HandMotion:
    """A board in hand: some harmonics of each coordinate, up to `highest_hz`."""

    seed: int
    highest_hz: float = 1.5
    speed: float = 1.0
    """0: at rest."""

    def at(self, time_s: Float[np.ndarray, " n"]) -> Pose:
        """`rig_from_board`, of the first camera; the middle of the board goes to and fro in front of both."""
        rng = np.random.default_rng(self.seed)
        hz, phase = rng.uniform(0.2, self.highest_hz, (4, 6)), rng.uniform(0, 2 * np.pi, (4, 6))
        # Slow swings are wide: the speed is alike.
        size = np.array([0.5, 0.5, 0.7, 0.16, 0.1, 0.12]) * 0.3 / hz * rng.uniform(0.5, 1.0, (4, 6))
        values = (size * np.sin(2 * np.pi * hz * self.speed * time_s[:, None, None] + phase)).sum(1)
        rotation = rotation_from_vector(torch.as_tensor(values[:, :3]))
        middle = torch.as_tensor(values[:, 3:] + np.array([0.1, 0.0, 0.65]))
        return Pose(rotation, middle - rotation @ torch.as_tensor(BOARD.mean(0)))


def seen_freely(
    motion: HandMotion,
    offsets_s: tuple[float, ...],
    runs: int = 16,
    frames_of_run: int = 5,
    models: tuple[CameraModel, ...] = MODELS,
    cam_from_rig: Pose = CAM_FROM_RIG,
) -> Corners:
    """Corners without noise of runs of consecutive frames every two seconds; the clock of camera c is ahead by `offsets_s[c]`."""
    views: list[tuple[str, str]] = []
    times, parts = [], []
    for c, model in enumerate(models):
        for run in range(runs):
            for k in range(frames_of_run):
                number = 60 * run + k
                clock_s = number / FRAMES_PER_S
                pose = cam_from_rig[c] @ motion.at(np.array([clock_s - offsets_s[c]]))[0]
                place = pose.transform(torch.as_tensor(BOARD))
                pixels, valid = model.project(place)
                limit = torch.tensor(model.image_size, dtype=torch.float64) - 3
                inside = (valid & ((pixels >= 2) & (pixels <= limit)).all(-1)).numpy()
                if inside.sum() < 20:
                    continue
                parts.append((len(views), BOARD[inside], pixels[inside].numpy()))
                views.append((f"cam{c}", f"{number:05d}"))
                times.append(clock_s)
    return replace(table_of(views, parts), times_s=np.array(times))


def noisy(corners: Corners, sigma_px: float, seed: int) -> Corners:
    random = np.random.default_rng(seed).standard_normal(corners.pixels.shape)
    return replace(corners, pixels=corners.pixels + sigma_px * random)
