"""Brown-Conrady and rational distortion of the ideal image plane: values, the disc on which it is one-to-one, its inverse.

With x = (x, y), r = |x|, p = (p2, p1), q = N / D, N = 1 + k1 r^2 + k2 r^4 + k3 r^6, D = 1 + k4 r^2 + k5 r^4 + k6 r^6:

    d(x) = q x + r^2 p + 2 (p . x) x

In the directions along and across x, with g = d(r q) / dr and p turned by psi from x, the Jacobian is

    [ g + 6 a cos psi    2 a sin psi ]
    [ 2 a sin psi    q + 2 a cos psi ],    a = r |p|
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._radial import first_sign_change, interpolate

FURTHEST_SLOPE = 1e8
"""Radius that stands for an infinite one."""
FOLD_GRID = np.concatenate([np.linspace(0.01, 1, 100), np.geomspace(1.05, FURTHEST_SLOPE, 200)])
"""Radii between which the first fold is sought."""
CHUNK = 8192
"""Points whose inverse is sought together: what they need stays in the processor's cache."""
TABLE_SIZE = 512
"""Samples of the radial curve that give the start of the inverse."""
NEWTON_STEPS = 12
"""Of the inverse without safeguards; a point that needs more is left to damped steps."""
DAMPED_STEPS = 60
CONVERGED = 1e-13
"""Residual of the inverse relative to 1 + radius at which the next step would be one of rounding."""

Coefficients = Sequence[Tensor] | Sequence[float]
"""k1 k2 p1 p2 k3 k4 k5 k6."""


class Distorted(NamedTuple):
    """Distorted coordinates of n points and the symmetric Jacobian [[xx, cross], [cross, yy]], each with its own column."""

    x: Tensor
    y: Tensor
    xx: Tensor
    cross: Tensor
    yy: Tensor


def distort(coefficients: Coefficients, x: Tensor, y: Tensor) -> Distorted:
    """d(x) and its Jacobian. Differentiable in all arguments; numbers for coefficients spare terms that are zero."""
    p1, p2 = coefficients[2:4]
    x2, xy, y2 = x * x, x * y, y * y
    r2 = x2 + y2
    q, by_r2 = radial_factor(coefficients, r2)
    twice = 2 * by_r2
    if isinstance(p1, float) and p1 == 0 and p2 == 0:
        return Distorted(x * q, y * q, q + x2 * twice, xy * twice, q + y2 * twice)
    along = 2 * (p2 * x + p1 * y)
    factor = q + along
    px, py = 2 * p1 * x, 2 * p2 * y
    return Distorted(
        x * factor + p2 * r2,
        y * factor + p1 * r2,
        factor + x2 * twice + 4 * p2 * x,
        xy * twice + px + py,
        factor + y2 * twice + 4 * p1 * y,
    )


def radial_factor(coefficients: Coefficients, r2: Tensor) -> tuple[Tensor, Tensor]:
    """q and dq / d(r^2)."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    numerator, by_r2 = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + (3 * k3) * r2)
    if isinstance(k4, float) and k4 == k5 == k6 == 0:
        return numerator, by_r2
    over = 1 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    q = numerator * over
    return q, (by_r2 - q * (k4 + r2 * (2 * k5 + (3 * k6) * r2))) * over


def first_fold(coefficients: Sequence[float]) -> float:
    """The smallest radius at which the distortion folds in some direction, at most FURTHEST_SLOPE; zero for what is not finite."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    numerator, denominator = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    rational = bool(denominator[1:].any())
    # g D^2 = N D + 2 r^2 (N' D - N D'), primes by r^2, as a polynomial in r^2.
    orders = np.arange(4)
    growth = numerator * (1 + 2 * orders)
    if rational:
        growth = np.convolve(growth, denominator) - 2 * np.convolve(numerator, denominator * orders)
    curves = (growth, numerator, denominator) if rational else (growth, numerator)
    radius = min(math.sqrt(min(first_sign_change(curve, 1.0) for curve in curves)), FURTHEST_SLOPE)
    size = math.hypot(p1, p2)
    if size == 0 or radius == 0:
        return radius
    if not math.isfinite(size):
        return 0.0
    polynomials = (growth, numerator, np.convolve(denominator, denominator), denominator)
    return _tangential_fold([polynomial.tolist() for polynomial in polynomials], size, radius)


def _tangential_fold(polynomials: list[list[float]], size: float, radius: float) -> float:
    """The first radius up to `radius` at which the determinant is not positive for some psi.

    By psi it is gq - 4 a^2 + 2 a (g + 3 q) c + 16 a^2 c^2, c = cos psi: least at c = -(g + 3 q) / 16 a, or at c = -1 where that
    lies beyond.
    """
    growth, numerator, square, denominator = polynomials

    def least(r):  # type: ignore[no-untyped-def]
        r2 = r * r
        g, q = _value(growth, r2) / _value(square, r2), _value(numerator, r2) / _value(denominator, r2)
        a = size * r
        c = np.maximum(-(g + 3 * q) / (16 * a), -1.0)
        return g * q - 4 * a * a + 2 * a * c * (g + 3 * q + 8 * a * c)

    grid = np.append(FOLD_GRID[FOLD_GRID < radius], radius * (1 - 1e-12))
    folded = np.flatnonzero(~(least(grid) > 0))
    if not len(folded):
        return radius
    high = float(grid[folded[0]])
    low = float(grid[folded[0] - 1]) if folded[0] else 0.0
    # The limit is one of rounding.
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if least(middle) > 0 else (low, middle)
    return low


