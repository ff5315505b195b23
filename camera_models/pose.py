"""Rigid motions SE(3), batched. `a_from_b @ b_from_c` is `a_from_c`."""

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import Array, array_function, as_tensor, vectors
from camera_models.errors import InputError
from camera_models.typed import require_fields

ROUNDED = 1e-4
"""By which the rows of a rotation may be off, as they are where its numbers are rounded."""


def hat(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix [v]x with [v]x w = v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _exponential_factors(w: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of a = |w|, each (*batch, 1, 1); smooth at 0, where series are exact."""
    a2 = (w * w).sum(-1)[..., None, None]
    small = a2 < 1e-3
    a = torch.where(small, torch.ones_like(a2), a2).sqrt()
    sine = torch.sin(a) / a
    first = torch.where(small, 1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42)), sine)
    second = torch.where(small, 0.5 - a2 / 24 * (1 - a2 / 30 * (1 - a2 / 56)), 2 * (torch.sin(0.5 * a) / a) ** 2)
    third = torch.where(small, 1 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72)), (1 - sine) / a**2)
    return first, second, third


def rotation_from_vector(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """exp([w]x): the rotation by |w| radians about w (Rodrigues' formula)."""
    first, second, _ = _exponential_factors(w)
    h = hat(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + first * h + second * (h @ h)


def quaternion_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z), Hamilton, w >= 0. Stable at every angle: the largest of four equivalent forms is taken."""
    m = rotation
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    d = m.diagonal(dim1=-2, dim2=-1)
    anti = torch.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    symmetric = m + m.mT
    # Row k holds 4 q_k q for k = w, x, y, z.
    rows = torch.cat(
        [
            torch.cat([(1 + trace)[..., None], anti], -1)[..., None, :],
            torch.cat(
                [
                    anti[..., :, None],
                    symmetric - torch.diag_embed(2 * d) + torch.diag_embed(1 + 2 * d - trace[..., None]),
                ],
                -1,
            ),
        ],
        -2,
    )
    best = torch.argmax(rows.diagonal(dim1=-2, dim2=-1), -1)
    row = torch.take_along_dim(rows, best[..., None, None].expand(*best.shape, 1, 4), -2).squeeze(-2)
    q = row / row.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z), which is normalised first."""
    q = quaternion / quaternion.norm(dim=-1, keepdim=True)
    w, v = q[..., 0, None, None], q[..., 1:]
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    return eye * (2 * w * w - 1) + 2 * v[..., :, None] * v[..., None, :] + 2 * w * hat(v)


def vector_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The rotation vector w, |w| <= pi, with exp([w]x) the rotation."""
    q = quaternion_from_rotation(rotation)
    w, v = q[..., :1], q[..., 1:]
    s = v.norm(dim=-1, keepdim=True)
    scale = torch.where(s < 1e-12, 2.0 / w.clamp_min(1e-300), 2.0 * torch.atan2(s, w) / s.clamp_min(1e-300))
    return scale * v


@dataclass(frozen=True)
class Pose:
    """One rigid motion or a batch of them: X_a = rotation X_b + translation, translation in metres.

    Tensors are taken as they are, unchecked, since inner loops make poses. `Pose.of` takes arrays of any kind and refuses what is
    no rotation, as tables and files of poses do.
    """

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]

    @staticmethod
    def of(rotation: Array | list[Any], translation: Array | list[Any]) -> "Pose":
        """A pose from arrays of any kind. Raises InputError where they are no rotations (rows orthonormal to 1e-4, right-handed)
        and as many translations."""
        r = as_tensor(rotation)
        t = as_tensor(translation, like=r)
        if r.shape[-2:] != (3, 3) or t.shape != r.shape[:-1]:
            raise InputError(
                f"Rotations (..., 3, 3) and as many translations (..., 3) were expected, found {tuple(r.shape)} and "
                f"{tuple(t.shape)}; correct them."
            )
        pose = Pose(r, t)
        pose.require_rigid()
        return pose

    def require_rigid(self) -> None:
        """Raises InputError where a rotation is none, or a number is not finite."""
        require_fields(self)
        off = (self.rotation @ self.rotation.mT - torch.eye(3, dtype=self.rotation.dtype, device=self.rotation.device)).abs()
        wrong = ~((off.amax((-2, -1)) <= ROUNDED) & (torch.linalg.det(self.rotation) > 0))
        if bool(wrong.any()):
            rows = self.rotation[wrong][0].tolist()
            raise InputError(
                "A rotation was expected as a matrix whose rows are orthonormal and right-handed, found "
                f"{[[round(value, 4) for value in row] for row in rows]}; correct it."
            )
        if not bool(self.translation.isfinite().all()):
            raise InputError("A translation was expected of finite numbers, found one that is not; correct it.")

    @staticmethod
    def identity(*batch: int) -> "Pose":
        """Identity poses of the given batch shape."""
        return Pose(torch.eye(3, dtype=torch.float64).expand(*batch, 3, 3).clone(), torch.zeros(*batch, 3, dtype=torch.float64))

    @staticmethod
    def exp(delta: Float[Array, "*batch 6"] | list[Any]) -> "Pose":
        """Exponential of a twist delta = (rotation_rad, translation_m); exp(delta) @ T is the left perturbation of T.

        Raises InputError where it is none.
        """
        delta = vectors(as_tensor(delta), 6, "Twists")
        w = delta[..., :3]
        first, second, third = _exponential_factors(w)
        h = hat(w)
        h2 = h @ h
        eye = torch.eye(3, dtype=w.dtype, device=w.device)
        across = eye + second * h + third * h2
        return Pose(eye + first * h + second * h2, (across @ delta[..., 3:, None])[..., 0])

    def log(self) -> Float[Tensor, "*batch 6"]:
        """The twist with exp(twist) this pose; rotation angle at most pi."""
        w = vector_from_rotation(self.rotation)
        angle2 = (w * w).sum(-1)[..., None, None]
        small = angle2 < 1e-6
        safe = torch.where(small, torch.ones_like(angle2), angle2)
        angle = safe.sqrt()
        # Inverse of the left Jacobian: I - [w]x / 2 + c [w]x^2, c = (1 - (a/2) cot(a/2)) / a^2.
        c = torch.where(small, 1 / 12 + angle2 / 720, (1 - 0.5 * angle / torch.tan(0.5 * angle)) / safe)
        h = hat(w)
        inverse = torch.eye(3, dtype=w.dtype, device=w.device) - 0.5 * h + c * (h @ h)
        return torch.cat([w, (inverse @ self.translation[..., None]).squeeze(-1)], -1)

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.rotation @ other.rotation, self._moved(other.translation[..., None, :]).squeeze(-2))

    def inverse(self) -> "Pose":
        """b_from_a of a_from_b."""
        r = self.rotation.mT
        return Pose(r, -(r @ self.translation[..., None]).squeeze(-1))

    @overload
    def transform(self, points: Tensor) -> Tensor: ...

    @overload
    def transform(self, points: np.ndarray | list[Any]) -> np.ndarray: ...

    @array_function
    def transform(self, points: Float[Array, "*points_batch n 3"] | list[Any]) -> Float[Array, "*out_batch n 3"]:
        """The points (a set of n per pose) in the frame on the left. Raises InputError where they are none."""
        return self._moved(vectors(points, 3, "Points").to(self.rotation))

    def _moved(self, points: Float[Tensor, "*points_batch n 3"]) -> Float[Tensor, "*out_batch n 3"]:
        return points @ self.rotation.mT + self.translation[..., None, :]

    @property
    def centre(self) -> Float[Tensor, "*batch 3"]:
        """Origin of the left frame in the right one: the camera centre C of a `cam_from_world`, t = -R C."""
        return -(self.rotation.mT @ self.translation[..., None]).squeeze(-1)

    def after_similarity(self, scale: float, motion: "Pose") -> "Pose":
        """The same cameras where the world is X' = s R X + t, `motion` being (R, t)."""
        rotation = self.rotation @ motion.rotation.mT
        centre = scale * (self.centre @ motion.rotation.mT) + motion.translation
        return Pose(rotation, -(rotation @ centre[..., None])[..., 0])

    @property
    def quaternion(self) -> Float[Tensor, "*batch 4"]:
        """Unit quaternion (w, x, y, z) of the rotation, w >= 0."""
        return quaternion_from_rotation(self.rotation)

    @property
    def is_single(self) -> bool:
        """Whether this is one pose, not a batch."""
        return self.rotation.dim() == 2

    def __getitem__(self, index: Any) -> "Pose":
        if self.is_single and index is not None:
            raise InputError("A batch of poses was expected where one is picked, found a single pose; use it as it is.")
        return Pose(self.rotation[index], self.translation[index])

    def __len__(self) -> int:
        if self.is_single:
            raise TypeError("A batch of poses was expected where poses are counted, found a single pose; pose[None] is a batch.")
        return self.rotation.shape[0]

    @staticmethod
    def stack(poses: "list[Pose]") -> "Pose":
        """A batch of single poses."""
        return Pose(torch.stack([p.rotation for p in poses]), torch.stack([p.translation for p in poses]))


def adjoint(pose: Pose) -> Float[Tensor, "*batch 6 6"]:
    """Ad with T exp(delta) = exp(Ad delta) T for delta = (rotation_rad, translation_m)."""
    rotation = pose.rotation
    lower = torch.cat([hat(pose.translation) @ rotation, rotation], -1)
    return torch.cat([torch.cat([rotation, torch.zeros_like(rotation)], -1), lower], -2)
