"""Rotations that fit matrices, other rotations, directions and points best, by the singular value decomposition.

Of all rotations R that of the largest tr(R' M) is U diag(1, 1, det U det V') V' with M = U S V': the one nearest to M (W. Kabsch,
Acta Crystallographica A32, 1976). Means, common rotations and similarities are that of a sum.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import Array, array_function, as_tensor
from camera_models.errors import GeometryError
from camera_models.pose import Pose

_ON_ONE_LINE = 1e-12
"""Second singular value over the first below which a rotation about one axis is free."""


def _decomposed(matrix: Float[Tensor, "*batch 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest rotation, and the singular values of the matrix with the sign that the rotation gives each."""
    u, singular, vt = torch.linalg.svd(matrix)
    sign = torch.ones_like(singular)
    sign[..., 2] = torch.linalg.det(u) * torch.linalg.det(vt)
    return (u * sign[..., None, :]) @ vt, singular, sign


def nearest_rotation(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation with the least sum of squared differences from a matrix; never a reflection."""
    return _decomposed(matrix)[0]


def mean_rotation(
    rotations: Float[Tensor, "*batch n 3 3"], weight: Float[Tensor, "*batch n"] | None = None
) -> Float[Tensor, "*batch 3 3"]:
    """The rotation with the least (weighted) sum of squared differences from others, the chordal mean."""
    return nearest_rotation((rotations if weight is None else rotations * weight[..., None, None]).sum(-3))


@array_function
def common_rotation(source: Float[Tensor, "*batch n 3"], target: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation R that minimises sum |target - R source|^2 over corresponding bearings (Kabsch 1976).

    Raises GeometryError where the bearings lie (nearly) on one axis, which leaves the rotation about it free.
    """
    rotation, singular, _ = _decomposed(target.mT @ source)
    if bool((singular[..., 1] <= _ON_ONE_LINE * singular[..., 0]).any()):
        raise GeometryError(
            "The common rotation of two sets of bearings needs at least two that are not parallel, found all on one axis; "
            "give bearings spread over the image."
        )
    return rotation


def similarity_alignment(
    source: Float[Array, "*batch n 3"], target: Float[Array, "*batch n 3"]
) -> tuple[Float[Tensor, "*batch"], Pose]:
    """Scale s and pose (R, t) that minimise sum |target - (s R source + t)|^2 (Umeyama 1991); no reflection.

    The aligned points are `pose.transform(scale[..., None, None] * source)`. Raises GeometryError where the points of either set
    lie on one line or coincide, which leaves the rotation free.
    """
    a = as_tensor(source)
    b = as_tensor(target, like=a)
    mean_a, mean_b = a.mean(-2, keepdim=True), b.mean(-2, keepdim=True)
    spread = a - mean_a
    rotation, singular, sign = _decomposed((b - mean_b).mT @ spread)
    if bool((singular[..., 1] <= _ON_ONE_LINE * singular[..., 0]).any()):
        raise GeometryError(
            "A similarity alignment needs points that do not lie on one line, found collinear or coinciding points; "
            "give at least three points that span a plane."
        )
    scale = (singular * sign).sum(-1) / (spread * spread).sum((-2, -1))
    translation = mean_b.squeeze(-2) - scale[..., None] * (rotation @ mean_a.mT).squeeze(-1)
    return scale, Pose(rotation, translation)
