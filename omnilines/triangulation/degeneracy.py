"""Which tracks determine a line, and the name of what is wrong with the others.

The angle alpha between the planes of a track is compared with the noise sigma of their normals. Where alpha < 3 sigma the line is
not determined, and the cause gives the name. h is the spread of the camera centres across the mean plane and B their
whole spread:

    epipolar          h <= 3 sigma B: the planes coincide, the baseline lies in them
    at_infinity       the line is far away: at least 30 B, since planes at a distance D differ by 2 h / D, or it would be farther
                      than B / (3 sigma), more than the whole baseline supports
    parallel_planes   neither: the planes nearly coincide because the baseline is short across them; the line may be near

A line may be determined and yet rest on one camera: without it the planes of the others are as alike as above. Nothing then
tells whether that arc belongs to it, and it is `weak`.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.geometry.line import PlueckerLines
from omnilines.records import LINE_STATUSES
from omnilines.triangulation.compiled import camera_sums, on_processor, status_sums
from omnilines.triangulation.frames import TrackFrames
from omnilines.triangulation.kernels.sums import (
    ACROSS,
    ALONE,
    ALONG_MEAN,
    AWAY,
    CHORD,
    CLEAR,
    MIXED,
    OFF_MEAN,
    PLACES,
    RESIDUAL,
    ROUNDING,
    SPREAD,
    TOUCHED,
)
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import DegeneracyOptions
from omnilines.triangulation.result import Triangulation

ROUNDING_RAD = ROUNDING
ON_LINE = 1e-6
"""Distance of a camera from the line, over that of the farthest, at which its plane is arbitrary."""


def _sums(observations: PlaneObservations, frames: TrackFrames, lines: PlueckerLines) -> Float[Tensor, "t 12"]:
    """What a status is decided from, in the columns of `kernels/sums.py`, but CLEAR and TOUCHED.

    The residual is the distance of both end bearings from the projection plane of the line or, without arcs, the two components
    of the angle between that plane and the observed one.
    """
    if on_processor(observations.normal):
        return status_sums(observations.by_track, observations.noise, lines, frames.mean_normal)
    normal = lines[observations.track].moment_about(observations.centre)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    mean = observations.sum_by_track(observations.centre) / observations.counts().clamp_min(1)[:, None]
    from_mean = observations.centre - mean[observations.track]
    height = (from_mean * frames.mean_normal[observations.track]).sum(-1)
    rows = normal.new_zeros(len(normal), 12)
    rows[:, SPREAD], rows[:, ACROSS] = from_mean.square().sum(-1), height.square()
    if observations.arcs is None:
        rows[:, RESIDUAL] = torch.linalg.cross(normal, observations.normal).square().sum(-1)
    else:
        rows[:, RESIDUAL] = (observations.arcs * normal[:, None]).sum(-1).square().sum(-1)
        rows[:, CHORD] = (observations.arcs[:, 1] - observations.arcs[:, 0]).norm(dim=-1)
        rows[:, AWAY] = faces_away(observations, lines).to(rows.dtype)
    precision = torch.ones_like(height)
    if observations.noise is not None:
        variance = (observations.noise.mT @ observations.normal[:, None, :, None]).square().flatten(1).sum(-1)
        precision = rows[:, CHORD].square() / variance.clamp_min(ROUNDING_RAD**2)
    mean = frames.mean_normal[observations.track]
    off = (observations.normal * torch.linalg.cross(lines.direction[observations.track], mean)).sum(-1)
    along = torch.where(off.isnan(), 1.0, (observations.normal * mean).sum(-1))
    off = torch.nan_to_num(off, nan=0.0)
    places = [ALONG_MEAN, MIXED, OFF_MEAN]
    rows[:, places] = precision[:, None] * torch.stack([along.square(), along * off, off.square()], -1)
    sums = observations.sum_by_track(rows)
    sums[:, ALONE] = _least_without_one(observations, rows[:, places], sums[:, places])
    sums[:, PLACES] = torch.bincount(observations.places[0], minlength=observations.tracks).to(sums.dtype)
    return sums


def _least_without_one(
    observations: PlaneObservations, own: Float[Tensor, "n 3"], total: Float[Tensor, "t 3"]
) -> Float[Tensor, " t"]:
    """Least second eigenvalue of the normals of a track, a normal, without all that were seen from one place."""
    of_track, place = observations.places
    at_place = own.new_zeros(len(of_track), 3).index_add(0, place, own)
    others = observations.counts()[of_track] - torch.bincount(place, minlength=len(of_track))
    rest = _second_eigenvalue(total[of_track] - at_place) / others.clamp_min(1)
    least = torch.full_like(total[:, 0], torch.inf)
    return least.scatter_reduce(0, of_track, torch.where(others > 0, rest, 0.0), "amin")


def _second_eigenvalue(places: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Of the matrices [along mixed; mixed off]."""
    along, mixed, off = places.unbind(-1)
    largest = 0.5 * (along + off + torch.sqrt((along - off).square() + 4 * mixed.square()))
    return torch.where(largest > 0, (along * off - mixed.square()) / largest, 0.0)


