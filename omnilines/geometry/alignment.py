"""The similarity that takes one set of points to another: bearings alone leave scale, position and orientation free."""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import Array, as_tensor
from camera_models.errors import GeometryError
from camera_models.pose import Pose


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
    u, singular, vt = torch.linalg.svd((b - mean_b).mT @ spread)
    if bool((singular[..., 1] <= 1e-12 * singular[..., 0]).any()):
        raise GeometryError(
            "A similarity alignment needs points that do not lie on one line, found collinear or coinciding points; "
            "give at least three points that span a plane."
        )
    sign = torch.ones_like(singular)
    sign[..., 2] = torch.linalg.det(u) * torch.linalg.det(vt)
    rotation = (u * sign[..., None, :]) @ vt
    scale = (singular * sign).sum(-1) / (spread * spread).sum((-2, -1))
    translation = mean_b.squeeze(-2) - scale[..., None] * (rotation @ mean_a.mT).squeeze(-1)
    return scale, Pose(rotation, translation)
