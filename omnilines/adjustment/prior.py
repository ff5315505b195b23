"""What is known of poses beforehand: a mean and standard deviations, as extra residuals of the adjustment."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose, hat


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
