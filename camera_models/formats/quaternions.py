"""Rotations as the quaternions of files, written so that what is read back and written again does not change by a bit."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import quaternion_from_rotation, rotation_from_quaternion

_STEP = 2.0**-47


def file_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The unit quaternion (w, x, y, z), w >= 0, that stands in a file for any non-zero multiple of the one given.

    A quaternion made into a matrix and back moves by a few 1e-16, so files would change each time they are read and saved.
    Here three components are rounded to multiples of 2^-47 (7e-15, far above that error) and the largest follows from
    |q| = 1: `file_quaternion(quaternion_from_rotation(rotation_from_quaternion(q)))` is q again for every q of this form.
    The rotation moves by less than 3e-14 rad.
    """
    q = quaternion / quaternion.norm(dim=-1, keepdim=True)
    size = q.abs()
    # The first of those that are largest but for rounding, so that rounding does not choose between equal ones.
    largest = (size >= size.amax(-1, keepdim=True) - 1e-9).to(torch.int64).argmax(-1, keepdim=True)
    q = q * torch.where(torch.take_along_dim(q, largest, -1) < 0, -1.0, 1.0)
    rounded = ((q / _STEP).round() * _STEP).scatter(-1, largest, 0.0)
    dependent = (1 - (rounded * rounded).sum(-1, keepdim=True)).sqrt()
    rounded = rounded.scatter(-1, largest, dependent)
    # Adding 0.0 turns -0.0 into 0.0.
    return torch.where(_leads_negative(rounded), -rounded, rounded) + 0.0


def _leads_negative(q: Float[Tensor, "*batch 4"]) -> Bool[Tensor, "*batch 1"]:
    # q and -q are the same rotation: w > 0, or where w = 0 the first non-zero component > 0.
    first = (q != 0).to(torch.int64).argmax(-1, keepdim=True)
    return torch.take_along_dim(q, first, -1) < 0


def quaternion_for_file(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """The quaternion that is written for a rotation matrix."""
    return file_quaternion(quaternion_from_rotation(rotation))


def rotation_from_file(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation matrix of a quaternion (w, x, y, z) found in a file, of any length but zero."""
    return rotation_from_quaternion(file_quaternion(quaternion))
