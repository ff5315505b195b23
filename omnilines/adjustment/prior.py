"""What is known of poses beforehand: a mean and standard deviations, as extra residuals of the adjustment."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from camera_models.pose import Pose, hat
from omnilines.records import ImagePoses


@dataclass(frozen=True)
class PosePrior:
    """A prior on the pose of every frame (every photo without a rig): r = log(T T0^-1) over the standard deviations."""

    mean: Pose
    sigma_rad: Float[Tensor, " frames"]
    """Of each component of the rotation vector; infinite where nothing is known."""
    sigma_m: Float[Tensor, " frames"]

    def weighing(self, unit: float) -> "PosePrior":
        """The prior in the unit of a cost whose squared residuals are so large where those of a prior are one."""
        root = math.sqrt(unit)
        return PosePrior(self.mean, self.sigma_rad / root, self.sigma_m / root)

    def residual(self, poses: Pose) -> tuple[Float[Tensor, "frames 6"], Float[Tensor, "frames 6 6"]]:
        """r and its derivative by the left perturbation of T.

        d log(exp(e) exp(x)) / d e = I - ad(x) / 2 + ad(x)^2 / 12 up to terms of the fourth order in x.
        """
        x = (poses @ self.mean.inverse()).log()
        scale = torch.cat([self.sigma_rad[:, None].expand(-1, 3), self.sigma_m[:, None].expand(-1, 3)], -1).reciprocal()
        turn, shift = hat(x[:, :3]), hat(x[:, 3:])
        ad = torch.cat([torch.cat([turn, torch.zeros_like(turn)], -1), torch.cat([shift, turn], -1)], -2)
        inverse = torch.eye(6, dtype=x.dtype, device=x.device) - 0.5 * ad + ad @ ad / 12
        return x * scale, inverse * scale[..., None]


@dataclass(frozen=True)
class KnownPoses:
    """Poses of photos that are known beforehand, each component to a standard deviation."""

    poses: ImagePoses
    sigma_rad: float
    sigma_m: float

    def prior(self, poses: ImagePoses, frames_of: Callable[[ImagePoses], Pose]) -> PosePrior:
        """On the frames of `poses`, which `frames_of` gives of a table; of an instant with an unknown photo nothing is known."""
        row = {image: k for k, image in enumerate(self.poses.images)}
        unknown = {instant for image, instant in zip(poses.images, poses.instants, strict=True) if image not in row}
        known = [k for k, instant in enumerate(poses.instants) if instant not in unknown]
        own = [row[poses.images[k]] for k in known]
        rotation, translation = poses.cam_from_world.rotation.clone(), poses.cam_from_world.translation.clone()
        rotation[known], translation[known] = self.poses.cam_from_world.rotation[own], self.poses.cam_from_world.translation[own]
        mean = frames_of(replace(poses, cam_from_world=Pose(rotation, translation)))
        # Without a rig every photo is a frame, whatever instants the table names.
        of_frame = poses.instants if len(mean) == len(poses) else dict.fromkeys(poses.instants)
        free = torch.tensor([instant in unknown for instant in of_frame])
        sigma = (torch.full((len(mean),), value, dtype=torch.float64) for value in (self.sigma_rad, self.sigma_m))
        return PosePrior(mean, *(one.masked_fill(free, math.inf) for one in sigma))

    def loosened(self, times: float) -> "KnownPoses":
        """So many times as uncertain."""
        return replace(self, sigma_rad=times * self.sigma_rad, sigma_m=times * self.sigma_m)

    def agreeing(self, poses: ImagePoses, significance: float) -> "KnownPoses":
        """Those of photos that are no farther off in `poses` than chance makes more often than this (chi-square), by these
        deviations and the covariances that `poses` state."""
        row = {image: k for k, image in enumerate(poses.images)}
        shared = [k for k, image in enumerate(self.poses.images) if image in row]
        own = [row[self.poses.images[k]] for k in shared]
        off = (poses.cam_from_world[own] @ self.poses.cam_from_world[shared].inverse()).log().numpy()
        spread = np.diag(np.square([self.sigma_rad] * 3 + [self.sigma_m] * 3))
        spread = spread if poses.covariance is None else spread + poses.covariance[own]
        squared = (off * np.linalg.solve(spread, off[..., None])[..., 0]).sum(-1)
        # What is not known contradicts nothing.
        near = np.array(shared, dtype=np.int64)[~(squared > chi2.isf(significance, 6))].tolist()
        return replace(self, poses=self.poses.rows(near))
