"""Errors of lines against the truth, and the Cramer-Rao bound that is projected in the same way.

With X the two known points of each line, Q = I - d d' and e = Q (X_true - X) after the similarity that brings the lines closest,
e = (I - A A+) delta for errors delta of the lines, A = Q [ -[X]x  I  X ] the motion by turns, shifts and scale
(`omnilines.adjustment.accuracy`, here for many trials at once). The bound is the RMS of e for delta of the covariance (J'J)^-1 of
the whitened residuals at the truth.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import GeometryError
from camera_models.pose import Pose, hat, rotation_from_vector
from omnilines.adjustment.accuracy import align_lines
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import adjust_lines, motion_across
from omnilines.geometry.line import PlueckerLines
from omnilines.synthetic.lines import LineWorld

ITERATIONS, HALVINGS = 50, 20
TOLERANCE = 1e-10
"""Step (rad, or relative to the size of the scene) at which an alignment has converged."""
FEWEST_LINES = 3


@dataclass(frozen=True)
class _Motion:
    """X -> scale R X + t, one for each of T trials."""

    scale: Float[Tensor, " T"]
    pose: Pose

    def lines(self, lines: PlueckerLines) -> PlueckerLines:
        """The moved lines (T, L)."""
        direction = lines.direction @ self.pose.rotation.mT
        moment = self.scale[:, None, None] * (lines.moment @ self.pose.rotation.mT)
        shift = self.pose.translation[:, None].expand_as(direction)
        return PlueckerLines(direction, moment + torch.linalg.cross(shift, direction))

    def stepped(self, step: Float[Tensor, "T 7"]) -> "_Motion":
        """After a turn, a shift and a relative change of scale about the origin."""
        growth, turn = torch.exp(step[:, 6]), rotation_from_vector(step[:, :3])
        translation = growth[:, None] * (turn @ self.pose.translation[..., None])[..., 0] + step[:, 3:6]
        return _Motion(self.scale * growth, Pose(turn @ self.pose.rotation, translation))


def _by_motion(direction: Float[Tensor, "*t 3"], points: Float[Tensor, "*t 2 3"]) -> Float[Tensor, "*t 2 3 7"]:
    """A: how points move across their lines with a turn (rad), a shift and a relative change of scale about the origin."""
    eye = torch.eye(3, dtype=points.dtype)
    across = (eye - direction[..., :, None] * direction[..., None, :])[..., None, :, :]
    return across @ torch.cat([-hat(points), eye.expand(*points.shape, 3), points[..., None]], -1)


def aligned_rms_m(
    lines: PlueckerLines, known: Bool[Tensor, "T L"], true_ends_m: Float[Tensor, "L 2 3"], *, with_scale: bool
) -> Float[Tensor, " T"]:
    """RMS distance of the true points from the known lines of each trial after the best similarity (7 parameters), or without
    scale after the best turn and shift (6), the dissertation's measure (section 5.1).

    `lines` (T, L) lie in a frame near that of the truth, where Gauss-Newton with halved steps starts. NaN where fewer than three
    lines are known or where it does not converge, since the lines are too far off.
    """
    centre = true_ends_m.reshape(-1, 3).mean(0)
    unit = (true_ends_m - centre).square().sum(-1).mean().sqrt()
    target, enough = (true_ends_m - centre) / unit, known.sum(-1) >= FEWEST_LINES
    # A line that is not known stands on its truth and has no weight.
    truth = PlueckerLines.from_points(target[:, 0], target[:, 1])
    local = lines.shifted(centre.expand_as(lines.direction))
    direction = torch.where(known[..., None], local.direction, truth.direction)
    local = PlueckerLines(direction, torch.where(known[..., None], local.moment / unit, truth.moment))
    weight = known[..., None, None].to(direction.dtype)
    shape = known.shape

    def errors(motion: _Motion) -> tuple[Tensor, Tensor, Tensor]:
        moved = motion.lines(local)
        points = moved[:, :, None].closest_point(target.expand(*shape, 2, 3))
        error = weight * (target - points)
        return error, error.square().sum((-1, -2, -3)), weight[..., None] * _by_motion(moved.direction, points)

    motion = _Motion(torch.ones(len(known), dtype=direction.dtype), Pose.identity(len(known)))
    error, cost, by_motion = errors(motion)
    settled = ~enough
    for _ in range(ITERATIONS):
        jacobian = by_motion.flatten(1, 3)[..., : 7 if with_scale else 6]
        step = (torch.linalg.pinv(jacobian) @ error.flatten(1)[..., None])[..., 0]
        step = torch.nn.functional.pad(step, (0, 7 - step.shape[-1]))
        settled = settled | (step.abs().amax(-1) < TOLERANCE)
        if bool(settled.all()):
            break
        step = step * ~settled[:, None]
        for halving in range(HALVINGS + 1):
            trial = motion.stepped(step)
            found = errors(trial)
            worse = found[1] > cost
            if not bool(worse.any()):
                break
            # A step that no halving makes decrease the distances is one of rounding.
            settled = settled | (worse & (halving == HALVINGS - 1))
            step = torch.where(worse[:, None], 0.5 * step * ~settled[:, None], step)
        motion, (error, cost, by_motion) = trial, found
    rms = unit * (cost / (2 * known.sum(-1))).sqrt()
    return torch.where(settled & enough, rms, torch.full_like(rms, math.nan))


@dataclass(frozen=True)
class Bound:
    """The Cramer-Rao bound for noise of 1 px on every coordinate of the end points; it is proportional to the noise."""

    rms_m: float
    """Of the errors at both points of every line, after the alignment."""
    rms_px: float
    """Of the residuals of an efficient estimate at the end points, across the lines: sqrt((2 n - parameters) / 2 n)."""


def cramer_rao_bound(world: LineWorld, refine_poses: bool) -> Bound:
    """The least RMS error that any unbiased estimate of the lines of a scene can have, with poses known or estimated too.

    Raises GeometryError where the scene does not determine its lines.
    """
    arcs = arcs_from_segments(world.segments(0.0, 0), world.poses(), {"cam0": world.camera}).arcs
    truth = PlueckerLines.from_points(world.ends_m[:, 0], world.ends_m[:, 1])
    at_truth = adjust_lines(arcs, truth, world.cam_from_world, cost="whitened", refine_poses=refine_poses)
    chart = at_truth.state.chart
    if refine_poses:
        joint = at_truth.whitened.joint_eliminated_covariance(torch.arange(len(chart)))
    else:
        joint = torch.block_diag(*at_truth.whitened.eliminated_covariance())
    aligned = align_lines(chart.lines(), world.ends_m, world.ends_m)
    across = aligned.scale * aligned.pose.rotation @ motion_across(chart, aligned.unaligned_points_m)
    spread = torch.block_diag(*across.flatten(1, 2))
    free = _by_motion(aligned.lines.direction, aligned.points_m).reshape(-1, 7)
    projected = spread - free @ (torch.linalg.pinv(free) @ spread)
    variance = float(((projected @ joint) * projected).sum()) / (2 * len(chart))
    if not math.isfinite(variance):
        raise GeometryError("A scene that determines its lines was expected, found one that does not; draw it with another seed.")
    parameters = 4 * world.lines + (6 * world.images - 7 if refine_poses else 0)
    return Bound(math.sqrt(variance), math.sqrt(1 - parameters / (2 * len(arcs))))
