"""Poses as files of other tools write them: matrices, rotation vectors, quaternions in either order."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models.errors import InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.formats.quaternions import quaternion_for_file, rotation_from_file
from camera_models.formats.values import LARGEST, numbers
from camera_models.pose import Pose, rotation_from_vector, vector_from_rotation
from camera_models.rotations import nearest_rotation

EXACT = 1e-12
"""Deviation of R R' from I up to which a matrix is taken as it stands; beyond, the nearest rotation is."""
ROUNDED = 1e-2
"""Deviation up to which it is a rotation written with few digits."""


def rotation_of_matrix(matrix: Float[np.ndarray, "3 3"], where: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that a matrix of a file stands for; raises InputError where it is none."""
    # The entries of a rotation are 1 at most: squares of larger ones may be beyond numbers.
    largest = float(np.abs(matrix).max())
    off = largest if not largest <= 1.0 + ROUNDED else float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not off <= ROUNDED or np.linalg.det(matrix) < 0:
        raise InputError(
            f"The rotation of {where} must be orthonormal and right-handed, found one that is off by {off:.2g}; correct it."
        )
    return matrix if off <= EXACT else nearest_rotation(torch.as_tensor(matrix)).numpy()


def pose_of_matrix(value: Any, where: str) -> Pose:
    """The pose of 4 x 4 nested lists."""
    matrix = numbers(value, (4, 4), where)
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > EXACT:
        raise InputError(
            f"The last row of {where} must be 0 0 0 1, found {' '.join(f'{item:g}' for item in matrix[3])}; correct it."
        )
    return Pose.of(rotation_of_matrix(matrix[:3, :3], where), matrix[:3, 3])


def matrix_of_pose(pose: Pose) -> list[list[float]]:
    """4 x 4 nested lists."""
    top = torch.cat([pose.rotation, pose.translation[:, None]], -1).detach().tolist()
    return [*top, [0.0, 0.0, 0.0, 1.0]]


def pose_of_quaternion(wxyz: list[float], translation: list[float], where: str) -> Pose:
    """The pose of a quaternion (w, x, y, z) of any length but zero."""
    if not all(abs(item) <= LARGEST for item in (*wxyz, *translation)):
        raise InputError(f"The pose of {where} must hold finite numbers within reason, found others; correct it.")
    quaternion = torch.tensor(wxyz, dtype=torch.float64)
    if not float(quaternion.norm()) > EXACT:
        raise InputError(f"The quaternion of {where} must be a unit one, found one of length zero; correct it.")
    return Pose(rotation_from_file(quaternion), torch.tensor(translation, dtype=torch.float64))


def quaternion_of_pose(pose: Pose) -> list[float]:
    """(w, x, y, z), w >= 0."""
    quaternion: list[float] = quaternion_for_file(pose.rotation.detach()).tolist()
    return quaternion


def pose_of_vectors(rotation: list[float], translation: list[float]) -> Pose:
    """The pose of a rotation vector (rad) and a translation."""
    return Pose(rotation_from_vector(torch.tensor(rotation, dtype=torch.float64)), torch.tensor(translation, dtype=torch.float64))


def vectors_of_pose(pose: Pose) -> tuple[list[float], list[float]]:
    """The rotation vector (rad) and the translation."""
    return vector_from_rotation(pose.rotation.detach()).tolist(), pose.translation.detach().tolist()


def rig_of(poses: dict[str, Pose]) -> dict[str, RigCamera]:
    """The rig of cam_from_rig by camera."""
    return {name: RigCamera(pose) for name, pose in poses.items()}