def _residual_deviation(sums: Float[Tensor, "t 12"], counts: Int[Tensor, " t"]) -> Float[Tensor, " t"]:
    """Standard deviation (rad) of an observation across its line, sqrt(sum r^2 / (2 k - 4)) over k > 2 of them; NaN otherwise."""
    freedom = 2 * counts - 4
    variance = sums[:, RESIDUAL] / freedom.clamp_min(1)
    return torch.where(freedom > 0, variance.sqrt(), torch.full_like(variance, torch.nan))


def _normal_noise(
    observations: PlaneObservations,
    sums: Float[Tensor, "t 12"],
    residual: Tensor,
    angle: Float[Tensor, " t"],
    sigma_rad: float | None,
    most_rad: float,
) -> Float[Tensor, " t"]:
    """Standard deviation (rad) of the plane normals of each track: that of a bearing, sqrt(2) of it over the chord of the arc.

    The noise of the end bearings across the planes is given, stated, or shown by the residuals, `most_rad` at most. Where each
    has a noise of its own, it is the one that all would have for the angle between the planes to say as much.
    """
    counts = observations.counts()
    if sigma_rad is None and observations.noise is not None and observations.noise_stated:
        return _stated_noise(sums, counts, angle)
    if sigma_rad is not None:
        sigma = torch.full_like(residual, sigma_rad)
    else:
        sigma = torch.nan_to_num(residual, nan=most_rad).clamp(ROUNDING_RAD, most_rad)
    if observations.arcs is None:
        return sigma
    return sigma * 2**0.5 / (sums[:, CHORD] / counts.clamp_min(1)).clamp_min(1e-9)


