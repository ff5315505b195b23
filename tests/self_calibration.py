"""Lines in a cube seen by one camera from all around: enough to calibrate it by straight lines, with known truth."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel, OpenCVFisheye, Pinhole
from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, Observed
from omnilines.adjustment.lines import adjust_lines
from omnilines.geometry.line import PlueckerLines

SIZE = (1280, 960)
PINHOLE = Pinhole([800.0, 800.0, 640.0, 480.0, *([0.0] * 9)], SIZE, 0)
FISHEYE = OpenCVFisheye([290.0, 292.0, 645.0, 470.0, 0.01, -0.004, 0.002, 0.0], SIZE)
"""Half of its field of view of 190 degrees is 95 degrees off the axis."""
LIMIT_RAD = {"pinhole": np.radians(45.0), "opencv-fisheye": np.radians(95.0)}
LEAST_PHOTOS = 4


class SelfCalibration:
    """A pinhole looks at the cube from 4 to 6 m; a fisheye stands in it."""

    def __init__(self, model: CameraModel, photos: int = 10, lines: int = 80, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.model = model
        ends = torch.as_tensor(rng.uniform(-1.0, 1.0, (lines, 2, 3)))
        towards = rng.normal(size=(photos, 3))
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        distance = rng.uniform(4.0, 6.0, photos) if model.NAME == "pinhole" else rng.uniform(0.0, 0.5, photos)
        centre = torch.as_tensor(distance[:, None] * towards)
        forward = -towards if model.NAME == "pinhole" else rng.normal(size=(photos, 3))
        self.cam_from_world = _looking(centre, torch.as_tensor(forward + 0.1 * rng.normal(size=(photos, 3))), rng)
        image, track = (g.flatten() for g in torch.meshgrid(torch.arange(photos), torch.arange(lines), indexing="ij"))
        seen = self.cam_from_world[image].transform(ends[track])
        pixels, valid = model.project(seen)
        inside = ((pixels > 0) & (pixels < torch.tensor(SIZE))).all(-1) & (seen.norm(dim=-1) > 0.2)
        off_axis = torch.atan2(seen[..., :2].norm(dim=-1), seen[..., 2])
        length = (pixels[:, 1] - pixels[:, 0]).norm(dim=-1)
        keep = (valid & inside & (off_axis < LIMIT_RAD[model.NAME])).all(-1) & (length > 60)
        often = torch.bincount(track[keep], minlength=lines) >= LEAST_PHOTOS
        keep = keep & often[track]
        self.image, self.track = image[keep], (torch.cumsum(often.long(), 0) - 1)[track[keep]]
        self.pixels, self.ends = pixels[keep], ends[often]
        self.lines = PlueckerLines.from_points(self.ends[:, 0], self.ends[:, 1])

    def arcs(self, noise_px: float, seed: int) -> MatchedArcs:
        """Every coordinate of every end with independent noise, stated."""
        random = torch.randn(self.pixels.shape, generator=torch.Generator().manual_seed(900 + seed), dtype=torch.float64)
        n = len(self.image)
        blind = MatchedArcs(
            self.image,
            self.track,
            len(self.cam_from_world),
            len(self.ends),
            torch.zeros(n, 2, 3, dtype=torch.float64),
            torch.zeros(n, 2, 3, 2, dtype=torch.float64),
            max(noise_px, 0.1) ** 2 * torch.eye(2, dtype=torch.float64).expand(n, 2, 2, 2),
            True,
            observed=Observed(self.pixels + noise_px * random, torch.zeros(n, dtype=torch.long)),
        )
        return blind.seen_by((self.model,))

    def calibrated(self, noise_px: float, seed: int, cost: str = "whitened") -> Adjusted:
        """Lines, poses and intrinsics from the truth as a start."""
        return adjust_lines(self.arcs(noise_px, seed), self.lines, self.cam_from_world, cost=cost, models=(self.model,))

    def scores(self, found: Adjusted) -> Float[Tensor, " q"]:
        """Error of each intrinsic over its standard deviation."""
        into = torch.linalg.pinv(self.model.calibration_basis())
        covariance = into @ found.camera_covariance[0] @ into.mT
        return into @ (found.state.models[0].parameters - self.model.parameters) / covariance.diagonal().sqrt()


def _looking(centre: Tensor, forward: Tensor, rng: np.random.Generator) -> Pose:
    """Cameras at places with their axis forward, turned about it at random."""
    z = forward / forward.norm(dim=-1, keepdim=True)
    x = torch.linalg.cross(torch.as_tensor(rng.normal(size=tuple(centre.shape))), z)
    x = x / x.norm(dim=-1, keepdim=True)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], -2)
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])
