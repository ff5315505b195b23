"""Triangulation by averaging sample lines on SO(3) x SO(2) (Srestasathiern 2012, Algorithm 3; 3.15 to 3.54).

Samples are the lines of all subsets of three planes of a track or more, each by the SVD of the stacked planes, with their signs
aligned by the principal direction. The mean shift starts at their chordal mean.

Orthonormal coordinates depend on the origin and on the unit of length, which the published form takes from the file. Here both
are the track's own: the origin lies as far from the line as the cameras do (median), across the widest gap of the planes, and
that distance is the unit, so that T is 45 degrees at the line and an angle on SO(3) or SO(2) is about one seen by a camera. (With
half a segment as the unit short segments drive T towards 90 degrees, where small angles are long ways.)
"""

import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.errors import InputError
from camera_models.pose import quaternion_from_rotation, rotation_from_vector
from camera_models.rotations import mean_rotation
from omnilines.geometry.line import PlueckerLines
from omnilines.triangulation.degeneracy import assess, gather
from omnilines.triangulation.frames import TrackGroup, solvable_groups, track_frames
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import TriangulationOptions
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.svd import rank_two_lines

PLANES_AT_ONCE = 1 << 20
"""Of all sample lines held in memory at the same time."""
SETTLED = 1e-4
"""Step of the mean shift, over the bandwidth, at which a track is done."""


