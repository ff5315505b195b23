"""The angle between where a point should be seen and where it is, on the whole sphere, and its derivatives.

With b the observed bearing, P (2x3) rows across it and v = X / |X| the direction of the point in the camera,

    r = 2 P v / (1 + b . v),    |r| = 2 tan(angle / 2) for orthonormal rows: the angle to second order

is smooth everywhere but opposite to b, where it grows without bound: no point behind a camera passes for one before it.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.kernels.point import NEAREST_OPPOSITE


def across(bearings: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 3"]:
    """Two orthonormal rows across each unit bearing."""
    helper = torch.nn.functional.one_hot(bearings.abs().argmin(-1), 3).to(bearings.dtype)
    first = torch.linalg.cross(bearings, helper)
    first = first / first.norm(dim=-1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(bearings, first)], -2)


def bearing_residual(
    bearings: Float[Tensor, "n 3"], rows: Float[Tensor, "n 2 3"], seen: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
    """r and d r / d X of points X in the camera frame; `rows` P are across the bearings, divided by standard deviations."""
    length = seen.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    v = seen / length
    beyond = (1.0 + (bearings * v).sum(-1, keepdim=True)).clamp_min(NEAREST_OPPOSITE)
    r = 2.0 * (rows @ v[..., None])[..., 0] / beyond
    by_direction = 2.0 * rows / beyond[..., None] - r[..., None] * (bearings / beyond)[:, None, :]
    along = (by_direction @ v[..., None]) * v[:, None, :]
    return r, (by_direction - along) / length[..., None]


def placed(pose: Pose, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """One point for each pose, in its left frame."""
    return (pose.rotation @ points[..., None])[..., 0] + pose.translation


def near_epipolar_arc(
    a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"], b_from_a: Pose, limit_rad: float | Float[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Whether each bearing of camera b is within an angle of the arc in which b sees the ray of a: from where the ray goes to, at
    infinity, to camera a itself. On the rest of its circle the two meet behind a camera."""
    ray = a @ b_from_a.rotation.mT
    start = (b_from_a.translation / b_from_a.translation.norm().clamp_min(1e-300)).expand_as(a)
    normal = torch.linalg.cross(ray, start)
    limit = limit_rad * normal.norm(dim=-1).clamp_min(1e-300)
    by_ray, by_start, between = (b * ray).sum(-1), (b * start).sum(-1), (ray * start).sum(-1)
    beyond = torch.minimum(by_start - by_ray * between, by_ray - by_start * between)
    return ((normal * b).sum(-1).abs() < limit) & (beyond > -limit)
