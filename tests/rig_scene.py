"""Lines all around, seen at several instants by two cameras side by side: a rig, with known truth."""

import math

import numpy as np
import torch

from camera_models import CameraModel, OpenCVFisheye, Scaramuzza
from camera_models.pose import Pose, rotation_from_vector
from omnilines.adjustment.arcs import MatchedArcs, Observed
from omnilines.adjustment.state import Rig
from omnilines.geometry.line import PlueckerLines

SIZE = (1280, 960)
FISHEYE = OpenCVFisheye([300.0, 302.0, 645.0, 470.0, 0.01, -0.004, 0.002, 0.0], SIZE)
OTHER = Scaramuzza([640.0, 480.0, 1.0, 0.0, 0.0, 290.0, -1.2e-3, 0.0, -2e-9], SIZE)
LEAST_PHOTOS = 5


class RigScene:
    """Lines all around, seen at several instants by two cameras side by side that look 60 degrees apart."""

    def __init__(self, frames: int = 8, lines: int = 40, seed: int = 0, models: tuple[CameraModel, ...] = (FISHEYE, OTHER)):
        rng = np.random.default_rng(seed)
        self.models = models
        middle = rng.uniform(-3, 3, (lines, 3))
        along = rng.normal(size=(lines, 3))
        half = 0.7 * along / np.linalg.norm(along, axis=-1, keepdims=True)
        self.ends = torch.as_tensor(np.stack([middle - half, middle + half], 1))
        self.lines = PlueckerLines.from_points(self.ends[:, 0], self.ends[:, 1])
        turns = rotation_from_vector(torch.as_tensor(0.3 * rng.normal(size=(frames, 3))))
        centre = torch.as_tensor(rng.uniform(-0.8, 0.8, (frames, 3)))
        self.rig_from_world = Pose(turns, -(turns @ centre[..., None])[..., 0])
        turn = rotation_from_vector(torch.tensor([0.0, math.radians(60), 0.02], dtype=torch.float64))
        second = Pose(turn[None], torch.tensor([[-0.3, 0.02, 0.01]], dtype=torch.float64))
        count = len(models)
        cam_from_rig = Pose(
            torch.cat([Pose.identity(1).rotation, second.rotation])[:count],
            torch.cat([Pose.identity(1).translation, second.translation])[:count],
        )
        frame, camera = (g.flatten() for g in torch.meshgrid(torch.arange(frames), torch.arange(count), indexing="ij"))
        self.rig = Rig(frame, camera, cam_from_rig)
        self.cam_from_world = cam_from_rig[camera] @ self.rig_from_world[frame]
        image, track = (g.flatten() for g in torch.meshgrid(torch.arange(len(frame)), torch.arange(lines), indexing="ij"))
        seen = self.cam_from_world[image].transform(self.ends[track])
        pixels = torch.zeros(len(image), 2, 2, dtype=torch.float64)
        keep = torch.zeros(len(image), dtype=torch.bool)
        for index, model in enumerate(models):
            mine = camera[image] == index
            pixels[mine], valid = model.project(seen[mine])
            inside = ((pixels[mine] > 0) & (pixels[mine] < torch.tensor(SIZE))).all(-1)
            keep[mine] = (valid & inside & (seen[mine].norm(dim=-1) > 0.5)).all(-1)
        # Lines that few photos show say nothing of what is tested here.
        often = torch.bincount(track[keep], minlength=lines) >= LEAST_PHOTOS
        keep = keep & often[track]
        self.ends, self.lines = self.ends[often], self.lines[torch.nonzero(often).flatten()]
        number = torch.cumsum(often.long(), 0) - 1
        self.image, self.track, self.pixels = image[keep], number[track[keep]], pixels[keep]

    def arcs(self, noise_px: float = 0.0, seed: int = 0, models: tuple[CameraModel, ...] | None = None) -> MatchedArcs:
        random = torch.randn(self.pixels.shape, generator=torch.Generator().manual_seed(500 + seed), dtype=torch.float64)
        n = len(self.image)
        covariance = max(noise_px, 0.1) ** 2 * torch.eye(2, dtype=torch.float64).expand(n, 2, 2, 2)
        empty = torch.zeros(n, 2, 3, dtype=torch.float64)
        plain = MatchedArcs(
            self.image,
            self.track,
            len(self.cam_from_world),
            len(self.ends),
            empty,
            torch.zeros(n, 2, 3, 2, dtype=torch.float64),
            covariance,
            True,
            observed=Observed(self.pixels + noise_px * random, self.rig.camera[self.image]),
        )
        return plain.seen_by(models or self.models)


def disturbed(poses: Pose, angle_deg: float, shift_m: float, seed: int = 0) -> Pose:
    random = torch.randn(len(poses), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Pose.exp(random * torch.tensor([math.radians(angle_deg)] * 3 + [shift_m] * 3)) @ poses


def moved_models(models: tuple[CameraModel, ...]) -> tuple[CameraModel, ...]:
    """Focal length off by two percent, centre by some pixels."""
    found = []
    for model in models:
        values = model.parameters.clone()
        for index, name in enumerate(model.PARAMETER_NAMES):
            if name in ("fx", "fy", "a0"):
                values[index] *= 1.02
            elif name in ("cx", "cy"):
                values[index] += 4.0
        found.append(model.with_parameters(values))
    return tuple(found)