def triangulate(
    observations: PlaneObservations,
    *,
    subset: int = 3,
    bandwidth: float | None = None,
    budget: int = 1024,
    seed: int = 0,
    iterations: int = 50,
    min_spread_share: float = 0.1,
    sigma_rad: float | None = None,
    options: TriangulationOptions = TriangulationOptions(),
) -> Triangulation:
    """The lines of all tracks.

    Samples are the lines of all subsets of `subset` planes or more (3.36; a track of fewer has one sample, of all its planes).
    Where there are more than `budget` subsets, that many are drawn from all of them with the seed. `bandwidth` is the
    h of the kernel, in radians on SO(3) x SO(2); by default the median distance of a track's samples from their chordal mean.
    `iterations` bounds the mean shift. Samples whose planes are closer together than `min_spread_share` of what the whole
    track's are count for nothing. `sigma_rad` and `options` as in `degeneracy.assess`.
    """
    if subset < 2 or budget < 1 or iterations < 0:
        raise InputError(
            "Averaging expects subsets of at least 2 planes, a budget of at least 1 and iterations of at least 0, found "
            f"{subset}, {budget} and {iterations}; correct the option."
        )
    if bandwidth is not None and not 0 < bandwidth < math.inf:
        raise InputError(f"Averaging expects a bandwidth above 0 radians, found {bandwidth}; correct the option.")
    frames = track_frames(observations)
    solved = []
    for group in solvable_groups(observations, frames):
        chosen = members(group.normal.shape[1], subset, budget, seed).to(group.normal.device)
        far = _median_distance(group, frames.preliminary[group.tracks])
        size = max(1, PLANES_AT_ONCE // chosen.numel())
        parts = [
            _average(part, distance, chosen, bandwidth, iterations, min_spread_share)
            for part, distance in zip(_split(group, size), far.split(size), strict=True)
        ]
        lines = PlueckerLines(torch.cat([p.direction for p in parts]), torch.cat([p.moment for p in parts]))
        solved.append((group.tracks, lines))
    return assess(observations, frames, gather(solved, frames), sigma_rad, options=options.degeneracy)


def members(views: int, least: int, budget: int, seed: int) -> Bool[Tensor, "m views"]:
    """Which planes each sample is made of: all subsets of `least` planes or more (3.35), or `budget` drawn from them."""
    sizes = range(min(least, views), views + 1)
    counts = [math.comb(views, size) for size in sizes]
    if sum(counts) <= budget:
        rows = [chosen for size in sizes for chosen in itertools.combinations(range(views), size)]
        table = torch.zeros(len(rows), views, dtype=torch.bool)
        for row, chosen in zip(table, rows, strict=True):
            row[list(chosen)] = True
        return table
    # A subset drawn evenly from all of them: its size by the number of subsets of that size, then its planes.
    generator = torch.Generator().manual_seed(seed)
    share = torch.tensor([count / sum(counts) for count in counts], dtype=torch.float64)
    size = sizes[0] + torch.multinomial(share, budget, replacement=True, generator=generator)
    rank = torch.rand(budget, views, generator=generator, dtype=torch.float64).argsort(-1).argsort(-1)
    return rank < size[:, None]


def subsets(views: int, size: int, budget: int, seed: int) -> Int[Tensor, "m k"]:
    """All subsets of a size, or `budget` of them drawn with the seed where there are more."""
    if math.comb(views, size) <= budget:
        return torch.tensor(list(itertools.combinations(range(views), size)))
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(budget, views, generator=generator, dtype=torch.float64).argsort(-1)[:, :size].sort(-1).values


def _split(group: TrackGroup, size: int) -> list[TrackGroup]:
    fields = (group.tracks, group.rows, group.normal, group.centre, group.focus, group.origin, group.unit)
    return [TrackGroup(*part) for part in zip(*(f.split(size) for f in fields), strict=True)]


def _median_distance(group: TrackGroup, lines: PlueckerLines) -> Float[Tensor, " g"]:
    """Of the cameras of each track from its preliminary line, metres."""
    own = PlueckerLines(lines.direction[:, None], lines.moment[:, None])
    return own.distance_to(group.centre).median(-1).values


def _average(
    group: TrackGroup,
    far: Float[Tensor, " g"],
    chosen: Bool[Tensor, "m k"],
    bandwidth: float | None,
    iterations: int,
    min_spread_share: float,
) -> PlueckerLines:
    """The mean lines of a group, in the world frame. The origin of the chart is as far from the line as the cameras are."""
    samples, usable = _sample_lines(group, chosen, min_spread_share)
    to_origin = (group.origin - group.focus) * (far / group.unit.square())[:, None]
    samples = _aligned(samples.shifted(to_origin[:, None]), usable)
    distance = samples.moment.norm(dim=-1)
    usable = usable & (distance > 0)
    s2 = samples.moment / distance.clamp_min(1e-300)[..., None]
    rotations = torch.stack([samples.direction, s2, torch.linalg.cross(samples.direction, s2)], -1)
    angles = torch.atan2(distance * group.unit[:, None], far[:, None])
    # Samples left out keep a finite place and no weight.
    rotations = torch.where(usable[..., None, None], rotations, torch.eye(3, dtype=distance.dtype, device=distance.device))
    angles = torch.where(usable, angles, torch.zeros_like(angles))
    mean_rotation, mean_angle = _mean_shift(rotations, angles, usable.to(angles.dtype), bandwidth, iterations)
    moment = (far * torch.tan(mean_angle))[:, None] * mean_rotation[..., 1]
    return PlueckerLines(mean_rotation[..., 0], moment).shifted(-group.focus - group.unit[:, None] * to_origin)


def _sample_lines(
    group: TrackGroup, chosen: Bool[Tensor, "m k"], min_spread_share: float
) -> tuple[PlueckerLines, Bool[Tensor, "g m"]]:
    """The line of each subset about the group's focus in units of rho, and which of them are determined well enough."""
    s = group.offsets(group.focus) / group.unit[:, None]
    member = chosen.to(s.dtype)
    lines = rank_two_lines(torch.cat([group.normal, s[..., None]], -1)[:, None] * member[..., None])
    # Sum of sin^2 over the pairs of a subset = sigma_1^2 sigma_2^2 (Cauchy-Binet), with sigma_1^2 near k for planes about a line.
    sine2 = torch.linalg.cross(group.normal[:, :, None], group.normal[:, None]).square().sum(-1)
    spread = ((member @ sine2) * member).sum(-1).sqrt() / member.sum(-1)
    whole = sine2.sum((-2, -1)).sqrt() / sine2.shape[-1]
    finite = torch.isfinite(lines.moment).all(-1)
    return lines, finite & (spread >= min_spread_share * whole[:, None])


def _aligned(lines: PlueckerLines, usable: Bool[Tensor, "g m"]) -> PlueckerLines:
    """The lines with signs such that all directions lie in the half-space of their principal direction (3.31 to 3.33)."""
    directions = torch.where(usable[..., None], lines.direction, torch.zeros_like(lines.direction))
    principal = torch.linalg.eigh(directions.mT @ directions).eigenvectors[..., -1]
    sign = torch.where((directions * principal[:, None]).sum(-1) < 0, -1.0, 1.0)[..., None].to(directions.dtype)
    return PlueckerLines(lines.direction * sign, lines.moment * sign)


def _relative(mean: Float[Tensor, "g 4"], samples: Float[Tensor, "g m 4"]) -> Float[Tensor, "g m 3"]:
    """log(mean' sample) of rotations given as quaternions: rotation vectors (rad), |w| <= pi."""
    w, x, y, z = mean.unbind(-1)
    # Rows are conj(mean) * sample, its vector part: linear in the sample.
    rows = torch.stack([-x, w, z, -y, -y, -z, w, x, -z, y, -x, w], -1).unflatten(-1, (3, 4))
    vector = samples @ rows.mT
    scalar = (samples * mean[:, None]).sum(-1, keepdim=True)
    vector = torch.where(scalar < 0, -vector, vector)
    sine = vector.norm(dim=-1, keepdim=True)
    return vector * torch.where(sine > 0, 2 * torch.atan2(sine, scalar.abs()) / sine.clamp_min(1e-300), 2.0)


def _chordal_mean(
    rotations: Float[Tensor, "g m 3 3"], angles: Float[Tensor, "g m"], weight: Float[Tensor, "g m"]
) -> tuple[Float[Tensor, "g 3 3"], Float[Tensor, " g"]]:
    """3.51 to 3.53. On SO(2) the projection of the sum of rotations is the angle of the sum of their unit vectors."""
    angle = torch.atan2((weight * angles.sin()).sum(-1), (weight * angles.cos()).sum(-1))
    return mean_rotation(rotations, weight), angle


def _mean_shift(
    rotations: Float[Tensor, "g m 3 3"],
    angles: Float[Tensor, "g m"],
    weight: Float[Tensor, "g m"],
    bandwidth: float | None,
    iterations: int,
) -> tuple[Float[Tensor, "g 3 3"], Float[Tensor, " g"]]:
    """Mean shift from the chordal mean with the normal profile g(s) = exp(-s / 2) / 2, s = d^2 / h^2.

    d^2 is the sum of the squared angles on SO(3) and SO(2), so that one kernel weighs a sample as a whole.

    A track is done when its step is below SETTLED of the bandwidth, whatever the other tracks do.
    """
    rotation, angle = _chordal_mean(rotations, angles, weight)
    samples = quaternion_from_rotation(rotations)
    first = _steps(rotation, angle, samples, angles)
    h = _median(first.norm(dim=-1), weight) if bandwidth is None else torch.full_like(angle, bandwidth)
    moving = torch.arange(len(angle), device=angle.device)
    for _ in range(iterations):
        logs = _steps(rotation[moving], angle[moving], samples[moving], angles[moving])
        square = (logs.norm(dim=-1) / h[moving, None]).square()
        # The nearest sample has the weight 1, so that a bandwidth below every distance still leaves weights.
        nearest = torch.where(weight[moving] > 0, square, torch.inf).amin(-1, keepdim=True)
        kernel = weight[moving] * torch.exp(-0.5 * (square - nearest))
        step = (kernel[..., None] * logs).sum(1) / kernel.sum(1, keepdim=True)
        rotation[moving] = rotation[moving] @ rotation_from_vector(step[:, :3])
        angle[moving] = angle[moving] + step[:, 3]
        moving = moving[step.norm(dim=-1) > SETTLED * h[moving]]
        if not len(moving):
            break
    return rotation, angle


def _steps(
    rotation: Float[Tensor, "g 3 3"], angle: Float[Tensor, " g"], samples: Float[Tensor, "g m 4"], angles: Float[Tensor, "g m"]
) -> Float[Tensor, "g m 4"]:
    """Logarithms of the samples at a point of SO(3) x SO(2), rad."""
    return torch.cat([_relative(quaternion_from_rotation(rotation), samples), (angles - angle[:, None])[..., None]], -1)


def _median(values: Float[Tensor, "g m"], weight: Float[Tensor, "g m"]) -> Float[Tensor, " g"]:
    """Median of the values of positive weight, not below rounding."""
    shown = torch.where(weight > 0, values, torch.full_like(values, torch.nan))
    return torch.nanmedian(shown, dim=-1).values.clamp_min(1e-14)
