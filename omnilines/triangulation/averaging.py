"""Triangulation by averaging sample lines on SO(3) x SO(2) (Srestasathiern 2012, Algorithm 3; 3.15 to 3.54).

Samples are the lines of all k-subsets of a track's planes, each by the SVD of the stacked planes, with their signs aligned by the
principal direction. The mean shift starts at their chordal mean. Orthonormal coordinates are taken about the origin of the
track's own frame (`frames.py`), where S and T are well scaled.
"""

import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.errors import InputError
from camera_models.pose import quaternion_from_rotation, rotation_from_vector
from omnilines.geometry.line import PlueckerLines
from omnilines.triangulation.degeneracy import assess, gather
from omnilines.triangulation.frames import TrackGroup, solvable_groups, track_frames
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.svd import rank_two_lines

SAMPLES_AT_ONCE = 1 << 17
"""Sample lines held in memory at the same time."""
SETTLED = 1e-4
"""Step of the mean shift, over the bandwidth, at which a track is done."""
LEAST_SPREAD = 0.1
"""Samples whose planes are closer together than this fraction of the whole track's are left out."""


def triangulate(
    observations: PlaneObservations,
    *,
    subset: int | None = None,
    budget: int = 128,
    seed: int = 0,
    iterations: int = 50,
    sigma_rad: float | None = None,
) -> Triangulation:
    """The lines of all tracks.

    `subset` is k, by default half of a track's views (rounded up, at least 2). Where there are more than `budget` subsets, that
    many are drawn with the seed. `iterations` bounds the mean shift. `sigma_rad` as in `degeneracy.assess`.
    """
    if (subset is not None and subset < 2) or budget < 1 or iterations < 0:
        raise InputError(
            "Averaging expects subsets of at least 2 planes, a budget of at least 1 and iterations of at least 0, found "
            f"{subset}, {budget} and {iterations}; correct the option."
        )
    frames = track_frames(observations)
    solved = []
    for group in solvable_groups(observations, frames):
        views = group.normal.shape[1]
        size = min(views, max(2, (views + 1) // 2) if subset is None else subset)
        chosen = subsets(views, size, budget, seed).to(group.normal.device)
        parts = [_average(part, chosen, iterations) for part in _split(group, max(1, SAMPLES_AT_ONCE // len(chosen)))]
        local = PlueckerLines(torch.cat([p.direction for p in parts]), torch.cat([p.moment for p in parts]))
        solved.append((group.tracks, local.shifted(-group.origin)))
    return assess(observations, frames, gather(solved, frames), sigma_rad)


def subsets(views: int, size: int, budget: int, seed: int) -> Int[Tensor, "m k"]:
    """All subsets of a size, or `budget` of them drawn with the seed where there are more."""
    if math.comb(views, size) <= budget:
        return torch.tensor(list(itertools.combinations(range(views), size)))
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(budget, views, generator=generator, dtype=torch.float64).argsort(-1)[:, :size].sort(-1).values


def _split(group: TrackGroup, size: int) -> list[TrackGroup]:
    fields = (group.tracks, group.normal, group.centre, group.focus, group.origin, group.unit)
    return [TrackGroup(*part) for part in zip(*(f.split(size) for f in fields), strict=True)]


def _average(group: TrackGroup, chosen: Int[Tensor, "m k"], iterations: int) -> PlueckerLines:
    """The mean lines of a group, with their moments (metres) about its origins."""
    samples, usable = _sample_lines(group, chosen)
    samples = _aligned(samples, usable)
    distance = samples.moment.norm(dim=-1)
    s2 = samples.moment / distance[..., None]
    rotations = torch.stack([samples.direction, s2, torch.linalg.cross(samples.direction, s2)], -1)
    angles = torch.atan2(distance, torch.ones_like(distance))
    # Samples left out keep a finite place and no weight.
    rotations = torch.where(usable[..., None, None], rotations, torch.eye(3, dtype=distance.dtype, device=distance.device))
    angles = torch.where(usable, angles, torch.zeros_like(angles))
    mean_rotation, mean_angle = _mean_shift(rotations, angles, usable.to(angles.dtype), iterations)
    moment = (group.unit * torch.tan(mean_angle))[:, None] * mean_rotation[..., 1]
    return PlueckerLines(mean_rotation[..., 0], moment)


def _sample_lines(group: TrackGroup, chosen: Int[Tensor, "m k"]) -> tuple[PlueckerLines, Bool[Tensor, "g m"]]:
    """The line of each subset about the group's origins in units of rho, and which of them are determined well enough."""
    s = group.offsets(group.focus) / group.unit[:, None]
    planes = torch.cat([group.normal, s[..., None]], -1)
    lines = rank_two_lines(planes[:, chosen]).shifted(((group.origin - group.focus) / group.unit[:, None])[:, None])
    # Sum of sin^2 over the pairs of a subset = sigma_1^2 sigma_2^2 (Cauchy-Binet), with sigma_1^2 near k for planes about a line.
    sine2 = torch.linalg.cross(group.normal[:, :, None], group.normal[:, None]).square().sum(-1)
    member = torch.zeros(len(chosen), sine2.shape[-1], dtype=s.dtype, device=s.device).scatter(1, chosen, 1.0)
    spread = ((member @ sine2) * member).sum(-1).sqrt() / chosen.shape[1]
    whole = sine2.sum((-2, -1)).sqrt() / sine2.shape[-1]
    finite = torch.isfinite(lines.moment).all(-1) & (lines.moment.norm(dim=-1) > 0)
    return lines, finite & (spread >= LEAST_SPREAD * whole[:, None])


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
    u, _, vt = torch.linalg.svd((rotations * weight[..., None, None]).sum(1))
    sign = torch.ones_like(u[..., 0])
    sign[..., 2] = torch.linalg.det(u) * torch.linalg.det(vt)
    angle = torch.atan2((weight * angles.sin()).sum(-1), (weight * angles.cos()).sum(-1))
    return (u * sign[..., None, :]) @ vt, angle


def _mean_shift(
    rotations: Float[Tensor, "g m 3 3"], angles: Float[Tensor, "g m"], weight: Float[Tensor, "g m"], iterations: int
) -> tuple[Float[Tensor, "g 3 3"], Float[Tensor, " g"]]:
    """Mean shift from the chordal mean, with the normal profile g(s) = exp(-s / 2) / 2, s = |log|^2 / h^2.

    The bandwidths h are the median distances of the samples from the chordal mean on SO(3) and on SO(2). A track is done when its
    step is below SETTLED of both, whatever the other tracks do.
    """
    rotation, angle = _chordal_mean(rotations, angles, weight)
    samples = quaternion_from_rotation(rotations)
    h_s = _median(_relative(quaternion_from_rotation(rotation), samples).norm(dim=-1), weight)
    h_t = _median((angles - angle[:, None]).abs(), weight)
    moving = torch.arange(len(angle), device=angle.device)
    for _ in range(iterations):
        logs = _relative(quaternion_from_rotation(rotation[moving]), samples[moving])
        turns = angles[moving] - angle[moving, None]
        kernel_s = weight[moving] * torch.exp(-0.5 * (logs.norm(dim=-1) / h_s[moving, None]) ** 2)
        kernel_t = weight[moving] * torch.exp(-0.5 * (turns / h_t[moving, None]) ** 2)
        step = (kernel_s[..., None] * logs).sum(1) / kernel_s.sum(1, keepdim=True)
        turn = (kernel_t * turns).sum(1) / kernel_t.sum(1)
        rotation[moving] = rotation[moving] @ rotation_from_vector(step)
        angle[moving] = angle[moving] + turn
        moving = moving[(step.norm(dim=-1) > SETTLED * h_s[moving]) | (turn.abs() > SETTLED * h_t[moving])]
        if not len(moving):
            break
    return rotation, angle


def _median(values: Float[Tensor, "g m"], weight: Float[Tensor, "g m"]) -> Float[Tensor, " g"]:
    """Median of the values of positive weight, not below rounding."""
    shown = torch.where(weight > 0, values, torch.full_like(values, torch.nan))
    return torch.nanmedian(shown, dim=-1).values.clamp_min(1e-14)
