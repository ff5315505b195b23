"""Triangulation in the dual space (Srestasathiern 2012, Algorithm 2; 3.4 to 3.14).

A line lies in a plane where n x m = s d, so the rows [ [n]x  -s I ] act on (m, d), and the line is the right singular vector of
the smallest singular value. It satisfies the Pluecker constraint exactly, whatever the noise and the row weights, unless all
planes pass through the origin. Algorithm 2 divides the rows by w = |s| |m| in the file's frame, which gives a plane that passes
near the origin an unbounded weight and raises the 3D error; the default is unit weights about an origin off the line. The most
likely weights are one over the standard deviation that the noise of its arc gives the row, at the line of the last round.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.errors import InputError
from camera_models.pose import hat
from omnilines.geometry.line import PlueckerLines
from omnilines.triangulation.compiled import on_processor, solved
from omnilines.triangulation.degeneracy import assess, gather
from omnilines.triangulation.frames import (
    SHORTEST_SEGMENT,
    SMALLEST_ANGLE_RAD,
    TrackFrames,
    TrackGroup,
    solvable_groups,
    track_frames,
)
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import TriangulationOptions
from omnilines.triangulation.result import Triangulation

Weights = Literal["unit", "published", "most-likely"]
NULL_SPACE = 1e-12
"""Second smallest singular value, over the largest, at which the null space has more than one dimension."""
SMALLEST_OFFSET = 1e-9
"""Lower bound of |s| in the published weights, over the largest |s| of the track."""


def triangulate(
    observations: PlaneObservations,
    *,
    weights: Weights = "unit",
    iterations: int = 5,
    origin: Literal["shifted", "file"] = "shifted",
    sigma_rad: float | None = None,
    options: TriangulationOptions = TriangulationOptions(),
) -> Triangulation:
    """The lines of all tracks.

    `weights="published"` re-solves `iterations` times with w = |s| |m| after a start with unit weights; |m| is
    common to all rows of a track, so nothing changes after the first. `weights="most-likely"` does so with one over the standard
    deviation of each row, for the noise of the end points (of bearings, equal in all directions, where none is given; of normals
    where no arcs are). `origin="file"` takes the
    coordinates as they are, metres and all, as published; a track whose planes all pass through that origin is `unsupported`.
    `sigma_rad` and `options` as in `degeneracy.assess`.
    """
    if weights not in get_args(Weights) or origin not in ("shifted", "file") or iterations < 0:
        raise InputError(
            "Dual-space triangulation expects weights unit or published or most-likely, origin shifted or file and iterations "
            f">= 0, found {weights!r}, {origin!r} and {iterations}; correct the option."
        )
    in_file_frame = origin == "file"
    if weights == "published" or in_file_frame:
        frames = track_frames(observations)
        lines, unsolved = dual_lines(observations, frames, iterations if weights == "published" else 0, in_file_frame)
    else:
        frames, lines, unsolved = frames_and_lines(observations)
    for _ in range(iterations if weights == "most-likely" else 0):
        deviation = _row_deviation(observations, lines, frames, in_file_frame)
        lines, unsolved = dual_lines(observations, frames, 0, in_file_frame, 1 / deviation)
    return assess(observations, frames, lines, sigma_rad, unsolved, options=options.degeneracy)


def frames_and_lines(observations: PlaneObservations) -> tuple[TrackFrames, PlueckerLines, Bool[Tensor, " t"]]:
    """The frames of all tracks with their lines as by `dual_lines`, compiled where the observations lie on the processor."""
    if not on_processor(observations.normal):
        frames = track_frames(observations)
        return frames, *dual_lines(observations, frames)
    found = solved(observations.by_track, SMALLEST_ANGLE_RAD, SHORTEST_SEGMENT, NULL_SPACE)
    direction, point, angle, focus, unit, away, mean_normal, d, m = (torch.from_numpy(values) for values in found[:-1])
    preliminary = PlueckerLines(direction, torch.linalg.cross(point, direction))
    frames = TrackFrames(preliminary, angle, focus, unit, away, mean_normal)
    return frames, PlueckerLines(d, m), torch.from_numpy(found.unsolved)


def dual_lines(
    observations: PlaneObservations,
    frames: TrackFrames,
    reweightings: int = 0,
    in_file_frame: bool = False,
    weight: Float[Tensor, " n"] | None = None,
) -> tuple[PlueckerLines, Bool[Tensor, " t"]]:
    """The lines of all tracks, NaN where a track is not solvable; and the tracks whose null space has more than one dimension.

    `weight` is that of each observation in the first round, unit weights by default.
    """
    unsolved = torch.zeros(observations.tracks, dtype=torch.bool, device=observations.normal.device)
    parts = []
    for group in solvable_groups(observations, frames):
        place, unit = group.origin, group.unit
        if in_file_frame:
            place, unit = torch.zeros_like(place), torch.ones_like(unit)
        s = group.offsets(place) / unit[:, None]
        own = torch.ones_like(s) if weight is None else weight[group.rows]
        local, unsolved[group.tracks] = _solve(group, s, own, reweightings)
        metric = PlueckerLines(local.direction, local.moment * unit[:, None])
        parts.append((group.tracks, metric.shifted(-place)))
    return gather(parts, frames), unsolved


def _row_deviation(
    observations: PlaneObservations, lines: PlueckerLines, frames: TrackFrames, in_file_frame: bool
) -> Float[Tensor, " n"]:
    """Standard deviation of n x m - s d at a line, up to one factor for all; 1 for tracks without a line.

    With C the camera and dn the error of its normal, s = -n . C and the error is -m x dn + (dn . C) d, |d| = 1.
    """
    place, unit = frames.origin, frames.unit
    if in_file_frame:
        place, unit = torch.zeros_like(place), torch.ones_like(unit)
    track = observations.track
    centre = (observations.centre - place[track]) / unit[track, None]
    line = PlueckerLines(lines.direction, lines.moment / unit[:, None]).shifted(place / unit[:, None])[track]
    by_normal = line.direction[:, :, None] * centre[:, None] - hat(line.moment)
    deviation = (by_normal @ _normal_noise(observations)).square().sum((-2, -1)).sqrt()
    return torch.where(torch.isfinite(deviation) & (deviation > 0), deviation, 1.0)


def _normal_noise(observations: PlaneObservations) -> Float[Tensor, "n 3 c"]:
    """A with A A' the covariance of each normal, from that of the end bearings V1, V2: n = V1 x V2 / |V1 x V2|."""
    across = torch.eye(3, dtype=observations.normal.dtype, device=observations.normal.device) - (
        observations.normal[:, :, None] * observations.normal[:, None]
    )
    if observations.arcs is None:
        return across
    first, second = observations.arcs.unbind(1)
    by_ends = torch.stack([-hat(second), hat(first)], 1)
    if observations.noise is not None:
        by_ends = by_ends @ observations.noise
    chord = torch.linalg.cross(first, second).norm(dim=-1).clamp_min(1e-300)
    return across @ torch.cat([by_ends[:, 0], by_ends[:, 1]], -1) / chord[:, None, None]


