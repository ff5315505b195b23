"""Directions of lines with their uncertainty: how far one lies from another, what several have in common, the angle of two.

Directions have either sign. e is the part of a direction d across another one u, in a basis of two vectors there, and S its
covariance, to which a model tolerance t adds t^2 I: the squared distance e' S^-1 e is chi-square with 2 degrees of freedom.
Angles are taken for their sines: what is compared is a few degrees apart at most.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.errors import InputError
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.records import Lines

ROUNDING_RAD = 1e-6
"""Added to every uncertainty, so that lines without noise are compared within the rounding of their ends."""
_STEPS = 20


def line_directions(lines: Lines) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Unit directions (from the first end to the second) and their covariance (rad^2), J P J' with J = d d / d chart; NaN where
    there is no line. Raises InputError where the lines have no covariance."""
    if lines.covariance is None or lines.chart_centre_m is None or lines.chart_scale_m is None:
        raise InputError("Directions were expected to have a covariance, found lines without one; adjust the lines first.")
    ends, centre, scale = (torch.from_numpy(a) for a in (lines.ends_m, lines.chart_centre_m, lines.chart_scale_m))
    along = ends[:, 1] - ends[:, 0]
    direction = along / along.norm(dim=-1, keepdim=True)
    middle = ends.mean(1)
    # Relative to the chart's centre, so that nothing depends on where the world origin is.
    local = PlueckerLines(direction, torch.linalg.cross(middle - centre, direction))
    by_direction = LineChart.from_lines(local, torch.zeros_like(centre), scale).jacobian()[:, :3]
    return direction, by_direction @ torch.from_numpy(lines.covariance) @ by_direction.mT


def _basis(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 2"]:
    """Two unit vectors across each direction."""
    axis = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction.dtype)
    first = torch.linalg.cross(direction, axis)
    first = first / first.norm(dim=-1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(direction, first)], -1)


def across(
    d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], u: Float[Tensor, "*n 3"], tolerance_rad: float
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, "*n 3 2"]]:
    """The part of each direction, turned to the side of u, across u; its covariance with the tolerance; and the basis."""
    basis = _basis(u)
    side = torch.where((d * u).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    e = ((side * d)[:, None] @ basis)[:, 0]
    return e, basis.mT @ c @ basis + (tolerance_rad**2 + ROUNDING_RAD**2) * torch.eye(2, dtype=d.dtype), basis


def squared_distance(e: Float[Tensor, "n 2"], s: Float[Tensor, "n 2 2"]) -> Float[Tensor, " n"]:
    """e' S^-1 e."""
    a, b, c = s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]
    return (c * e[:, 0] ** 2 - 2 * b * e[:, 0] * e[:, 1] + a * e[:, 1] ** 2) / (a * c - b * b)


def common_direction(
    d: Float[Tensor, "n 3"], c: Float[Tensor, "n 3 3"], u: Float[Tensor, "3"], tolerance_rad: float
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """The direction that minimises sum e' S^-1 e (Gauss-Newton on the sphere), and its covariance."""
    for _ in range(_STEPS):
        e, s, basis = across(d, c, u, tolerance_rad)
        weight = torch.linalg.inv(s)
        spread = torch.linalg.inv(weight.sum(0))
        step = spread @ (weight @ e[..., None]).sum(0)[:, 0]
        u = u + basis @ step
        u = u / u.norm()
        if float(step.norm()) < 1e-14:
            break
    return u, basis @ spread @ basis.mT


def angle_with_sigma(
    a: Float[Tensor, "m 3"], cov_a: Float[Tensor, "m 3 3"], b: Float[Tensor, "m 3"], cov_b: Float[Tensor, "m 3 3"]
) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """Angle (rad, in [0, pi/2]) of unit directions with independent errors, and its standard deviation; NaN if parallel.

    At the angle w its derivative by a is -(b - a cos w) / sin w.
    """
    sine, cosine = torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1)
    by_a, by_b = ((y - cosine[:, None] * x) / sine[:, None] for x, y in ((a, b), (b, a)))
    variance = torch.einsum("mi,mij,mj->m", by_a, cov_a, by_a) + torch.einsum("mi,mij,mj->m", by_b, cov_b, by_b)
    return torch.atan2(sine, cosine.abs()), variance.clamp_min(0).sqrt()
