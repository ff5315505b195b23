"""A frame of its own for each track, so that no result depends on the world origin or on the unit of length.

A plane close to a line misses it by a rotation a = n . d and by an offset b at a chosen point of the line, the focus. To first
order the linear methods minimise sum (rho^2 a^2 + b^2) for some length rho. In the middle of the segment the errors of a and b
are independent, and with rho half its length the sum is that of the squared distances of both end points from the planes: so
where the arcs are known. Without them the focus is the point nearest to the mean camera and rho the median distance of the
cameras; the dual method then loses about 4 percent (RMS 3D error, the dissertation's wide set-up at 0.5 px).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.geometry.line import PlueckerLines, segment_ends, weighted_median_by_group
from omnilines.triangulation.observations import PlaneObservations

SMALLEST_ANGLE_RAD = 1e-12
"""Planes with a smaller spread are not solved for: double precision leaves nothing of the line."""
SHORTEST_SEGMENT = 0.01
"""Lower bound of rho over the median camera distance; shorter segments say nothing of their direction."""


@dataclass(frozen=True)
class TrackFrames:
    """One frame per track; NaN for tracks that are not solvable."""

    preliminary: PlueckerLines
    """World frame."""
    plane_angle_rad: Float[Tensor, " t"]
    focus: Float[Tensor, "t 3"]
    """A point of the preliminary line."""
    unit: Float[Tensor, " t"]
    """rho, metres."""
    away: Float[Tensor, "t 3"]
    """Unit vector from the line into the widest gap between the planes."""
    mean_normal: Float[Tensor, "t 3"]
    """Principal direction of the normals."""

    @property
    def origin(self) -> Float[Tensor, "t 3"]:
        """A point at the distance rho from the line, as far from all planes as can be."""
        return self.focus + self.unit[:, None] * self.away


@dataclass(frozen=True)
class TrackGroup:
    """g solvable tracks of k observations each, with their frames."""

    tracks: Int[Tensor, " g"]
    rows: Int[Tensor, "g k"]
    """Of the observations."""
    normal: Float[Tensor, "g k 3"]
    centre: Float[Tensor, "g k 3"]
    focus: Float[Tensor, "g 3"]
    origin: Float[Tensor, "g 3"]
    unit: Float[Tensor, " g"]

    def offsets(self, origin: Float[Tensor, "g 3"]) -> Float[Tensor, "g k"]:
        """s of n . X + s = 0 with X measured from a point: s = -n . (C - origin), metres."""
        return -(self.normal * (self.centre - origin[:, None])).sum(-1)


def preliminary_lines(
    normal: Float[Tensor, "g k 3"], centre: Float[Tensor, "g k 3"]
) -> tuple[Float[Tensor, "g 3 3"], Float[Tensor, "g 3"], Float[Tensor, " g"]]:
    """Principal axes of the normals (rows; the last is the direction), the point nearest to the mean camera, the plane angle.

    With N = U S V' the direction is v3 and the point solves N X = -s in span(v1, v2), both to the accuracy of the SVD.
    """
    views = normal.shape[1]
    u, singular, vt = torch.linalg.svd(normal, full_matrices=True)
    mean = centre.mean(1)
    s = -(normal * (centre - mean[:, None])).sum(-1)
    projected = (u[:, :, :2] * s[..., None]).sum(1) / singular[:, :2]
    point = mean - (projected[..., None] * vt[:, :2]).sum(1)
    return vt, point, 2 * torch.asin((singular[:, 1] / views**0.5).clamp(max=0.5**0.5))


def widest_gap(normal: Float[Tensor, "g k 3"], axes: Float[Tensor, "g 3 3"]) -> Float[Tensor, "g 3"]:
    """The unit vector across the line (direction axes[2]) in the middle of the widest gap between its planes."""
    # The plane of normal (x, y) meets the plane across the line in the direction (-y, x).
    across = normal @ axes[:, :2].mT
    trace = torch.atan2(across[..., 0], -across[..., 1]).remainder(torch.pi).sort(-1).values
    gap = torch.cat([trace[:, 1:], trace[:, :1] + torch.pi], -1) - trace
    widest = gap.argmax(-1, keepdim=True)
    middle = (trace + 0.5 * gap).gather(-1, widest)
    return torch.cos(middle) * axes[:, 0] + torch.sin(middle) * axes[:, 1]


def track_frames(observations: PlaneObservations) -> TrackFrames:
    """The frames of all tracks."""
    tracks = observations.tracks
    blank = torch.full((tracks, 3), torch.nan, dtype=torch.float64, device=observations.normal.device)
    direction, point, away, mean_normal, angle = blank.clone(), blank.clone(), blank.clone(), blank.clone(), blank[:, 0].clone()
    for index, rows in observations.by_count():
        normal = observations.normal[rows]
        axes, foot, angle[index] = preliminary_lines(normal, observations.centre[rows])
        mean_normal[index] = axes[:, 0]
        solvable = angle[index] > SMALLEST_ANGLE_RAD
        kept = index[solvable]
        direction[kept], point[kept] = axes[solvable, 2], foot[solvable]
        gap = widest_gap(normal[solvable], axes[solvable])
        # Of its two ends the one on the side of the cameras, so that the choice moves with the scene.
        side = (gap * (observations.centre[rows[solvable]].mean(1) - foot[solvable])).sum(-1, keepdim=True)
        away[kept] = torch.where(side < 0, -gap, gap)
    lines = PlueckerLines(direction, torch.linalg.cross(point, direction))
    focus, unit = _focus_and_unit(observations, lines, point)
    return TrackFrames(lines, angle, focus, unit, away, mean_normal)


def _focus_and_unit(observations: PlaneObservations, lines: PlueckerLines, point: Tensor) -> tuple[Tensor, Tensor]:
    solvable = torch.isfinite(point).all(-1)[observations.track]
    track, centre = observations.track[solvable], observations.centre[solvable]
    distance = lines[track].distance_to(centre)
    unit = weighted_median_by_group(distance, torch.ones_like(distance), track, observations.tracks)
    if observations.arcs is None:
        return point, unit
    upright = torch.eye(3, dtype=centre.dtype, device=centre.device).expand(len(track), 3, 3)
    ends, _ = segment_ends(lines, Pose(upright, -centre), observations.arcs[solvable], track)
    half = 0.5 * (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    seen = torch.isfinite(half)
    focus = torch.where(seen[:, None], ends.mean(1), point)
    return focus, torch.where(seen, torch.maximum(half, SHORTEST_SEGMENT * unit), unit)


def solvable_groups(observations: PlaneObservations, frames: TrackFrames) -> list[TrackGroup]:
    """The tracks that can be solved for, grouped by their number of views."""
    groups = []
    usable = torch.isfinite(frames.origin).all(-1) & (frames.unit > 0)
    for index, rows in observations.by_count():
        keep = usable[index]
        kept, rows_kept = index[keep], rows[keep]
        groups.append(
            TrackGroup(
                kept,
                rows_kept,
                observations.normal[rows_kept],
                observations.centre[rows_kept],
                frames.focus[kept],
                frames.origin[kept],
                frames.unit[kept],
            )
        )
    return [group for group in groups if len(group.tracks)]
