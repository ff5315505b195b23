"""Pluecker lines L = (d, m): |d| = 1, m = X x d for any point X of the line, so |m| is its distance from the origin (2.1)."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose

PARALLEL = 1e-9
"""Sine of the angle below which two directions count as parallel."""


@dataclass(frozen=True)
class PlueckerLines:
    """A batch of lines in one frame. (d, m) and (-d, -m) are the same line. Points given to a method broadcast with the batch."""

    direction: Float[Tensor, "*batch 3"]
    """Unit direction d."""
    moment: Float[Tensor, "*batch 3"]
    """m = X x d (metres), orthogonal to d."""

    @staticmethod
    def from_points(first: Float[Tensor, "*batch 3"], second: Float[Tensor, "*batch 3"]) -> "PlueckerLines":
        """The lines from one point to another; NaN where they coincide."""
        direction = second - first
        direction = direction / direction.norm(dim=-1, keepdim=True)
        return PlueckerLines(direction, torch.linalg.cross(first, direction))

    @staticmethod
    def through(point: Float[Tensor, "*batch 3"], direction: Float[Tensor, "*batch 3"]) -> "PlueckerLines":
        """The lines through a point along a direction of any length."""
        direction = direction / direction.norm(dim=-1, keepdim=True)
        return PlueckerLines(direction, torch.linalg.cross(point, direction))

    @staticmethod
    def from_planes(
        n1: Float[Tensor, "*batch 3"], s1: Float[Tensor, "*batch"], n2: Float[Tensor, "*batch 3"], s2: Float[Tensor, "*batch"]
    ) -> "PlueckerLines":
        """Intersections of the planes n . X + s = 0 (n of any length): d ~ n1 x n2, m ~ s1 n2 - s2 n1; NaN where parallel."""
        cross = torch.linalg.cross(n1, n2)
        length = cross.norm(dim=-1, keepdim=True)
        return PlueckerLines(cross / length, (s1[..., None] * n2 - s2[..., None] * n1) / length)

    def __getitem__(self, index: Any) -> "PlueckerLines":
        return PlueckerLines(self.direction[index], self.moment[index])

    def __len__(self) -> int:
        return self.direction.shape[0]

    @property
    def foot(self) -> Float[Tensor, "*batch 3"]:
        """The point closest to the origin, d x m. Positions along a line are measured from it."""
        return torch.linalg.cross(self.direction, self.moment)

    def point_at(self, position: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """The point at a signed distance (m) along the direction from `foot`."""
        return self.foot + position[..., None] * self.direction

    def moment_about(self, centre: Float[Tensor, "*points 3"]) -> Float[Tensor, "*out 3"]:
        """m - c x d: the moment with respect to another point; its length is the distance of c from the line."""
        return self.moment - torch.linalg.cross(centre, self.direction)

    def shifted(self, origin: Float[Tensor, "*points 3"]) -> "PlueckerLines":
        """The same lines in coordinates whose origin is moved to a point."""
        return PlueckerLines(self.direction, self.moment_about(origin))

    def transform(self, a_from_b: Pose) -> "PlueckerLines":
        """The lines in frame a: d' = R d, m' = R m + t x R d (4.15)."""
        direction = (a_from_b.rotation @ self.direction[..., None]).squeeze(-1)
        moment = (a_from_b.rotation @ self.moment[..., None]).squeeze(-1)
        return PlueckerLines(direction, moment + torch.linalg.cross(a_from_b.translation, direction))

    def projection_normal(self, cam_from_world: Pose) -> Float[Tensor, "*batch 3"]:
        """M = R (m - C x d) = R m + t x R d: normal of the plane through camera and line, camera frame, not normalised (4.16)."""
        return (cam_from_world.rotation @ self.moment_about(cam_from_world.centre)[..., None]).squeeze(-1)

    def closest_point(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*out 3"]:
        """The point of each line closest to a point."""
        return points + torch.linalg.cross(self.direction, self.moment_about(points))

    def distance_to(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*out"]:
        """Distance (m) of points from the lines, |m - X x d| (2.4)."""
        return self.moment_about(points).norm(dim=-1)

    def distance_between(self, other: "PlueckerLines") -> Float[Tensor, "*batch"]:
        """Shortest distance (m) between two lines: |d1 . m2 + d2 . m1| / |d1 x d2|, and across the direction where parallel."""
        normal = torch.linalg.cross(self.direction, other.direction)
        sine = normal.norm(dim=-1)
        between = other.foot - self.foot
        skew = (between * normal).sum(-1).abs() / torch.where(sine > PARALLEL, sine, torch.ones_like(sine))
        return torch.where(sine > PARALLEL, skew, torch.linalg.cross(between, self.direction).norm(dim=-1))

    def angle_to(self, other: "PlueckerLines") -> Float[Tensor, "*batch"]:
        """Angle (rad, in [0, pi/2]) between two lines, whatever the signs of their directions."""
        sine = torch.linalg.cross(self.direction, other.direction).norm(dim=-1)
        return torch.atan2(sine, (self.direction * other.direction).sum(-1).abs())

    def position_seen(
        self, centre: Float[Tensor, "*batch 3"], bearing: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Bool[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Where a bearing (unit, world frame) meets each line: position (m), in front, |d position / d bearing| (m/rad).

        The bearing is first moved onto the plane of centre and line. With e the direction to the point of the line nearest to
        the centre, at distance h, the position there is h tan(beta), tan(beta) = V.d / V.e. `in_front` is false where V.e <= 0:
        the bearing points past the vanishing point of the line or away from it, and the position means nothing.
        """
        moment = self.moment_about(centre)
        distance = moment.norm(dim=-1)
        to_foot = torch.linalg.cross(self.direction, moment)
        along = (bearing * self.direction).sum(-1)
        towards = (bearing * to_foot).sum(-1)
        in_front = towards > 0
        safe = torch.where(in_front, towards, torch.ones_like(towards))
        offset = distance**2 * along / safe
        positions = (centre * self.direction).sum(-1) + offset
        leverage = (distance**2 + offset**2) / torch.where(distance > 0, distance, torch.ones_like(distance))
        return positions, in_front, leverage


