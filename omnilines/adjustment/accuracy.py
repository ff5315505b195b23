"""Adjusted lines against known ones: the similarity that bearings leave open, and the error that the covariance predicts.

A line has no end points of its own, so only what lies across it counts. With X the two known points of each line, Q = I - d d'
and the aligned line, e = Q (X_true - X) is minimised over the similarity, whose derivative is A = Q [ -[X]x  I  X ]. Then, to
first order, e = (I - A A+) delta for errors delta of the lines in any gauge: A spans all gauges, so e does not depend on it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.errors import GeometryError
from camera_models.pose import Pose, hat
from camera_models.rotations import similarity_alignment
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import adjust_lines, motion_across
from omnilines.geometry.line import PlueckerLines
from omnilines.least_squares import Outcome

ALIGNMENT_ITERATIONS = 200
HALVINGS = 40
"""A step that no halving makes decrease the distances is one of rounding: the alignment is as good as it gets."""
ALIGNMENT_TOLERANCE = 1e-13
"""Step (rad, or relative to the size of the scene) at which the alignment has converged."""


@dataclass(frozen=True)
class AlignedLines:
    """Estimated lines after the best similarity, X_true ~ scale R X + t."""

    scale: float
    pose: Pose
    """(R, t) of the similarity."""
    lines: PlueckerLines
    """Aligned, in the frame of the truth."""
    points_m: Float[Tensor, "t 2 3"]
    """The point of each aligned line nearest to each of its known points."""
    error_m: Float[Tensor, "t 2 3"]
    """Known points minus `points_m`: across the lines."""

    @property
    def rms_m(self) -> float:
        """RMS over lines and both points."""
        return float(self.error_m.square().sum(-1).mean().sqrt())

    @property
    def unaligned_points_m(self) -> Float[Tensor, "t 2 3"]:
        """`points_m` in the frame of the estimate."""
        return (self.points_m - self.pose.translation) @ self.pose.rotation / self.scale

    def transform_poses(self, cam_from_world: Pose) -> Pose:
        """Poses of the same cameras in the frame of the truth."""
        rotation = cam_from_world.rotation @ self.pose.rotation.mT
        moved = (rotation @ self.pose.translation[..., None])[..., 0]
        return Pose(rotation, self.scale * cam_from_world.translation - moved)


def _similar(lines: PlueckerLines, scale: Tensor, pose: Pose) -> PlueckerLines:
    count = len(lines)
    common = Pose(pose.rotation.expand(count, 3, 3), pose.translation.expand(count, 3))
    return PlueckerLines(lines.direction, scale * lines.moment).transform(common)


def _across(direction: Float[Tensor, "t 3"]) -> Float[Tensor, "t 1 3 3"]:
    """Q = I - d d', for both points of each line."""
    eye = torch.eye(3, dtype=direction.dtype, device=direction.device)
    return (eye - direction[:, :, None] * direction[:, None, :])[:, None]


