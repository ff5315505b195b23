"""Bearings, great circles, arcs and sectors on the Gaussian sphere (design section 5; Srestasathiern 2012, section 4.3).

Angles come from atan2 of a cross and a dot product, so they keep their relative accuracy near 0 and near pi.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import array_function

SERIES_BELOW_RAD = 0.03
"""Below this arc angle phi - sin(phi) cos(phi) is summed as a series; four terms are exact to double precision there."""


def _cross(v1: Tensor, v2: Tensor) -> Tensor:
    """v1 x v2 of unit vectors. Subtracting +-v1 from v2 first keeps the digits of arcs near 0 and near a half turn."""
    sign = torch.where((v1 * v2).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(v1.dtype)
    return torch.linalg.cross(v1, v2 - sign * v1)


@array_function
def angle_between(v1: Float[Tensor, "*batch1 3"], v2: Float[Tensor, "*batch2 3"]) -> Float[Tensor, "*batch"]:
    """Angle (rad, in [0, pi]) between unit bearings: atan2(|V1 x V2|, V1 . V2). It is the angle phi of the arc between them."""
    v1, v2 = torch.broadcast_tensors(v1, v2)
    return torch.atan2(_cross(v1, v2).norm(dim=-1), (v1 * v2).sum(-1))


@array_function
def arc_normal(v1: Float[Tensor, "*batch 3"], v2: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit normal of the interpretation plane of an arc, N = V1 x V2 / |V1 x V2| (4.5).

    Equal or opposite bearings define no plane: their normal is the zero vector.
    """
    normal = _cross(v1, v2)
    length = normal.norm(dim=-1, keepdim=True)
    return normal / torch.where(length > 0, length, torch.ones_like(length))


@array_function
def points_on_arc(
    v1: Float[Tensor, "*batch 3"], v2: Float[Tensor, "*batch 3"], fractions: Float[Tensor, " k"]
) -> Float[Tensor, "*batch k 3"]:
    """Bearings at fractions of the way along arcs: V(theta) = a cos(theta) + b sin(theta), theta = fraction phi (4.7)."""
    normal = _cross(v1, v2)
    sine = normal.norm(dim=-1, keepdim=True)
    b = torch.linalg.cross(normal / torch.where(sine > 0, sine, torch.ones_like(sine)), v1)
    theta = (torch.atan2(sine, (v1 * v2).sum(-1, keepdim=True)) * fractions)[..., None]
    return v1[..., None, :] * torch.cos(theta) + b[..., None, :] * torch.sin(theta)


@array_function
def distance_to_great_circle(
    bearings: Float[Tensor, "*batch1 3"], normals: Float[Tensor, "*batch2 3"]
) -> Float[Tensor, "*batch"]:
    """Signed angle (rad, in [-pi/2, pi/2]) of bearings from great circles, positive on the normal's side; batches broadcast."""
    normals, bearings = torch.broadcast_tensors(normals, bearings)
    return torch.atan2((normals * bearings).sum(-1), torch.linalg.cross(normals, bearings).norm(dim=-1))


@array_function
def sector_moment_factor(v1: Float[Tensor, "*batch 3"], v2: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """F with F'F = D, the second moment of the boundary of the sector O V1 V2 (4.11 to 4.14).

    With a = V1, b the unit tangent towards V2 and phi the arc angle,

        D = (V1 V1' + V2 V2') / 3 + a a' (phi/2 + sin 2phi / 4) + b b' (phi/2 - sin 2phi / 4) + (a b' + b a') sin^2(phi) / 2

    has rank 2 in span(a, b), and F is its closed-form 2x2 Cholesky factor there. Written with sin(phi) b = V2 - cos(phi) V1,
    which is smooth where b is not, it is finite with finite gradients at phi = 0, where its second row vanishes. For phi < pi.
    """
    cosine = (v1 * v2).sum(-1)
    normal = _cross(v1, v2)
    sine = normal.norm(dim=-1)
    phi = torch.atan2(sine, cosine)
    across = torch.linalg.cross(normal, v1)
    d11 = (1 + cosine**2) / 3 + (phi + sine * cosine) / 2
    d12_over_sine = cosine / 3 + sine / 2
    small = phi < SERIES_BELOW_RAD
    # (phi - sin cos) / (2 sin^2), by series where the difference cancels; 1e-8 keeps the antipodal pair finite.
    square = phi * phi
    series = phi * (1 / 3 + square * (2 / 45 + square * (2 / 315 + square * 4 / 4725)))
    safe_sine = torch.where(small, torch.ones_like(sine), sine.clamp_min(1e-8))
    ratio = torch.where(small, series, (phi - sine * cosine) / (2 * safe_sine**2))
    schur_over_sine2 = 1 / 3 + ratio - d12_over_sine**2 / d11
    first = d11.sqrt()[..., None] * v1 + (d12_over_sine / d11.sqrt())[..., None] * across
    return torch.stack([first, schur_over_sine2.sqrt()[..., None] * across], -2)
