"""Odd polynomials of the angle off axis, as fisheye models have them: r(theta) = theta (1 + k1 theta^2 + k2 theta^4 + ...)."""

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models._radial import first_sign_change, horner, invert_monotone
from camera_models.repeatable import least_squares

Terms = Sequence[Tensor] | Sequence[float]
"""k1, k2 and so on."""


def factor(k: Terms, t2: Tensor) -> Tensor:
    """r / theta of theta^2."""
    return 1 + t2 * horner(k, t2)


def slope(k: Terms, t2: Tensor) -> Tensor:
    """dr / dtheta of theta^2."""
    # Tensors or numbers: the checker takes what two sequences have in common for an object.
    return 1 + t2 * horner([term * (2 * i + 3) for i, term in enumerate(cast(Sequence[Tensor], k))], t2)


def curve(k: Terms, theta: Tensor) -> tuple[Tensor, Tensor]:
    """r and dr / dtheta."""
    t2 = theta * theta
    return theta * factor(k, t2), slope(k, t2)


def grows_until(k: Sequence[float]) -> float:
    """The first theta with dr / dtheta = 0, or pi."""
    slopes = np.array([1.0, *((2 * i + 3) * term for i, term in enumerate(k))])
    return math.sqrt(min(first_sign_change(slopes, 1.0), math.pi**2))


def clamped(theta: Tensor, ratio: Tensor, largest: float) -> tuple[Tensor, Tensor, Tensor]:
    """theta and theta / s drawn back to the largest angle where beyond it, and where they are not."""
    valid = theta < largest if largest >= math.pi else theta <= largest
    used = torch.where(valid, theta, torch.full_like(theta, largest))
    return used, torch.where(valid, ratio, used * ratio / theta.clamp_min(1e-300)), valid


def scale_of(points: Float[Tensor, "*batch 3"], k: Terms, theta: Tensor, ratio: Tensor, valid: Tensor) -> Tensor:
    """r / s, which takes (x, y) of a point to the plane of the image; differentiable on the axis too."""
    s2 = (points[..., :2] ** 2).sum(-1)
    # theta^2 = ratio^2 s2 keeps the gradient on the axis; beyond the largest angle the clamped angle is a constant.
    t2 = torch.where(valid, ratio**2 * s2, theta * theta)
    return ratio * factor(k, t2)


class Slopes(NamedTuple):
    """With g = r / s, s = hypot(x, y), n = |point|: d g / d x = x by_s, d g / d y = y by_s, d g / d z = -over."""

    g: Tensor
    by_s: Tensor
    over: Tensor


def slopes_of(points: Float[Tensor, "*batch 3"], k: Sequence[float], theta: Tensor, ratio: Tensor) -> Slopes:
    """d g / d s = (r' z / n^2 - g) / s and d g / d z = -r' / n^2."""
    x, y, z = points.unbind(-1)
    s2 = x * x + y * y
    n2 = s2 + z * z
    t2 = theta * theta
    growth = slope(k, t2)
    g = ratio * factor(k, t2)
    over = growth / n2.clamp_min(1e-300)
    by_s = torch.where(s2 > 0, (over * z - g) / s2.clamp_min(1e-300), 0.0)
    return Slopes(g, by_s, over)


def bearings_of_plane(
    plane: Float[Tensor, "*batch 2"], k: Float[Tensor, " k"], largest: float
) -> tuple[Float[Tensor, "*batch 3"], Tensor]:
    """Unit bearings of points of the plane, and which lie within r of the largest angle; differentiable."""
    r2 = (plane**2).sum(-1)
    zero = r2 == 0
    r = torch.where(zero, torch.ones_like(r2), r2).sqrt()
    radius = torch.where(zero, torch.zeros_like(r), r)
    with torch.no_grad():
        numbers = k.tolist()
        theta = invert_monotone(lambda angle: curve(numbers, angle), radius, largest)
        limit, _ = curve(numbers, torch.tensor(largest, dtype=r.dtype, device=r.device))
    # One more Newton step with gradients: the implicit-function theorem, exact at the solution.
    value, growth = curve(k.unbind(), theta)
    valid = (radius <= limit) if largest < math.pi else (radius < limit)
    # At the rim the slope is zero: there the solution itself is kept and carries no gradient.
    step = torch.where(valid & (growth > 1e-12), (value - radius) / growth.detach().clamp_min(1e-12), torch.zeros_like(value))
    theta = theta - step
    sin_over_r = torch.where(zero, torch.ones_like(r), torch.sin(theta) / r)
    return torch.cat([plane * sin_over_r[..., None], torch.cos(theta)[..., None]], -1), valid


def nearest_terms(rho_px: Float[Tensor, " n"], theta: Float[Tensor, " n"], count: int) -> tuple[float, list[float]]:
    """f and k1 ... k_count by least squares, of as high a degree as keeps the curve growing over the samples."""
    top = float(theta.max())
    for terms in range(count + 1, 0, -1):
        powers = theta[:, None] ** (2 * torch.arange(terms, dtype=theta.dtype) + 1)
        scale = powers.norm(dim=0)
        solution = least_squares(powers / scale, rho_px[:, None])[:, 0] / scale
        f = float(solution[0])
        if f > 0:
            k = [*(solution[1:] / f).tolist(), *([0.0] * count)][:count]
            if grows_until(k) > 1.02 * top:
                return f, k
    return float((rho_px * theta).sum() / (theta * theta).sum()), [0.0] * count
