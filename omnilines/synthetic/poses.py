"""Poses that are off by known amounts."""

import math

import numpy as np
import torch
from torch import Tensor

from camera_models.pose import Pose


def perturbed_poses(cam_from_world: Pose, angle_deg: float, shift_m: float, seed: int) -> Pose:
    """Cameras turned about random axes through their centres and shifted in random directions, by fixed amounts."""
    rng = np.random.default_rng(seed)
    random = torch.as_tensor(rng.standard_normal((2, len(cam_from_world), 3)))
    axis, direction = (random / random.norm(dim=-1, keepdim=True)).unbind(0)
    turn = Pose.exp(torch.cat([math.radians(angle_deg) * axis, torch.zeros_like(axis)], -1)).rotation
    rotation = turn @ cam_from_world.rotation
    centre: Tensor = cam_from_world.centre + shift_m * direction
    return Pose(rotation, -(rotation @ centre[..., None])[..., 0])