def _solve(
    group: TrackGroup, s: Float[Tensor, "g k"], first_weight: Float[Tensor, "g k"], reweightings: int
) -> tuple[PlueckerLines, Bool[Tensor, " g"]]:
    """Lines in the frame of s, and where the null space has more than one dimension."""
    eye = torch.eye(3, dtype=s.dtype, device=s.device)
    blocks = torch.cat([hat(group.normal), -s[..., None, None] * eye], -1)
    # A common factor of a track's rows changes nothing; it keeps them near unit length.
    local, ambiguous = _smallest(blocks * (first_weight / first_weight.amax(-1, keepdim=True))[..., None, None])
    offset = s.abs().clamp_min(1e-300)
    offset = torch.maximum(offset, SMALLEST_OFFSET * offset.amax(-1, keepdim=True))
    for _ in range(reweightings):
        weight = offset * local.moment.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        relative = weight / weight.amin(-1, keepdim=True)
        local, _ = _smallest(blocks / relative[..., None, None])
    return local, ambiguous


def _smallest(blocks: Float[Tensor, "g k 3 6"]) -> tuple[PlueckerLines, Bool[Tensor, " g"]]:
    _, singular, vt = torch.linalg.svd(blocks.flatten(1, 2), full_matrices=False)
    m, d = vt[:, -1, :3], vt[:, -1, 3:]
    length = d.norm(dim=-1, keepdim=True)
    direction, moment = d / length, m / length
    # Exact but for rounding (3.9).
    moment = moment - (moment * direction).sum(-1, keepdim=True) * direction
    return PlueckerLines(direction, moment), singular[:, -2] <= NULL_SPACE * singular[:, 0]
