"""Brown-Conrady and rational distortion of the ideal image plane: values, the disc on which it is one-to-one, its inverse.

With x = (x, y), r = |x|, p = (p2, p1), q = N / D, N = 1 + k1 r^2 + k2 r^4 + k3 r^6, D = 1 + k4 r^2 + k5 r^4 + k6 r^6:

    d(x) = q x + r^2 p + 2 (p . x) x

In the directions along and across x, with g = d(r q) / dr and p turned by psi from x, the Jacobian is

    [ g + 6 a cos psi    2 a sin psi ]
    [ 2 a sin psi    q + 2 a cos psi ],    a = r |p|
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models._disc import damped_newton
from camera_models._radial import CHUNK, first_sign_change, interpolate

FURTHEST_SLOPE = 1e8
"""Radius that stands for an infinite one."""
POLE_MARGINS = (0.0, *(10.0**k for k in range(-8, -1)))
POLE_CLEARANCE = 1e-9
"""The domain ends before a pole where the denominator is at least this share of the sum of its terms: its sign is then certain,
and the image is farther out than any."""
FOLD_GRID = np.concatenate([np.linspace(0.01, 1, 100), np.geomspace(1.05, FURTHEST_SLOPE, 200)])
"""Radii between which the first fold is sought."""
TABLE_SIZE = 2048
"""Samples of the radial curve that give the start of the inverse."""
NEWTON_STEPS = 6
"""Of the inverse without safeguards; a point that needs more is left to damped steps."""
LAST_STEP = 3e-9
"""Newton's step relative to 1 + radius after which the error, quadratic in it, is one of rounding."""

Coefficients = Sequence[Tensor] | Sequence[float]
"""k1 k2 p1 p2 k3 k4 k5 k6."""


class Distorted(NamedTuple):
    """Distorted coordinates of n points and the symmetric Jacobian [[xx, cross], [cross, yy]], each with its own column."""

    x: Tensor
    y: Tensor
    xx: Tensor
    cross: Tensor
    yy: Tensor
    radial: "Radial"


class Radial(NamedTuple):
    """r^2, q, dq / d(r^2) and 1 / D of n points."""

    r2: Tensor
    q: Tensor
    by_r2: Tensor
    over: Tensor | float


def distort(coefficients: Coefficients, x: Tensor, y: Tensor) -> Distorted:
    """d(x) and its Jacobian. Differentiable in all arguments; numbers for coefficients spare terms that are zero."""
    p1, p2 = coefficients[2:4]
    x2, xy, y2 = x * x, x * y, y * y
    r2 = x2 + y2
    radial = radial_factor(coefficients, r2)
    q, twice = radial.q, 2 * radial.by_r2
    if isinstance(p1, float) and p1 == 0 and p2 == 0:
        return Distorted(x=x * q, y=y * q, xx=q + x2 * twice, cross=xy * twice, yy=q + y2 * twice, radial=radial)
    along = 2 * (p2 * x + p1 * y)
    factor = q + along
    px, py = 2 * p1 * x, 2 * p2 * y
    return Distorted(
        x=x * factor + p2 * r2,
        y=y * factor + p1 * r2,
        xx=factor + x2 * twice + 4 * p2 * x,
        cross=xy * twice + px + py,
        yy=factor + y2 * twice + 4 * p1 * y,
        radial=radial,
    )


def radial_factor(coefficients: Coefficients, r2: Tensor) -> Radial:
    """q and its derivative."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    numerator, by_r2 = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + (3 * k3) * r2)
    if isinstance(k4, float) and k4 == k5 == k6 == 0:
        return Radial(r2, numerator, by_r2, 1.0)
    over = 1 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    q = numerator * over
    return Radial(r2, q, (by_r2 - q * (k4 + r2 * (2 * k5 + (3 * k6) * r2))) * over, over)


def first_fold(coefficients: Sequence[float]) -> float:
    """The smallest radius at which the distortion folds in some direction, at most FURTHEST_SLOPE; zero where NaN or infinite."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    numerator, denominator = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    rational = bool(denominator[1:].any())
    # g D^2 = N D + 2 r^2 (N' D - N D'), primes by r^2, as a polynomial in r^2.
    orders = np.arange(4)
    growth = numerator * (1 + 2 * orders)
    if rational:
        with np.errstate(over="ignore", invalid="ignore"):
            growth = np.convolve(growth, denominator) - 2 * np.convolve(numerator, denominator * orders)
    # Where r q grows from zero on, q is positive: N needs no look of its own.
    curves = (growth, denominator) if rational else (growth,)
    radius = min(math.sqrt(min(first_sign_change(curve, 1.0) for curve in curves)), FURTHEST_SLOPE)
    if rational:
        radius = _short_of_pole(denominator.tolist(), radius)
    size = math.hypot(p1, p2)
    if size == 0 or radius == 0:
        return radius
    if not math.isfinite(size):
        return 0.0
    polynomials = (growth, numerator, np.convolve(denominator, denominator), denominator)
    return _tangential_fold([np.trim_zeros(polynomial, "b").tolist() for polynomial in polynomials], size, radius)


