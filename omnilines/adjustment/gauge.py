"""Which similarities of a scene its observations and what is held leave open.

A small turn w, shift v and relative growth s about an origin move X by w x (X - o) + v + s (X - o). A held pose forbids what
turns it or moves its centre, a held line what turns it or moves it across itself, and a known length all growth; what remains is
the gauge. One held pose leaves the growth about it; so do two at one place. One held line leaves the shift along it, the turn
about it and a growth, two that are parallel the shift along them, and two that meet the growth about the place where they meet.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose, hat, rotation_from_vector
from omnilines.geometry.line import PlueckerLines

OPEN = 1e-9
"""Motion of what is held, over that of the cameras, below which a similarity does not move it."""


@dataclass(frozen=True)
class Similarities:
    """Motions of a scene about an origin, as columns (w, v / unit, s)."""

    origin: Float[Tensor, "3"]
    unit_m: float
    columns: Float[Tensor, "7 g"]

    def by_step(self, poses: Pose) -> Float[Tensor, "f6 g"]:
        """What each does to the left perturbation of poses."""
        # World X' = X + w x X + v + s X: the pose turns by -R w and its centre moves by dC, which is -R dC in delta.
        turn, _, _ = self.columns.split([3, 3, 1])
        moved = self._motion(poses.centre)
        return -torch.cat([poses.rotation @ turn, poses.rotation @ moved], 1).flatten(0, 1)

    def after(self, much: Float[Tensor, " g"]) -> tuple[float, Pose]:
        """The finite one of which this is so much to first order: X' = s R X + t, as s and (R, t)."""
        turn, shift, growth = (self.columns @ much).split([3, 3, 1])
        scale, rotation = float(growth.exp()), rotation_from_vector(turn)
        return scale, Pose(rotation, self.origin + self.unit_m * shift - scale * (rotation @ self.origin))

    def _motion(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 g"]:
        """Of points of the world."""
        turn, shift, growth = self.columns.split([3, 3, 1])
        arm = points - self.origin
        return -hat(arm) @ turn + self.unit_m * shift + arm[..., None] * growth


def open_similarities(
    origin: Float[Tensor, "3"],
    unit_m: float,
    held_centres: Float[Tensor, "h 3"],
    held_lines: PlueckerLines,
    scale_known: bool,
) -> Float[Tensor, "7 g"]:
    """Columns (w, v / unit, s) that move nothing that is held; `unit_m` is the size of the scene."""
    eye = torch.eye(3, dtype=origin.dtype, device=origin.device)
    rows = [_by_similarity((held_centres - origin) / unit_m).flatten(0, 1)]
    if len(held_centres):
        rows.append(torch.cat([eye, origin.new_zeros(3, 4)], 1))
    if scale_known:
        rows.append(torch.nn.functional.one_hot(torch.tensor([6]), 7).to(eye))
    direction = held_lines.direction
    point = (held_lines.closest_point(origin.expand_as(direction)) - origin) / unit_m
    across = eye - direction[:, :, None] * direction[:, None, :]
    turned = torch.cat([-hat(direction), direction.new_zeros(len(direction), 3, 4)], -1)
    rows += [(across @ _by_similarity(point)).flatten(0, 1), turned.flatten(0, 1)]
    moved = torch.cat(rows)
    if not len(moved):
        return torch.eye(7, dtype=origin.dtype, device=origin.device)
    _, size, basis = torch.linalg.svd(torch.linalg.qr(torch.cat([moved, moved.new_zeros(7, 7)]), mode="r")[1])
    return basis[size <= OPEN].mT


def _by_similarity(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 7"]:
    """Motion of points by (w, v, s) about the origin: w x X + v + s X."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
    return torch.cat([-hat(points), eye, points[..., None]], -1)