def _value(coefficients: list[float], x):  # type: ignore[no-untyped-def]
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def undistort(
    coefficients: Sequence[float], largest: float, target: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """x with d(x) = target in the disc of radius `largest`, where the distortion is one-to-one, and whether there is one.

    Newton from the inverse of the radial part, on the points that have not converged; steps that do not come closer are damped.
    Elsewhere x is any point of the disc.
    """
    plane = torch.empty_like(target)
    found = torch.empty(len(target), dtype=torch.bool, device=target.device)
    distance = target.norm(dim=-1)
    table = _radial_table(coefficients, largest, distance)
    for start in range(0, len(target), CHUNK):
        rows = slice(start, start + CHUNK)
        plane[rows], found[rows] = _undistort_chunk(coefficients, largest, target[rows], distance[rows], table)
    return plane, found


def _radial_table(coefficients: Sequence[float], largest: float, distance: Tensor) -> tuple[Tensor, Tensor]:
    """(r q, r) on a grid of radii that reaches as far as the disc or the points."""
    reach = 1.0 + 2 * float(distance.max()) if len(distance) else 1.0
    grid = distance.new_tensor(1.1) ** torch.arange(200, device=distance.device)
    beyond = torch.nonzero(grid * radial_factor(coefficients, grid * grid)[0] > reach)
    end = float(grid[int(beyond[0])]) if len(beyond) else FURTHEST_SLOPE
    radii = torch.linspace(0.0, min(largest, end), TABLE_SIZE, dtype=distance.dtype, device=distance.device)
    return radii * radial_factor(coefficients, radii * radii)[0], radii


def _undistort_chunk(
    coefficients: Sequence[float], largest: float, target: Tensor, distance: Tensor, table: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    scale = interpolate(distance, *table) / distance.clamp_min(1e-300)
    tx, ty = target.unbind(-1)
    x, y = tx * scale, ty * scale
    tolerance = CONVERGED * (1 + distance)
    place: Tensor | None = None
    plane, found = torch.stack([x, y], -1), torch.zeros_like(distance, dtype=torch.bool)
    for _ in range(NEWTON_STEPS):
        at = distort(coefficients, x, y)
        dx, dy = at.x - tx, at.y - ty
        close = torch.maximum(dx.abs(), dy.abs()) <= tolerance
        sx, sy = solve_symmetric(at, dx, dy)
        x, y = x - sx, y - sy
        r = torch.hypot(x, y)
        inside = r <= largest
        if not bool(inside.all()):
            back = torch.where(inside, 1.0, largest / r)
            x, y = x * back, y * back
        # One step more than needed, which costs little: the point is there to rounding.
        now = torch.stack([x, y], -1)
        if place is None:
            plane, found, place = now, close, torch.arange(len(x), device=x.device)
        else:
            plane[place], found[place] = now, close
        if bool(close.all()):
            return plane, found
        left = torch.nonzero(~close)[:, 0]
        place, x, y, tx, ty, tolerance = place[left], x[left], y[left], tx[left], ty[left], tolerance[left]
    assert place is not None
    plane[place], found[place] = _damped(coefficients, largest, target[place], plane[place])
    return plane, found


def _damped(coefficients: Sequence[float], largest: float, target: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Newton with step halving from any point of the disc, kept inside it; whether it converged is told by the residual."""

    def value(p: Tensor) -> tuple[Distorted, Tensor]:
        at = distort(coefficients, p[..., 0], p[..., 1])
        residual = torch.stack([at.x, at.y], -1) - target
        return at, residual

    at, residual = value(plane)
    error = residual.norm(dim=-1)
    for _ in range(DAMPED_STEPS):
        step = torch.stack(solve_symmetric(at, *residual.unbind(-1)), -1)
        best, best_error = plane, error
        for shrink in (1.0, 0.5, 0.125, 0.02):
            trial = plane - shrink * step
            trial = trial * torch.clamp(largest / trial.norm(dim=-1, keepdim=True).clamp_min(1e-300), max=1.0)
            trial_error = value(trial)[1].norm(dim=-1)
            better = trial_error < best_error
            best = torch.where(better[..., None], trial, best)
            best_error = torch.where(better, trial_error, best_error)
            if bool((better | (error == 0)).all()):
                break
        stalled = bool((best_error >= error).all())
        plane, error = best, best_error
        at, residual = value(plane)
        if stalled:
            break
    return plane, error < 1e-9 * (1 + target.norm(dim=-1))


def solve_symmetric(at: Distorted, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """The step s with J s = (dx, dy); (dx, dy) itself where J is singular."""
    determinant = at.xx * at.yy - at.cross * at.cross
    singular = determinant.abs() < 1e-14
    over = 1 / torch.where(singular, 1.0, determinant)
    x, y = (at.yy * dx - at.cross * dy) * over, (at.xx * dy - at.cross * dx) * over
    return torch.where(singular, dx, x), torch.where(singular, dy, y)
