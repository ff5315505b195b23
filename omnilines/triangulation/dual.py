"""Triangulation in the dual space (Srestasathiern 2012, Algorithm 2; 3.4 to 3.14).

A line lies in a plane where n x m = s d, so the rows [ [n]x  -s I ] act on (m, d), and the line is the right singular vector of
the smallest singular value. It satisfies the Pluecker constraint exactly, whatever the noise and the row weights, unless all
planes pass through the origin. Algorithm 2 divides the rows by w = |s| |m| in the file's frame, which gives a plane that passes
near the origin an unbounded weight and raises the 3D error; the default is unit weights about an origin off the line.
"""

from typing import Literal

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
from omnilines.triangulation.result import Triangulation

NULL_SPACE = 1e-12
"""Second smallest singular value, over the largest, at which the null space has more than one dimension."""
SMALLEST_OFFSET = 1e-9
"""Lower bound of |s| in the published weights, over the largest |s| of the track."""


def triangulate(
    observations: PlaneObservations,
    *,
    weights: Literal["unit", "published"] = "unit",
    iterations: int = 5,
    origin: Literal["shifted", "file"] = "shifted",
    sigma_rad: float | None = None,
) -> Triangulation:
    """The lines of all tracks.

    `weights="published"` re-solves `iterations` times with w = |s| |m| after a start with unit weights; |m| is
    common to all rows of a track, so nothing changes after the first. `origin="file"` takes the
    coordinates as they are, metres and all, as published; a track whose planes all pass through that origin is `unsupported`.
    `sigma_rad` as in `degeneracy.assess`.
    """
    if weights not in ("unit", "published") or origin not in ("shifted", "file") or iterations < 0:
        raise InputError(
            "Dual-space triangulation expects weights unit or published, origin shifted or file and iterations >= 0, found "
            f"{weights!r}, {origin!r} and {iterations}; correct the option."
        )
    reweightings = iterations if weights == "published" else 0
    if reweightings or origin == "file":
        frames = track_frames(observations)
        lines, unsolved = dual_lines(observations, frames, reweightings, origin == "file")
    else:
        frames, lines, unsolved = frames_and_lines(observations)
    return assess(observations, frames, lines, sigma_rad, unsolved)


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
    observations: PlaneObservations, frames: TrackFrames, reweightings: int = 0, in_file_frame: bool = False
) -> tuple[PlueckerLines, Bool[Tensor, " t"]]:
    """The lines of all tracks, NaN where a track is not solvable; and the tracks whose null space has more than one dimension."""
    unsolved = torch.zeros(observations.tracks, dtype=torch.bool, device=observations.normal.device)
    parts = []
    for group in solvable_groups(observations, frames):
        place, unit = group.origin, group.unit
        if in_file_frame:
            place, unit = torch.zeros_like(place), torch.ones_like(unit)
        s = group.offsets(place) / unit[:, None]
        local, unsolved[group.tracks] = _solve(group, s, reweightings)
        metric = PlueckerLines(local.direction, local.moment * unit[:, None])
        parts.append((group.tracks, metric.shifted(-place)))
    return gather(parts, frames), unsolved


def _solve(group: TrackGroup, s: Float[Tensor, "g k"], reweightings: int) -> tuple[PlueckerLines, Bool[Tensor, " g"]]:
    """Lines in the frame of s, and where the null space has more than one dimension."""
    eye = torch.eye(3, dtype=s.dtype, device=s.device)
    blocks = torch.cat([hat(group.normal), -s[..., None, None] * eye], -1)
    local, ambiguous = _smallest(blocks)
    offset = s.abs().clamp_min(1e-300)
    offset = torch.maximum(offset, SMALLEST_OFFSET * offset.amax(-1, keepdim=True))
    for _ in range(reweightings):
        weight = offset * local.moment.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        # A common factor of a track's rows changes nothing; it keeps them near unit length.
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
