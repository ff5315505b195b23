"""Videos of a board held by hand, rendered: it moves from pose to pose, rests at some, and is exposed row by row."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from calib_patterns import Pattern
from calib_patterns.rendering import graded_background, render_target
from camera_models import CameraModel
from camera_models.pose import Pose


@dataclass(frozen=True)
class Path6:
    """A smooth motion through poses: at rest in each for a while, then on to the next by the geodesic of SE(3)."""

    poses: Pose
    move_s: float
    rest_s: float

    @property
    def duration_s(self) -> float:
        """Until the last pose is reached and held."""
        return (len(self.poses.translation) - 1) * (self.move_s + self.rest_s) + self.rest_s

    def at(self, time_s: float) -> Pose:
        """cam_from_board."""
        step, within = divmod(time_s, self.move_s + self.rest_s)
        start = min(int(step), len(self.poses.translation) - 1)
        share = 0.0 if start + 1 >= len(self.poses.translation) else max(0.0, (within - self.rest_s) / self.move_s)
        first = Pose(self.poses.rotation[start], self.poses.translation[start])
        if share == 0.0:
            return first
        last = Pose(self.poses.rotation[start + 1], self.poses.translation[start + 1])
        eased = 0.5 - 0.5 * np.cos(np.pi * share)
        return Pose.exp(eased * (last @ first.inverse()).log()) @ first

    def rests(self, begin_s: float, end_s: float) -> bool:
        """Whether the board stands still from one time to another, which are near."""
        first, last = self.at(begin_s), self.at(end_s)
        return torch.equal(first.rotation, last.rotation) and torch.equal(first.translation, last.translation)


@dataclass(frozen=True)
class Shutter:
    """How a frame is exposed: every row for `exposure_s`, the last row `readout_s` after the first."""

    exposure_s: float = 0.0
    readout_s: float = 0.0
    samples: int = 1
    """Renderings along the exposure and readout, between which rows are blended."""


def frame(
    pattern: Pattern,
    model: CameraModel,
    path: Path6,
    time_s: float,
    shutter: Shutter,
    noise_grey: float,
    seed: int,
    wall: Float[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w"]:
    """A photo of the board at an instant, which is that of the first row's beginning."""
    span_s = shutter.exposure_s + shutter.readout_s
    if shutter.samples == 1 or path.rests(time_s, time_s + span_s):
        return render_target(
            pattern, model, path.at(time_s), supersample=2, blur_px=0.5, noise_grey=noise_grey, background=wall, seed=seed
        )
    times = np.linspace(0.0, span_s, shutter.samples)
    shots = np.stack([render_target(pattern, model, path.at(time_s + t), supersample=2, blur_px=0.5) for t in times])
    begins = shutter.readout_s * np.linspace(0, 1, model.image_size[1])
    weight: Float[np.ndarray, "s h"] = np.clip(
        1.0 - np.maximum(0.0, np.abs(times[:, None] - begins - 0.5 * shutter.exposure_s) - 0.5 * shutter.exposure_s)
        / (times[1] - times[0]), 0.0, None,
    )  # fmt: skip
    mean = np.einsum("sh,shw->hw", weight / weight.sum(0), shots.astype(np.float64))
    noise = np.random.default_rng(seed).normal(0.0, noise_grey, mean.shape)
    return np.clip(mean + noise, 0, 255).round().astype(np.uint8)


def write_video(
    file: Path, pattern: Pattern, model: CameraModel, path: Path6, shutter: Shutter = Shutter(), frames_per_s: float = 15.0,
    noise_grey: float = 2.0, start_s: float = 0.0,
) -> list[float]:  # fmt: skip
    """A video of the whole motion (motion JPEG); returns the instant of each frame."""
    wall = graded_background(model, np.random.default_rng(0))
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), frames_per_s, model.image_size)
    assert writer.isOpened()
    times = [start_s + k / frames_per_s for k in range(int((path.duration_s - start_s) * frames_per_s))]
    for number, time_s in enumerate(times):
        shot = frame(pattern, model, path, time_s, shutter, noise_grey, seed=number + round(1e6 * start_s), wall=wall)
        writer.write(cv2.cvtColor(shot, cv2.COLOR_GRAY2BGR))
    writer.release()
    return times


def random_path(poses: Pose, move_s: float = 0.6, rest_s: float = 0.3) -> Path6:
    """Through the poses in their order."""
    return Path6(Pose(poses.rotation.to(torch.float64), poses.translation.to(torch.float64)), move_s, rest_s)