def _short_of_pole(denominator: list[float], radius: float) -> float:
    """The radius, or a little less where D vanishes there: at a pole the quotient is infinite, or by rounding of either sign."""
    for margin in POLE_MARGINS:
        short = radius * (1 - margin)
        terms = [c * short ** (2 * k) for k, c in enumerate(denominator)]
        if not math.isfinite(sum(terms)) or sum(terms) > POLE_CLEARANCE * sum(map(abs, terms)):
            return short
    return 0.0


def _tangential_fold(polynomials: list[list[float]], size: float, radius: float) -> float:
    """The first radius up to `radius` at which the determinant is not positive for some psi.

    By psi it is gq - 4 a^2 + 2 a (g + 3 q) c + 16 a^2 c^2, c = cos psi: least at c = -(g + 3 q) / 16 a, or at c = -1 where that
    lies beyond.
    """
    growth, numerator, square, denominator = polynomials

    def least(r, larger):  # type: ignore[no-untyped-def]
        r2 = r * r
        g, q = _value(growth, r2) / _value(square, r2), _value(numerator, r2) / _value(denominator, r2)
        a = size * r
        c = larger(-(g + 3 * q) / (16 * a), -1.0)
        return g * q - 4 * a * a + 2 * a * c * (g + 3 * q + 8 * a * c)

    grid = np.append(FOLD_GRID[FOLD_GRID < radius], radius * (1 - 1e-12))
    # Where the denominator vanishes at the edge the quotients are infinite or NaN, which counts as folded.
    with np.errstate(all="ignore"):
        folded = np.flatnonzero(~(least(grid, np.maximum) > 0))
        if not len(folded):
            return radius
        high = grid[folded[0]]
        low = grid[folded[0] - 1] if folded[0] else np.float64(0.0)
        while high - low > 1e-14 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if least(middle, max) > 0 else (low, middle)
    return float(low)


def _value(coefficients: list[float], x):  # type: ignore[no-untyped-def]
    """sum c_i x^i of a number or an array."""
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
    distance = target.norm(dim=-1)
    plane, found = torch.zeros_like(target), torch.zeros_like(distance, dtype=torch.bool)
    # |d(x)| is at most r q + 3 r^2 |p|: beyond that at the edge there is nothing to look for.
    q = radial_factor(coefficients, distance.new_tensor(largest * largest)).q
    reachable = distance <= (largest * float(q) + 3 * largest * largest * math.hypot(*coefficients[2:4])) * (1 + 1e-12)
    rows = torch.nonzero(reachable)[:, 0]
    table = _radial_table(coefficients, largest, distance[rows])
    for chunk in rows.split(CHUNK):
        plane[chunk], found[chunk] = _newton(coefficients, largest, target[chunk], distance[chunk], table)
    left = rows[~found[rows]]
    if len(left):
        image = partial(distort, coefficients)
        plane[left], found[left] = damped_newton(image, solve_symmetric, largest, target[left], plane[left])
    return plane, found


def _radial_table(coefficients: Sequence[float], largest: float, distance: Tensor) -> tuple[Tensor, Tensor]:
    """(r q, r) on a grid of radii that reaches as far as the disc or the points."""
    reach = 1.2 * float(distance.max()) if len(distance) else 1.0
    grid = torch.logspace(-2, math.log10(FURTHEST_SLOPE), 200, dtype=distance.dtype, device=distance.device)
    beyond = torch.nonzero(grid * radial_factor(coefficients, grid * grid).q > reach)
    end = float(grid[int(beyond[0])]) if len(beyond) else FURTHEST_SLOPE
    radii = torch.linspace(0.0, min(largest, end), TABLE_SIZE, dtype=distance.dtype, device=distance.device)
    return radii * radial_factor(coefficients, radii * radii).q, radii


def _newton(
    coefficients: Sequence[float], largest: float, target: Tensor, distance: Tensor, table: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Plain steps from the table; points whose last step was not small enough come back as not found."""
    scale = interpolate(distance, *table) / distance.clamp_min(1e-300)
    tx, ty = target.unbind(-1)
    x, y = tx * scale, ty * scale
    place = torch.arange(len(target), device=target.device)
    plane, found = torch.empty_like(target), torch.zeros_like(distance, dtype=torch.bool)
    for _ in range(NEWTON_STEPS):
        at = distort(coefficients, x, y)
        sx, sy = solve_symmetric(at, at.x - tx, at.y - ty)
        x, y = x - sx, y - sy
        r = torch.hypot(x, y)
        inside = r <= largest
        close = (torch.hypot(sx, sy) <= LAST_STEP * (1 + r)) & inside
        if not bool(inside.all()):
            back = torch.where(inside, 1.0, largest / r)
            x, y = x * back, y * back
        plane[place], found[place] = torch.stack([x, y], -1), close
        left = torch.nonzero(~close)[:, 0]
        if not len(left):
            break
        place, x, y, tx, ty = place[left], x[left], y[left], tx[left], ty[left]
    return plane, found


def solve_symmetric(at: Distorted, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """The step s with J s = (dx, dy); (dx, dy) itself where J is singular."""
    determinant = at.xx * at.yy - at.cross * at.cross
    singular = determinant.abs() < 1e-14
    over = 1 / torch.where(singular, 1.0, determinant)
    x, y = (at.yy * dx - at.cross * dy) * over, (at.xx * dy - at.cross * dx) * over
    return torch.where(singular, dx, x), torch.where(singular, dy, y)
