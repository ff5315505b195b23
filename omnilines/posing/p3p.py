"""The perspective-three-point problem on bearings: all poses that see three points along three rays, in batches.

J. A. Grunert, Das Pothenotische Problem in erweiterter Gestalt, 1841, in the form of R. M. Haralick et al., Review and analysis
of solutions of the three point perspective pose estimation problem, IJCV 1994. Distances s_i > 0 along unit bearings j_i satisfy
s_i^2 + s_k^2 - 2 s_i s_k j_i . j_k = |P_i - P_k|^2; with s_2 = u s_1 and s_3 = v s_1 a quartic in v remains. Nothing asks for
z > 0, so rays beyond 90 degrees off axis are as good as any.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose

_REAL = 1e-4
"""Imaginary part up to which a root counts as real: double roots split into complex pairs by rounding."""


def _quartic(bearings: Float[Tensor, "n 3 3"], square: Float[Tensor, "n 3"]) -> Float[Tensor, "n 5"]:
    """Coefficients of v^4 ... v^0; `square` holds a^2, b^2, c^2, opposite to points 1, 2, 3."""
    a2, b2, c2 = square.unbind(-1)
    j1, j2, j3 = bearings.unbind(-2)
    alpha, beta, gamma = (j2 * j3).sum(-1), (j1 * j3).sum(-1), (j1 * j2).sum(-1)
    difference, total = (a2 - c2) / b2, (a2 + c2) / b2
    return torch.stack(
        [
            (difference - 1) ** 2 - 4 * c2 / b2 * alpha**2,
            4 * (difference * (1 - difference) * beta - (1 - total) * alpha * gamma + 2 * c2 / b2 * alpha**2 * beta),
            2
            * (
                difference**2
                - 1
                + 2 * difference**2 * beta**2
                + 2 * (b2 - c2) / b2 * alpha**2
                - 4 * total * alpha * beta * gamma
                + 2 * (b2 - a2) / b2 * gamma**2
            ),
            4 * (-difference * (1 + difference) * beta + 2 * a2 / b2 * gamma**2 * beta - (1 - total) * alpha * gamma),
            (1 + difference) ** 2 - 4 * a2 / b2 * gamma**2,
        ],
        -1,
    )


def _roots(coefficients: Float[Tensor, "n 5"]) -> tuple[Float[Tensor, "n 4"], Bool[Tensor, "n 4"]]:
    """Roots as eigenvalues of the companion matrix, and which are real and positive."""
    leading = coefficients[:, :1]
    sound = (leading.abs() > 1e-12 * coefficients.abs().amax(-1, keepdim=True)) & torch.isfinite(coefficients).all(
        -1, keepdim=True
    )
    monic = torch.where(sound, coefficients[:, 1:] / torch.where(sound, leading, torch.ones_like(leading)), 0.0)
    companion = torch.zeros(len(monic), 4, 4, dtype=monic.dtype)
    companion[:, 0] = -monic
    companion[:, torch.arange(1, 4), torch.arange(3)] = 1.0
    roots = torch.linalg.eigvals(companion)
    real = sound & (roots.imag.abs() <= _REAL * roots.abs()) & (roots.real > 0)
    return torch.where(real, roots.real, torch.ones_like(roots.real)), real


def _frame(points: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3 3"]:
    """Orthonormal columns fixed to triangles (rows are corners)."""
    first = points[..., 1, :] - points[..., 0, :]
    normal = torch.linalg.cross(first, points[..., 2, :] - points[..., 0, :])
    first = first / first.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    return torch.stack([first, torch.linalg.cross(normal, first), normal], -1)


def p3p(bearings: Float[Tensor, "n 3 3"], points: Float[Tensor, "n 3 3"]) -> tuple[Pose, Bool[Tensor, " n4"]]:
    """Up to four poses cam_from_world of each triple of unit bearings and world points (rows), and which of them are solutions.

    The poses (4 n,) of a triple follow one another. Triples on a line have none.
    """
    p1, p2, p3 = points.unbind(-2)
    square = torch.stack([(p2 - p3).square().sum(-1), (p1 - p3).square().sum(-1), (p1 - p2).square().sum(-1)], -1)
    area = torch.linalg.cross(p2 - p1, p3 - p1).norm(dim=-1)
    spread = area > 1e-9 * square.amax(-1)
    a2, b2, c2 = torch.where(spread[:, None], square, torch.ones_like(square))[:, None].unbind(-1)
    v, real = _roots(_quartic(bearings, torch.cat([a2, b2, c2], -1)))
    j1, j2, j3 = bearings.unbind(-2)
    alpha, beta, gamma = ((x * y).sum(-1)[:, None] for x, y in ((j2, j3), (j1, j3), (j1, j2)))
    difference = (a2 - c2) / b2
    below = 2 * (gamma - v * alpha)
    finite = below.abs() > 1e-12
    u = ((difference - 1) * v**2 - 2 * difference * beta * v + 1 + difference) / torch.where(
        finite, below, torch.ones_like(below)
    )
    s1 = (b2 / (1 + v**2 - 2 * v * beta).clamp_min(1e-300)).sqrt()
    depth = torch.stack([s1, u * s1, v * s1], -1)
    found = real & finite & (u > 0) & spread[:, None] & torch.isfinite(depth).all(-1)
    depth = torch.where(found[..., None], depth, torch.ones_like(depth))
    seen = depth[..., None] * bearings[:, None]
    rotation = _frame(seen) @ _frame(points)[:, None].mT
    translation = seen.mean(-2) - (rotation @ points.mean(-2)[:, None, :, None])[..., 0]
    return Pose(rotation.flatten(0, 1), translation.flatten(0, 1)), found.flatten()
