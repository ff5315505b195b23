"""Decentring and thin prism terms on the plane of an image: values, the disc on which they are one-to-one, their inverse.

With d = (x, y), r = |d|, p = (p0, p1), a = (s0, s2), b = (s1, s3):

    T(d) = d + 2 (p . d) d + r^2 p + r^2 a + r^4 b
    J(d) = (1 + 2 p . d) I + 2 d p' + w d',    w = 2 p + 2 a + 4 r^2 b

T is one-to-one on a disc where the symmetric part of J is positive definite: (T(d) - T(e)) . (d - e) is then above zero. The
least eigenvalue of that at the radius r is 1 - r (|2 p + m| + |m|) in the worst direction, m = p + w / 2.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._disc import damped_newton
from camera_models._radial import CHUNK

PLAIN_STEPS = 3
"""Of Newton's on all points, which bring terms of the size that lenses have to rounding."""
LAST_STEP = 1e-8
"""Of the plain ones, relative to 1 + the radius, after which the error, quadratic in it, is one of rounding."""
FURTHEST = 1e75
"""Radius whose fourth power is a number."""
STEPS_TO_ROOT = 200
"""Of Newton on a convex cubic: more than any takes."""

Terms = Sequence[Tensor] | Sequence[float]
"""p0 p1 s0 s1 s2 s3."""


class Plane(NamedTuple):
    """T(d), and J = [[xx, xy], [yx, yy]], each with its own column."""

    x: Tensor
    y: Tensor
    xx: Tensor
    xy: Tensor
    yx: Tensor
    yy: Tensor


def displaced(terms: Terms, x: Tensor, y: Tensor) -> Plane:
    """T and J at points (x, y); differentiable in all."""
    p0, p1, s0, s1, s2, s3 = terms
    r2 = x * x + y * y
    along = 1 + 2 * (p0 * x + p1 * y)
    across_x, across_y = p0 + s0 + s1 * r2, p1 + s2 + s3 * r2
    # w / 2
    wx, wy = across_x + s1 * r2, across_y + s3 * r2
    return Plane(
        x=along * x + r2 * across_x,
        y=along * y + r2 * across_y,
        xx=along + 2 * x * (p0 + wx),
        xy=2 * (x * p1 + y * wx),
        yx=2 * (y * p0 + x * wy),
        yy=along + 2 * y * (p1 + wy),
    )


def one_to_one_until(terms: Sequence[float]) -> float:
    """A radius of the plane up to which T is one-to-one; infinite without terms, zero where they are no numbers.

    |2 p + m| + |m| is at most |4 p + a| + |2 p + a| + 4 r^2 |b|: the radius is the root of a cubic that grows.
    """
    p0, p1, s0, s1, s2, s3 = terms
    linear = math.hypot(4 * p0 + s0, 4 * p1 + s2) + math.hypot(2 * p0 + s0, 2 * p1 + s2)
    cubic = 4 * math.hypot(s1, s3)
    if linear == cubic == 0:
        return math.inf
    if not math.isfinite(linear + cubic):
        return 0.0
    # From the right of the root of a convex function that grows, Newton's steps go down to it.
    radius = min(1 / linear if linear > 0 else math.inf, cubic ** (-1 / 3) if cubic > 0 else math.inf)
    for _ in range(STEPS_TO_ROOT):
        step = (radius * (linear + cubic * radius * radius) - 1) / (linear + 3 * cubic * radius * radius)
        if not step > 1e-15 * radius:
            break
        radius -= step
    return radius


def step_back(at: Plane, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """J^-1 (dx, dy)."""
    over = 1 / (at.xx * at.yy - at.xy * at.yx)
    return (at.yy * dx - at.xy * dy) * over, (at.xx * dy - at.yx * dx) * over


def replaced(
    terms: Sequence[float], largest: float, target: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """d with T(d) = target in the disc of radius `largest`, and whether there is one; elsewhere d is any point of the disc."""
    length = target.norm(dim=-1)
    plane = target * torch.clamp(largest / length.clamp_min(1e-300), max=1.0)[:, None]
    found = torch.zeros(len(target), dtype=torch.bool, device=target.device)
    # |T(d)| is at most r + 3 r^2 |p| + r^2 |a| + r^4 |b|: beyond that at the edge there is nothing to look for.
    p0, p1, s0, s1, s2, s3 = terms
    r2 = min(largest, FURTHEST) ** 2
    reach = largest + r2 * (3 * math.hypot(p0, p1) + math.hypot(s0, s2) + r2 * math.hypot(s1, s3))
    rows = torch.nonzero(length <= reach * (1 + 1e-12))[:, 0]
    for chunk in rows.split(CHUNK):
        near, found[chunk] = _plain(terms, largest, target[chunk])
        plane[chunk] = torch.where(found[chunk, None], near, plane[chunk])
    left = rows[~found[rows]]
    if len(left):
        plane[left], found[left] = damped_newton(partial(displaced, terms), step_back, largest, target[left], plane[left])
    return plane, found


def _plain(terms: Sequence[float], largest: float, target: Tensor) -> tuple[Tensor, Tensor]:
    """Whole steps from the target, and where the last of them was small enough."""
    tx, ty = target.unbind(-1)
    x, y = tx, ty
    sx = sy = torch.full_like(tx, torch.inf)
    for _ in range(PLAIN_STEPS):
        at = displaced(terms, x, y)
        sx, sy = step_back(at, at.x - tx, at.y - ty)
        x, y = x - sx, y - sy
    radius = torch.hypot(x, y)
    return torch.stack([x, y], -1), (torch.hypot(sx, sy) <= LAST_STEP * (1 + radius)) & (radius <= largest)