def _stated_noise(sums: Float[Tensor, "t 12"], counts: Int[Tensor, " t"], angle: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """With M the sum of p n n' over the normals n of precision p, its second eigenvalue is chi-square of all planes being one.

    k planes of one noise sigma at the angle alpha (2 asin of their root mean square sine) have k alpha^2 / (2 sigma)^2.
    """
    along, off = sums[:, ALONG_MEAN], sums[:, OFF_MEAN]
    square = _second_eigenvalue(sums[:, [ALONG_MEAN, MIXED, OFF_MEAN]]).clamp_max(0.5 * (along + off))
    alone = (counts / along.clamp_min(1e-300)).sqrt()
    return torch.where(square > 0, 0.5 * angle * (counts / square.clamp_min(1e-300)).sqrt(), alone)


def _without_one(sums: Float[Tensor, "t 12"], counts: Int[Tensor, " t"], angle: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """The angle between the planes of each track without the camera place that turns them most; a second eigenvalue, a normal,
    goes with its square."""
    square = _second_eigenvalue(sums[:, [ALONG_MEAN, MIXED, OFF_MEAN]]) / counts.clamp_min(1)
    return angle * (sums[:, ALONE].clamp_min(0) / square.clamp_min(1e-300)).sqrt()


def _count_cameras(
    observations: PlaneObservations, lines: PlueckerLines, limit: Float[Tensor, " t"], sums: Float[Tensor, "t 12"]
) -> None:
    """Fill CLEAR, a count of places, and TOUCHED: a camera on the line, nearer than `limit` of the farthest, sees a point of it;
    without such cameras two others still determine it, unless one is exactly on it."""
    if on_processor(observations.normal):
        camera_sums(observations.by_track, lines, limit, ON_LINE, sums)
        return
    track = observations.track
    distance = lines[track].distance_to(observations.centre)
    farthest = torch.zeros_like(limit).scatter_reduce(0, track, distance, "amax")[track]
    of_track, place = observations.places
    clear = limit.new_zeros(len(of_track)).index_copy(0, place, (distance > limit[track] * farthest).to(limit.dtype))
    sums[:, CLEAR] = torch.zeros_like(limit).index_add(0, of_track, clear)
    sums[:, TOUCHED] = observations.sum_by_track((distance <= ON_LINE * farthest).to(limit.dtype))


def faces_away(observations: PlaneObservations, lines: PlueckerLines) -> Bool[Tensor, " n"]:
    """Arcs whose middle lies behind the camera or past the vanishing point of their line; none where no arcs are given."""
    if observations.arcs is None:
        return torch.zeros(len(observations.track), dtype=torch.bool, device=observations.normal.device)
    own = lines[observations.track]
    towards = own.closest_point(observations.centre) - observations.centre
    return (observations.arcs.sum(1) * towards).sum(-1) <= 0


def _undetermined(
    observations: PlaneObservations, frames: TrackFrames, sums: Float[Tensor, "t 12"], limit: Tensor, far_spreads: float
) -> dict[str, Bool[Tensor, " t"]]:
    """The three names for planes without a common line, each with its tracks."""
    counts = observations.counts().clamp_min(1)
    mean = observations.sum_by_track(observations.centre) / counts[:, None]
    spread, across = (sums[:, SPREAD] / counts).sqrt(), (sums[:, ACROSS] / counts).sqrt()
    parallel = frames.plane_angle_rad < limit.clamp_min(1e-12)
    one_centre = spread <= 1e-12 * (1 + mean.norm(dim=-1))
    epipolar = parallel & (across <= limit * spread) & ~one_centre
    far = (2 * across > far_spreads * spread * limit) | (across * limit > spread * frames.plane_angle_rad)
    at_infinity = parallel & ~epipolar & ~one_centre & far
    return {"epipolar": epipolar, "at_infinity": at_infinity, "parallel_planes": parallel & ~epipolar & ~at_infinity}


def assess(
    observations: PlaneObservations,
    frames: TrackFrames,
    lines: PlueckerLines,
    sigma_rad: float | None = None,
    unsolved: Bool[Tensor, " t"] | None = None,
    *,
    options: DegeneracyOptions = DegeneracyOptions(),
) -> Triangulation:
    """Lines with their status; degenerate ones become NaN. `unsolved` are tracks that the method itself could not solve for.

    `sigma_rad` is the standard deviation of a bearing (of a plane normal where no arcs are given). Without it, it is that of the
    stated noise of the end points or, where none is stated, estimated from the residuals of each track, at most `arc_sigma_rad`,
    which is also what is assumed for two views.
    """
    sums, counts = _sums(observations, frames, lines), observations.counts()
    views = sums[:, PLACES].long()
    residual = _residual_deviation(sums, counts)
    noise = _normal_noise(observations, sums, residual, frames.plane_angle_rad, sigma_rad, options.arc_sigma_rad)
    limit = options.undetermined_sigmas * noise
    _count_cameras(observations, lines, limit, sums)
    clear_views = sums[:, CLEAR]
    behind = torch.zeros_like(noise, dtype=torch.bool) if observations.arcs is None else 2 * sums[:, AWAY] >= counts
    angle = frames.plane_angle_rad
    # k planes tell their angle as two of a noise smaller by the root of k / 2 do.
    barely = angle < (options.weak_sigmas * noise * (2 / counts.clamp_min(2)).sqrt()).clamp_min(options.weak_angle_rad)
    # Where all planes but those of one camera coincide, nothing tells whether its arc belongs to the line.
    on_one = _without_one(sums, counts, angle) < limit
    # Later names win over earlier ones.
    names = {
        "weak": (clear_views <= 2) | barely | on_one,
        "behind": behind,
        "through_centre": (clear_views < 2) | (sums[:, TOUCHED] > 0),
        "unsupported": torch.zeros_like(clear_views, dtype=torch.bool) if unsolved is None else unsolved,
        **_undetermined(observations, frames, sums, limit, options.far_spreads),
        "inconsistent": residual > options.inconsistent_rad,
        "too_few_views": views < 2,
    }
    status = torch.full_like(views, LINE_STATUSES.index("ok"))
    for name, chosen in names.items():
        status[chosen] = LINE_STATUSES.index(name)
    alone = on_one & ~barely & (clear_views > 2)
    return hidden(Triangulation(lines, status, views, angle, residual, observations, alone))


def hidden(result: Triangulation) -> Triangulation:
    """The same result without the lines whose status is neither `ok` nor `weak`."""
    blank = torch.where(result.known[:, None], 0.0, torch.nan).to(result.lines.direction.dtype)
    return replace(result, lines=PlueckerLines(result.lines.direction + blank, result.lines.moment + blank))


def without_lines(result: Triangulation, tracks: Int[Tensor, " k"], status: str) -> Triangulation:
    """The same result without the lines of some tracks, for that reason."""
    return hidden(replace(result, status=result.status.index_fill(0, tracks, LINE_STATUSES.index(status))))


def gather(lines: list[tuple[Tensor, PlueckerLines]], like: TrackFrames) -> PlueckerLines:
    """Lines of groups of tracks in one table; NaN for tracks of no group."""
    direction = torch.full_like(like.focus, torch.nan)
    moment = direction.clone()
    for tracks, group in lines:
        direction[tracks], moment[tracks] = group.direction, group.moment
    return PlueckerLines(direction, moment)
