"""Does a board stand where another camera says? Views of a rig with the poses that each camera found alone, and how far a
predicted pose is from them: in the directions of the board's corners as the camera sees them, in squares of the board.

Directions and not distances are compared: that a small board far out at the rim is uncertain in depth then does no harm.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from camera_models.rotations import mean_rotation
from omnilines.calibration.thresholds import RigThresholds

_CHUNK = 2_000_000


@dataclass(frozen=True, eq=False)
class PosedViews:
    """Views of boards with a pose each, and the ways in which each may have been numbered."""

    camera: Int[Tensor, " v"]
    frame: Int[Tensor, " v"]
    board: Int[Tensor, " v"]
    corners: Int[Tensor, " v"]
    cam_from_board: Pose
    patch_m: Float[Tensor, "v 5 3"]
    """The ends and the middle of what the view shows of its board."""
    pitch_m: Float[Tensor, " v"]
    board_from_numbered: Pose
    """Of each view and numbering (v, k), the numbering as it is first."""
    allowed: Bool[Tensor, "v k"]

    def __len__(self) -> int:
        return len(self.camera)

    def chosen(self, views: Int[Tensor, " w"]) -> "PosedViews":
        """Some of the views."""
        return PosedViews(
            camera=self.camera[views],
            frame=self.frame[views],
            board=self.board[views],
            corners=self.corners[views],
            cam_from_board=self.cam_from_board[views],
            patch_m=self.patch_m[views],
            pitch_m=self.pitch_m[views],
            board_from_numbered=self.board_from_numbered[views],
            allowed=self.allowed[views],
        )

    def as_numbered(self) -> "PosedViews":
        """No other numbering than the given one."""
        return replace(self, board_from_numbered=self.board_from_numbered[:, :1], allowed=self.allowed[:, :1])

    def seen_in_mirrors(self, cameras: Sequence[int]) -> "PosedViews":
        """The poses with z reversed for these cameras: what they are if a0 has the other sign (F P F, F = diag(1, 1, -1))."""
        turned = torch.isin(self.camera, torch.tensor(list(cameras), dtype=torch.long))
        return replace(self, cam_from_board=reflected(self.cam_from_board, turned))

    @cached_property
    def _seen(self) -> tuple[Float[Tensor, "v 5 3"], Float[Tensor, " v"]]:
        """Directions of the patch and the mean angle between neighbouring corners."""
        place = self.cam_from_board.transform(self.patch_m)
        rays = _unit(place)
        steps = [_unit(place + self.pitch_m[:, None, None] * self.cam_from_board.rotation[:, None, :, k]) - rays for k in (0, 1)]
        spacing = torch.stack(steps).square().sum(-1).mean((0, 2)).sqrt()
        return rays, spacing.clamp_min(1e-12)

    def distance(self, predicted: Pose) -> Float[Tensor, "h v k"]:
        """Root mean square angle between predicted and seen corners over the spacing of corners, for poses (h, v) of the board
        and every numbering; infinite where that is not allowed."""
        rays, spacing = self._seen
        place = self.board_from_numbered.transform(self.patch_m[:, None].expand(-1, self.allowed.shape[1], -1, -1))
        found = []
        step = max(1, _CHUNK // max(1, place.numel()))
        for low in range(0, predicted.rotation.shape[0], step):
            rotation, translation = predicted.rotation[low : low + step], predicted.translation[low : low + step]
            seen = place[None] @ rotation[:, :, None].mT + translation[:, :, None, None]
            off = (_unit(seen) - rays[:, None]).square().sum(-1).mean(-1).sqrt()
            found.append(torch.where(self.allowed, off / spacing[:, None], torch.inf))
        return torch.cat(found)

    def agreement(
        self, predicted: Pose, thresholds: RigThresholds
    ) -> tuple[Float[Tensor, "h v"], Int[Tensor, "h v"], Bool[Tensor, "h v"]]:
        """How well every view agrees with a predicted pose (0 to 1), with which numbering, and whether it does at all.

        A truncated square, as in M-estimator sample consensus (P. Torr, A. Zisserman, MLESAC, CVIU 2000); the numbering as it is
        has a small bonus.
        """
        gain = (1 - (self.distance(predicted) / thresholds.agreeing_squares).square()).clamp_min(0)
        gain[..., 0] += thresholds.as_numbered_bonus * (gain[..., 0] > 0)
        value, numbering = gain.max(-1)
        return value, numbering, value > 0


def reflected(poses: Pose, turned: Bool[Tensor, " v"]) -> Pose:
    """F P F with F = diag(1, 1, -1) where `turned`, else P."""
    sign = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    turns = torch.where(turned[:, None], sign, torch.ones_like(sign))
    return Pose(turns[:, :, None] * poses.rotation * turns[:, None, :], turns * poses.translation)


def _unit(points: Tensor) -> Tensor:
    return points / points.norm(dim=-1, keepdim=True).clamp_min(1e-300)


def mean_pose(poses: Pose, weight: Float[Tensor, " n"]) -> Pose:
    """Weighted mean of poses that are near each other: the chordal mean of their rotations, the mean of their centres."""
    total = weight.sum()
    return Pose(mean_rotation(poses.rotation, weight), (weight[:, None] * poses.translation).sum(0) / total)
