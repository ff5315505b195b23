"""Monotone radial functions: valid domain of a polynomial, safeguarded Newton inverse, smooth functions of the off-axis angle."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.errors import InputError

CHUNK = 8192
"""Points whose inverse is sought together: what they need stays in the processor's cache."""
TABLE_SIZE = 1024
"""Samples of a monotone function that give the start of its inverse."""
PLAIN_STEPS = 2
"""Newton steps from the table that nearly every point needs; a point that needs more takes safeguarded ones."""
NEGLIGIBLE = 1e-150
LAST_STEP = 1e-10
"""Newton's step relative to the interval after which the error, quadratic in it, is one of rounding."""
SMALL_SLOPE = 1e-7
"""tan(theta) below which theta / s is taken from its series; the error of the series is O(SMALL_SLOPE^4)."""


def first_sign_change(coefficients: Float[np.ndarray, " k"], scale: float) -> float:
    """The smallest x > 0 at which the polynomial sum c_i x^i, positive at 0, turns negative; inf where it never does.

    `scale` is the size of the x of interest: roots are sought in x / scale, where the coefficients are comparable.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.asarray(coefficients, dtype=float) * scale ** np.arange(len(coefficients))
    if not np.isfinite(scaled).all():
        return 0.0
    # Highest coefficients so small that a quotient by them would overflow are none.
    scaled = scaled[: np.flatnonzero(np.abs(scaled) >= NEGLIGIBLE * np.abs(scaled).max())[-1] + 1]
    if (scaled >= 0).all():
        return math.inf
    roots = _roots(np.trim_zeros(scaled, "b"))
    # A double root that touches zero splits into a near-real pair; it counts only if the sign really changes behind it.
    real = np.sort(roots.real[(np.abs(roots.imag) < 1e-6 * np.abs(roots)) & (roots.real > 0)])
    descending, low = scaled[::-1].tolist(), 0.0
    for root, following in zip(real, [*real[1:], *(2 * real[-1:])], strict=True):
        high = 0.5 * (float(root) + float(following))
        if _value(descending, high) < 0:
            return _last_positive(descending, low, high, float(root)) * scale
        low = high
    return math.inf


def _value(descending: Sequence[float], x: float) -> float:
    """Horner's rule, the highest coefficient first."""
    total = 0.0
    for c in descending:
        total = total * x + c
    return total


def _last_positive(descending: Sequence[float], low: float, high: float, near: float) -> float:
    """By bisection the last x before the sign change `near` between `low` and `high` at which the value is not negative:
    eigenvalues are good to rounding of the largest, not of themselves."""
    for closer in (near * (1 - 1e-9), near * (1 + 1e-9)):
        if low < closer < high:
            low, high = (closer, high) if _value(descending, closer) >= 0 else (low, closer)
    while high - low > 4e-16 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _value(descending, middle) >= 0 else (low, middle)
    return low


def _roots(coefficients: Float[np.ndarray, " k"]) -> np.ndarray:
    """Roots of sum c_i x^i, the last c_i not zero: eigenvalues of the companion matrix, or the one of a straight line."""
    leading = -coefficients[:-1] / coefficients[-1]
    if len(leading) == 1:
        return leading.astype(complex)
    companion = np.zeros((len(leading), len(leading)))
    companion[1:, :-1].flat[:: len(leading)] = 1.0
    companion[:, -1] = leading
    return np.linalg.eigvals(companion).astype(complex)


def interpolate(x: Float[Tensor, "*batch"], nodes: Float[Tensor, " k"], values: Float[Tensor, " k"]) -> Float[Tensor, "*batch"]:
    """The piecewise linear curve through (node, value), nodes ascending; beyond the ends the value there."""
    right = torch.searchsorted(nodes, x).clamp_(1, len(nodes) - 1)
    low, high = nodes[right - 1], nodes[right]
    share = ((x - low) / (high - low).clamp_min(1e-300)).clamp(0.0, 1.0)
    return torch.lerp(values[right - 1], values[right], share)