def segment_ends(
    lines: PlueckerLines,
    cam_from_world: Pose,
    bearings: Float[Tensor, "n 2 3"],
    track: Int[Tensor, " n"],
) -> tuple[Float[Tensor, "t 2 3"], Float[Tensor, "n 2"]]:
    """End points (m) of t lines, and the position (m) along its line of both observed ends of each of n arcs (NaN if behind).

    `lines` holds one line per track; pose, arc (end bearings, camera frame) and track index are one per observation. Each end of
    a line is the median of the matching ends of its arcs, each weighted by the inverse of how fast the position moves with the
    bearing: up to half of that weight may stray. NaN for a line without an arc that is wholly in front of its camera.
    """
    centre = cam_from_world.centre
    world = bearings @ cam_from_world.rotation
    per_end = PlueckerLines(lines.direction[track][:, None].expand(-1, 2, -1), lines.moment[track][:, None].expand(-1, 2, -1))
    positions, in_front, leverage = per_end.position_seen(centre[:, None].expand(-1, 2, -1), world)
    usable = in_front.all(-1) & torch.isfinite(positions).all(-1)
    order = positions.argsort(-1)
    ordered, weight = positions.gather(-1, order), 1 / leverage.gather(-1, order).clamp_min(1e-300)
    medians = [weighted_median_by_group(ordered[usable, end], weight[usable, end], track[usable], len(lines)) for end in range(2)]
    ends = torch.stack([lines.point_at(position) for position in medians], 1)
    return ends, torch.where(usable[:, None], positions, torch.full_like(positions, torch.nan))


def weighted_median_by_group(
    values: Float[Tensor, " n"], weights: Float[Tensor, " n"], group: Int[Tensor, " n"], groups: int
) -> Float[Tensor, " groups"]:
    """Weighted median of the values of each group, the mean of both neighbours where the weight splits evenly; NaN if empty."""
    order = values.argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    v, w, g = values[order], weights[order], group[order]
    total = torch.zeros(groups, dtype=v.dtype, device=v.device).index_add(0, g, w)
    share = w / total[g]
    counts = torch.bincount(g, minlength=groups)
    running = share.cumsum(0)
    before_group = torch.cat([torch.zeros(1, dtype=v.dtype, device=v.device), running])[counts.cumsum(0) - counts]
    running = running - before_group[g]
    # The first value whose running share reaches a half, and the first that passes it; shares sum to one within rounding.
    lower = _first_of_group(v, g, running >= 0.5 - 1e-9, groups)
    upper = _first_of_group(v, g, running > 0.5 + 1e-9, groups)
    return 0.5 * (lower + upper)


def _first_of_group(values: Tensor, group: Tensor, chosen: Tensor, groups: int) -> Tensor:
    """The first chosen value of each group (values are sorted by group), NaN where none is."""
    rows = torch.arange(len(values), device=group.device)
    first = torch.full((groups,), len(values), device=group.device).scatter_reduce(0, group[chosen], rows[chosen], "amin")
    return torch.cat([values, values.new_full((1,), torch.nan)])[first]


def end_radius_sigmas(ends: int = 1) -> float:
    """Distance, in `sigma_m`, within which so many ends of a line lie from the true one, with a probability of 0.95 or more.

    A normal error of two coordinates of that standard deviation or less is beyond r of them with exp(-r^2 / 2) at most, and both
    ends are inside at least as often as if they did not depend on each other (T. Royen, 2014): 2.45 for one, 2.72 for both.
    """
    return math.sqrt(-2.0 * math.log(1.0 - 0.95 ** (1.0 / ends)))
