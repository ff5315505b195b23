"""Distances of arc ends from the projection planes of lines, in units of their noise, and what they say of the lines.

With M = m - C x d the normal of the plane through line and camera centre, V an end bearing and A A' = J Sigma J' its covariance:

    h = V . M / w,    w = |A' M|,    dh / dM = V / w - h A A' M / w^2

so that sum h^2 is minus twice the log-likelihood of the line, up to a constant, in any camera. Without A, w = |M|: isotropic
noise of 1 rad. A plane without an arc counts as two orthogonal bearings in it: sum h^2 is then sin^2 of its angle to the line's
plane.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.repeatable import total
from omnilines.geometry.line import PlueckerLines, weighted_median_by_group
from omnilines.geometry.line_chart import LineChart
from omnilines.triangulation.compiled import chart_about_cameras, information, on_processor
from omnilines.triangulation.observations import PlaneObservations

EXTREME_999 = 3.0902
"""The normal deviate that one in a thousand exceeds."""


def end_bearings(observations: PlaneObservations) -> Float[Tensor, "n 2 3"]:
    """The observed ends, or an orthonormal basis of each plane where no arcs are given. World frame."""
    if observations.arcs is not None:
        return observations.arcs
    normal = observations.normal
    axis = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal.dtype)
    first = torch.linalg.cross(normal, axis)
    first = first / first.norm(dim=-1, keepdim=True)
    return torch.stack([first, torch.linalg.cross(normal, first)], 1)


def end_distances(observations: PlaneObservations, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """h of both ends of each row from the plane through its centre with normal M (any length, world frame)."""
    return _distances(end_bearings(observations), observations.noise, normal)[0]


def _distances(bearings: Tensor, noise: Tensor | None, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """h, w (n, 2) and A A' M (n, 2, 3)."""
    if noise is None:
        deviation = normal.norm(dim=-1, keepdim=True).expand(-1, 2)
        spread = normal[:, None].expand(-1, 2, -1)
    else:
        # Products of small matrices: sums over short axes take four times as long.
        across = noise.mT @ normal[:, None, :, None]
        deviation = across.squeeze(-1).norm(dim=-1)
        spread = (noise @ across).squeeze(-1)
    return (bearings @ normal[..., None]).squeeze(-1) / deviation, deviation, spread


@dataclass(frozen=True)
class Linearised:
    """Residuals of every row and their derivatives by a step of its line's chart."""

    residual: Float[Tensor, "n 2"]
    jacobian: Float[Tensor, "n 2 4"]
    rounding: Float[Tensor, " n"]
    """What double precision leaves of the sum of both squares."""


def linearise(observations: PlaneObservations, chart: LineChart) -> Linearised:
    """h and its full derivative, the denominator's included. Everything is measured from the centre of the track's chart."""
    track = observations.track
    local = replace(chart, centre=torch.zeros_like(chart.centre))
    lines = local.lines()[track]
    centre = observations.centre - chart.centre[track]
    normal = lines.moment_about(centre)
    bearings = end_bearings(observations)
    residual, deviation, spread = _distances(bearings, observations.noise, normal)
    by_normal = (bearings - (residual / deviation)[..., None] * spread) / deviation[..., None]
    # g . (-C x dd) = (C x g) . dd
    by_direction = torch.linalg.cross(centre[:, None].expand_as(by_normal), by_normal)
    jacobian = torch.cat([by_direction, by_normal], -1) @ local.jacobian()[track]
    size = lines.moment.norm(dim=-1) + centre.norm(dim=-1)
    rounding = (4 * torch.finfo(normal.dtype).eps * size[:, None] / deviation).square().sum(-1)
    return Linearised(residual, jacobian, rounding)


@dataclass(frozen=True)
class NormalEquations:
    """Of each of t lines: sum h^2, J'h, J'J, and what double precision leaves of the sum."""

    cost: Float[Tensor, " t"]
    gradient: Float[Tensor, "t 4"]
    matrix: Float[Tensor, "t 4 4"]
    rounding: Float[Tensor, " t"]


def normal_equations(observations: PlaneObservations, chart: LineChart) -> NormalEquations:
    """The normal equations of every track at its line."""
    if observations.arcs is not None and on_processor(observations.normal):
        total, rounding = information(observations.by_track, observations.noise, chart)
    else:
        at = linearise(observations, chart)
        rows = torch.cat([at.jacobian, at.residual[..., None]], -1)
        total, rounding = observations.sum_by_track(rows.mT @ rows), observations.sum_by_track(at.rounding)
    return NormalEquations(total[:, 4, 4], total[:, 4, :4], total[:, :4, :4], rounding)


def inverse(matrix: Float[Tensor, "t 4 4"]) -> Float[Tensor, "t 4 4"]:
    """Inverses of normal matrices, scaled to a unit diagonal before; NaN where one is singular."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    scale = diagonal.clamp_min(1e-300).rsqrt()
    scaled = matrix * scale[:, :, None] * scale[:, None]
    sound = torch.isfinite(scaled).flatten(1).all(-1) & (diagonal > 0).all(-1)
    eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(sound[:, None, None], scaled, eye))
    sound = sound & (info == 0)
    found = torch.cholesky_inverse(torch.where(sound[:, None, None], factor, eye)) * scale[:, :, None] * scale[:, None]
    return torch.where(sound[:, None, None], found, torch.nan)


def freedom(observations: PlaneObservations) -> Float[Tensor, " t"]:
    """Residuals of each track beyond the four that fix its line."""
    return (2 * observations.counts() - 4).clamp_min(0).to(observations.normal.dtype)


def chi_square_limit(degrees: Float[Tensor, " t"], deviate: float = EXTREME_999) -> Float[Tensor, " t"]:
    """Quantile of chi-square at a normal deviate (Wilson and Hilferty 1931: its cube root is nearly normal)."""
    f = degrees.clamp_min(1)
    return f * (1 - 2 / (9 * f) + deviate * (2 / (9 * f)).sqrt()).clamp_min(0) ** 3


def noise_variance(cost: Float[Tensor, " t"], degrees: Float[Tensor, " t"]) -> float:
    """Variance of a residual, common to all tracks; NaN where no track has more than two views.

    A median over the tracks, then the mean over those that 999 of 1000 stay within: tracks with wrong members do not count.
    """
    kept = (degrees > 0) & torch.isfinite(cost)
    if not bool(kept.any()):
        return float("nan")
    cost, degrees = cost[kept], degrees[kept]
    typical = cost / chi_square_limit(degrees, 0.0)
    start = weighted_median_by_group(typical, degrees, torch.zeros_like(cost, dtype=torch.int64), 1)
    within = cost <= start * chi_square_limit(degrees)
    return total(cost[within]) / total(degrees[within]) if bool(within.any()) else float(start)


def line_covariance(observations: PlaneObservations, chart: LineChart) -> tuple[Float[Tensor, "t 4 4"], float]:
    """First-order covariance of every line in its chart, and the variance factor that it holds (1 where the noise is stated)."""
    at = normal_equations(observations, chart)
    factor = 1.0 if observations.noise_stated else noise_variance(at.cost, freedom(observations))
    return inverse(at.matrix) * factor, factor


def chart_of(observations: PlaneObservations, lines: PlueckerLines) -> LineChart:
    """The chart of every line about its cameras; NaN for a track without a line."""
    if on_processor(observations.normal):
        return chart_about_cameras(observations.by_track, lines)
    return LineChart.about_cameras(lines, observations.centre, observations.track)