def _by_similarity(lines: PlueckerLines, points: Float[Tensor, "t 2 3"]) -> Float[Tensor, "t 2 3 7"]:
    """A: motion across the lines for a turn (rad), a shift and a relative change of scale about the origin."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape, 3)
    return _across(lines.direction) @ torch.cat([-hat(points), eye, points[..., None]], -1)


def _stepped(scale: Tensor, pose: Pose, step: Float[Tensor, "7"]) -> tuple[Tensor, Pose]:
    """The similarity after a turn, a shift and a relative change of scale about the origin."""
    turn = Pose.exp(torch.cat([step[:3], step.new_zeros(3)])).rotation
    growth = torch.exp(step[6])
    return scale * growth, Pose(turn @ pose.rotation, growth * (turn @ pose.translation) + step[3:6])


def align_lines(lines: PlueckerLines, ends_m: Float[Tensor, "t 2 3"], true_ends_m: Float[Tensor, "t 2 3"]) -> AlignedLines:
    """The similarity that brings lines closest to two known points of each, least squares across the lines.

    `ends_m` are points of the lines that correspond to the known ones roughly: they give the start (Umeyama), and Gauss-Newton
    from it needs no correspondence along the lines. Raises GeometryError for points on one line or no convergence.
    """
    scale, pose = similarity_alignment(ends_m.reshape(-1, 3), true_ends_m.reshape(-1, 3))
    # About the centroid and in units of the spread, turns, shifts and scale have commensurate derivatives.
    centroid = true_ends_m.reshape(-1, 3).mean(0)
    unit = (true_ends_m - centroid).square().sum(-1).mean().sqrt()
    target = (true_ends_m - centroid) / unit
    scale, pose = scale / unit, Pose(pose.rotation, (pose.translation - centroid) / unit)
    points = _similar(lines, scale, pose)[:, None].closest_point(target)
    for _ in range(ALIGNMENT_ITERATIONS):
        error = target - points
        jacobian = _by_similarity(_similar(lines, scale, pose), points).reshape(-1, 7)
        step = torch.linalg.pinv(jacobian) @ error.flatten()
        for _ in range(HALVINGS):
            next_scale, next_pose = _stepped(scale, pose, step)
            next_points = _similar(lines, next_scale, next_pose)[:, None].closest_point(target)
            if bool((target - next_points).square().sum() <= error.square().sum()):
                scale, pose, points = next_scale, next_pose, next_points
                break
            step = 0.5 * step
        else:
            break
        if float(step.abs().max()) < ALIGNMENT_TOLERANCE:
            break
    else:
        raise GeometryError(
            f"The similarity alignment of {len(lines)} lines was expected to converge, found that it does not: they are too far "
            "from the known ones; check that each line is given its own counterpart."
        )
    found = Pose(pose.rotation, unit * pose.translation + centroid)
    aligned = _similar(lines, scale * unit, found)
    points = aligned[:, None].closest_point(true_ends_m)
    return AlignedLines(float(scale * unit), found, aligned, points, true_ends_m - points)


@dataclass(frozen=True)
class PredictedError:
    """What an adjustment says about the error of its lines after alignment."""

    covariance: Float[Tensor, "t 2 3 t 2 3"]
    """Of `AlignedLines.error_m`, m^2."""

    @property
    def effective_freedom(self) -> float:
        """tr(C)^2 / tr(C^2) (Satterthwaite 1946): sum |e|^2 / tr(C) spreads like chi^2 over its freedom of so many degrees."""
        trace = float(torch.einsum("teitei->", self.covariance))
        return trace**2 / float(self.covariance.square().sum())

    @property
    def rms_m(self) -> float:
        """Expected RMS over lines and both points."""
        variance = torch.einsum("teitei->", self.covariance)
        return math.sqrt(float(variance) / (2 * self.covariance.shape[0]))

    @property
    def sigma_m(self) -> Float[Tensor, "t 2"]:
        """Largest standard deviation of each point in any direction."""
        blocks = torch.einsum("teitej->teij", self.covariance)
        return torch.linalg.eigvalsh(blocks)[..., -1].clamp_min(0).sqrt()


def predict_error(adjusted: Adjusted, aligned: AlignedLines) -> PredictedError:
    """The covariance of the aligned errors from the joint covariance of all lines of an adjustment, all of them observed."""
    chart = adjusted.state.chart
    tracks = torch.arange(len(chart))
    joint = adjusted.joint_line_covariance(tracks)
    # The points and their motion across the line in the adjustment's own frame, then in that of the truth.
    by_line = motion_across(chart, aligned.unaligned_points_m)
    moved = aligned.scale * (aligned.pose.rotation @ by_line)
    size = 6 * len(chart)
    spread = torch.zeros(len(chart), 6, len(chart), 4, dtype=moved.dtype)
    spread[tracks, :, tracks] = moved.reshape(len(chart), 6, 4)
    delta = spread.reshape(size, -1)
    free = _by_similarity(aligned.lines, aligned.points_m).reshape(size, 7)
    projected = delta - free @ (torch.linalg.pinv(free) @ delta)
    matrix = projected @ joint @ projected.mT
    return PredictedError(matrix.reshape(len(chart), 2, 3, len(chart), 2, 3))


def jackknife_error(arcs: MatchedArcs, adjusted: Adjusted, aligned: AlignedLines, cost: str = "sector") -> PredictedError:
    """The covariance of the aligned errors from the scatter between photos: each is left out in turn (Tukey 1958).

        C = (k - 1) / k sum (e_(i) - mean) (e_(i) - mean)'

    Errors that the end points of one photo have in common (blur, the lens where the board stands in it) count here,
    while `predict_error` takes every end point as independent. Every line has to stay determined without any one photo; raises
    GeometryError where one does not.
    """
    state = adjusted.state
    photos = torch.unique(arcs.image)
    errors = []
    for photo in photos.tolist():
        rest = arcs.rows(arcs.image != photo)
        if int(torch.bincount(rest.track, minlength=arcs.tracks).min()) < 2:
            raise GeometryError("Each line was expected in at least 3 photos, found one in fewer; the scatter cannot be told.")
        again = adjust_lines(rest, state.chart.lines(), state.cam_from_world, cost=cost)
        if again.outcome is Outcome.DEGENERATE:
            raise GeometryError("Lines that any one photo may be missing from were expected, found that they degenerate then.")
        lines = again.state.chart.lines()
        errors.append(align_lines(lines, aligned.unaligned_points_m, aligned.points_m + aligned.error_m).error_m)
    scatter = torch.stack(errors)
    scatter = scatter - scatter.mean(0)
    return PredictedError((len(photos) - 1) / len(photos) * torch.einsum("ktei,ksfj->teisfj", scatter, scatter))
