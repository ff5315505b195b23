"""Which tracks determine a line, and the name of what is wrong with the others.

The angle alpha between the planes of a track is compared with the noise sigma of their normals. Where alpha < 3 sigma the line is
not determined, and the cause gives the name. h is the spread of the camera centres across the mean plane and B their
whole spread:

    epipolar          h <= 3 sigma B: the planes coincide, the baseline lies in them
    at_infinity       the line would be farther than B / (3 sigma), more than the baseline supports
    parallel_planes   neither: the planes nearly coincide because the baseline is short across them
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from omnilines.geometry.line import PlueckerLines
from omnilines.records import LINE_STATUSES
from omnilines.triangulation.frames import TrackFrames
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation

ARC_SIGMA_RAD = 5e-4
"""Noise of a bearing that is assumed for two views, which cannot show it, about half a pixel of an ordinary camera; and the
most that residuals are taken to show: what exceeds it comes from poses, and adjusting poses needs the lines."""
INCONSISTENT_RAD = 0.25
"""Residuals above this are beyond any error of poses: the arcs are not of one line."""
ROUNDING_RAD = 1e-9
UNDETERMINED, WEAK = 3.0, 10.0
"""Plane angles below this many standard deviations."""
ON_LINE = 1e-6
"""Distance of a camera from the line, over that of the farthest, at which its plane is arbitrary."""
WEAK_ANGLE_RAD = math.radians(0.1)


def residual_deviation(observations: PlaneObservations, lines: PlueckerLines) -> Float[Tensor, " t"]:
    """Standard deviation (rad) of an observation across its line, sqrt(sum r^2 / (2 k - 4)) over k > 2 views; NaN otherwise.

    r is the distance of both end bearings from the projection plane of the line or, without arcs, the two components of the angle
    between that plane and the observed one.
    """
    normal = lines[observations.track].moment_about(observations.centre)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    if observations.arcs is None:
        squares = torch.linalg.cross(normal, observations.normal).square().sum(-1)
    else:
        squares = (observations.arcs * normal[:, None]).sum(-1).square().sum(-1)
    freedom = 2 * observations.views() - 4
    variance = observations.sum_by_track(squares) / freedom.clamp_min(1)
    return torch.where(freedom > 0, variance.sqrt(), torch.full_like(variance, torch.nan))


def _bearing_noise(observations: PlaneObservations, residual: Tensor, sigma_rad: float | None) -> Float[Tensor, " t"]:
    """Standard deviation (rad) of the end bearings of each track across its planes: given, stated, or shown by residuals."""
    if sigma_rad is not None:
        return torch.full_like(residual, sigma_rad)
    if observations.noise is None or not observations.noise_stated:
        return torch.nan_to_num(residual, nan=ARC_SIGMA_RAD).clamp(ROUNDING_RAD, ARC_SIGMA_RAD)
    across = observations.noise.mT @ observations.normal[:, None, :, None]
    total = observations.sum_by_track(across.square().flatten(1).sum(-1))
    return (total / (2 * observations.views()).clamp_min(1)).sqrt()


def _normal_noise(observations: PlaneObservations, residual: Tensor, sigma_rad: float | None) -> Float[Tensor, " t"]:
    """Standard deviation (rad) of the plane normals of each track: that of a bearing, sqrt(2) of it over the chord of the arc."""
    sigma = _bearing_noise(observations, residual, sigma_rad)
    if observations.arcs is None:
        return sigma
    chord = (observations.arcs[:, 1] - observations.arcs[:, 0]).norm(dim=-1)
    mean_chord = observations.sum_by_track(chord) / observations.views().clamp_min(1)
    return sigma * 2**0.5 / mean_chord.clamp_min(1e-9)


def faces_away(observations: PlaneObservations, lines: PlueckerLines) -> Bool[Tensor, " n"]:
    """Arcs whose middle lies behind the camera or past the vanishing point of their line; none where no arcs are given."""
    if observations.arcs is None:
        return torch.zeros(len(observations.track), dtype=torch.bool, device=observations.normal.device)
    own = lines[observations.track]
    towards = own.closest_point(observations.centre) - observations.centre
    return (observations.arcs.sum(1) * towards).sum(-1) <= 0


def _behind(observations: PlaneObservations, lines: PlueckerLines) -> Bool[Tensor, " t"]:
    """Tracks of which at least half of the arcs face away."""
    if observations.arcs is None:
        return torch.zeros(observations.tracks, dtype=torch.bool, device=observations.normal.device)
    wrong = faces_away(observations, lines).to(lines.direction.dtype)
    return 2 * observations.sum_by_track(wrong) >= observations.views()


def _undetermined(observations: PlaneObservations, frames: TrackFrames, noise: Tensor) -> dict[str, Bool[Tensor, " t"]]:
    """The three names for planes without a common line, each with its tracks."""
    views = observations.views().clamp_min(1)
    mean = observations.sum_by_track(observations.centre) / views[:, None]
    from_mean = observations.centre - mean[observations.track]
    height = (from_mean * frames.mean_normal[observations.track]).sum(-1)
    spread = (observations.sum_by_track(from_mean.square().sum(-1)) / views).sqrt()
    across = (observations.sum_by_track(height.square()) / views).sqrt()
    limit = UNDETERMINED * noise
    parallel = frames.plane_angle_rad < limit.clamp_min(1e-12)
    one_centre = spread <= 1e-12 * (1 + mean.norm(dim=-1))
    epipolar = parallel & (across <= limit * spread) & ~one_centre
    at_infinity = parallel & ~epipolar & ~one_centre & (across * limit > spread * frames.plane_angle_rad)
    return {"epipolar": epipolar, "at_infinity": at_infinity, "parallel_planes": parallel & ~epipolar & ~at_infinity}


def assess(
    observations: PlaneObservations,
    frames: TrackFrames,
    lines: PlueckerLines,
    sigma_rad: float | None = None,
    unsolved: Bool[Tensor, " t"] | None = None,
) -> Triangulation:
    """Lines with their status; degenerate ones become NaN. `unsolved` are tracks that the method itself could not solve for.

    `sigma_rad` is the standard deviation of a bearing (of a plane normal where no arcs are given). Without it, it is that of the
    stated noise of the end points or, where none is stated, estimated from the residuals of each track, at most 5e-4, which is
    also what is assumed for two views.
    """
    residual = residual_deviation(observations, lines)
    noise = _normal_noise(observations, residual, sigma_rad)
    distance = lines[observations.track].distance_to(observations.centre)
    farthest = torch.zeros_like(noise).scatter_reduce(0, observations.track, distance, "amax")[observations.track]
    # A camera on the line sees a point of it; without such cameras two others still determine it, unless one is exactly on it.
    clear = distance > UNDETERMINED * noise[observations.track] * farthest
    clear_views = observations.sum_by_track(clear.to(noise.dtype))
    touched = observations.sum_by_track((distance <= ON_LINE * farthest).to(noise.dtype))
    angle = frames.plane_angle_rad
    # Later names win over earlier ones.
    names = {
        "weak": (clear_views <= 2) | (angle < (WEAK * noise).clamp_min(WEAK_ANGLE_RAD)),
        "behind": _behind(observations, lines),
        "through_centre": (clear_views < 2) | (touched > 0),
        "unsupported": torch.zeros_like(clear_views, dtype=torch.bool) if unsolved is None else unsolved,
        **_undetermined(observations, frames, noise),
        "inconsistent": residual > INCONSISTENT_RAD,
        "too_few_views": observations.views() < 2,
    }
    status = torch.full_like(observations.views(), LINE_STATUSES.index("ok"))
    for name, chosen in names.items():
        status[chosen] = LINE_STATUSES.index(name)
    return hidden(Triangulation(lines, status, observations.views(), angle, residual, observations))


def hidden(result: Triangulation) -> Triangulation:
    """The same result without the lines whose status is neither `ok` nor `weak`."""
    blank = torch.where(result.known[:, None], 0.0, torch.nan).to(result.lines.direction.dtype)
    return replace(result, lines=PlueckerLines(result.lines.direction + blank, result.lines.moment + blank))


def gather(lines: list[tuple[Tensor, PlueckerLines]], like: TrackFrames) -> PlueckerLines:
    """Lines of groups of tracks in one table; NaN for tracks of no group."""
    direction = torch.full_like(like.focus, torch.nan)
    moment = direction.clone()
    for tracks, group in lines:
        direction[tracks], moment[tracks] = group.direction, group.moment
    return PlueckerLines(direction, moment)