def invert_monotone(
    function: Callable[[Tensor], tuple[Tensor, Tensor]], target: Float[Tensor, "*batch"], upper: float
) -> Float[Tensor, "*batch"]:
    """x in [0, upper] with f(x) = target, f increasing there; targets outside f([0, upper]) give the nearer end.

    From a table of f, Newton's step where it stays inside the bracket, bisection where it does not. `function` returns f and f'
    of values of any shape.
    """
    goal = target.reshape(-1)
    nodes = torch.linspace(0.0, upper, TABLE_SIZE, dtype=goal.dtype, device=goal.device)
    # Rounding may leave the values out of order where f is level.
    values = function(nodes)[0].cummax(0).values
    found = [_invert_chunk(function, part, upper, values, nodes) for part in goal.split(CHUNK)]
    return torch.cat(found).view(target.shape)


def _invert_chunk(
    function: Callable[[Tensor], tuple[Tensor, Tensor]], goal: Tensor, upper: float, values: Tensor, nodes: Tensor
) -> Tensor:
    start = interpolate(goal, values, nodes)
    outside = (goal <= values[0]) | (goal >= values[-1])
    x = start
    for _ in range(PLAIN_STEPS):
        value, slope = function(x)
        step = (value - goal) / slope
        x = x - step
    done = outside | ((step.abs() <= LAST_STEP * upper) & (x >= 0) & (x <= upper))
    x = torch.where(outside, start, x)
    if not bool(done.all()):
        left = torch.nonzero(~done)[:, 0]
        x[left] = _invert_safely(function, goal[left], upper, start[left])
    return x


def _invert_safely(function: Callable[[Tensor], tuple[Tensor, Tensor]], goal: Tensor, upper: float, x: Tensor) -> Tensor:
    """Newton and bisection on the points that have not converged."""
    low, high = torch.zeros_like(x), torch.full_like(x, upper)
    result, place = x.clone(), torch.arange(len(x), device=x.device)
    for _ in range(100):
        value, slope = function(x)
        error = value - goal
        low, high = torch.where(error <= 0, x, low), torch.where(error >= 0, x, high)
        newton = x - error / slope
        inside = (newton >= low) & (newton <= high) & (slope > 0)
        step_to = torch.where(inside, newton, 0.5 * (low + high))
        done = (inside & ((step_to - x).abs() <= LAST_STEP * upper)) | (high - low <= 4e-16 * upper)
        result[place] = step_to
        left = torch.nonzero(~done)[:, 0]
        if not len(left):
            break
        place, x, goal, low, high = place[left], step_to[left], goal[left], low[left], high[left]
    return result


def axis_distance(points: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """(s2, s, near): squared and plain distance from the z axis, and whether the point is so near the +z axis that
    series in s2 / z^2 are exact. Where near, s is a constant 1, so that no gradient of sqrt at 0 arises."""
    x, y, z = points.unbind(-1)
    s2 = x * x + y * y
    near = (z > 0) & (s2 < (SMALL_SLOPE * z) ** 2)
    s = torch.where(near | (s2 == 0), 1.0, s2).sqrt()
    return s2, s, near


def angle_over_distance(points: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor]:
    """theta and theta / s with theta = atan2(s, z), s = hypot(x, y); smooth on the +z axis, finite on the -z axis."""
    s2, s, near = axis_distance(points)
    z = points[..., 2]
    z_near = torch.where(near, z, torch.ones_like(z))
    ratio = torch.where(near, (1 - s2 / (3 * z_near**2)) / z_near, torch.atan2(s, z) / s)
    theta = torch.where(near, ratio * s2.detach().sqrt(), torch.atan2(torch.where(s2 == 0, s2, s), z))
    return theta, ratio


def named_vector(names: Sequence[str], parameters: Mapping[str, float], model: str, optional: Sequence[str] = ()) -> list[float]:
    """The values of `names` in order; `optional` ones may be absent and are zero. Raises InputError on any other mismatch."""
    unknown = [name for name in parameters if name not in names]
    missing = [name for name in names if name not in parameters and name not in optional]
    if unknown or missing:
        problem = f"found unknown {' '.join(unknown)}" if unknown else f"{' '.join(missing)} missing"
        raise InputError(f"Camera model {model} expects the parameters {' '.join(names)}, {problem}; correct the names.")
    return [float(parameters.get(name, 0.0)) for name in names]


def horner(coefficients: Sequence[Tensor] | Sequence[float], x: Tensor) -> Tensor:
    """sum c_i x^i, lowest first."""
    if len(coefficients) == 1:
        return torch.zeros_like(x) + coefficients[0]
    total = x * coefficients[-1] + coefficients[-2]
    for c in coefficients[-3::-1]:
        total = total * x + c
    return total
