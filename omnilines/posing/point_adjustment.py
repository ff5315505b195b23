"""Poses and points refined together from bearings, on the whole sphere; rigs move as one, cameras are held.

    minimise  sum_i loss(|r_i|^2),   r_i the residual of bearing i in standard deviations (bearing_residual.py),

over rig_from_world of every frame (a photo alone is its own frame) and every point. Points are the eliminated blocks. Bearings
leave a similarity of the world open, or a rigid motion where a rig has a baseline: the step is kept across it.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose, adjoint
from omnilines.least_squares import KeptGroup, Linearisation, Loss, Outcome, Structure, solve
from omnilines.posing.bearing_residual import bearing_residual, by_pose, placed
from omnilines.posing.tracks import Observations

BEND = 2.0
GROSS = 4.0
MOST_ITERATIONS = 40
TOLERANCE = 1e-7


@dataclass(frozen=True)
class Frames:
    """Which frame every photo belongs to, and where its camera is there."""

    of_photo: Int[Tensor, " photos"]
    cam_from_rig: Pose
    """Of every photo."""

    @property
    def has_scale(self) -> bool:
        """Whether some frame of two photos has a baseline."""
        centre = self.cam_from_rig.centre
        return bool(((centre - centre[:1]).norm(dim=-1) > 1e-9).any())

    def photos(self, rig_from_world: Pose) -> Pose:
        """cam_from_world of every photo."""
        return self.cam_from_rig @ rig_from_world[self.of_photo]


@dataclass(frozen=True)
class PosesAndPoints:
    """What is estimated."""

    rig_from_world: Pose
    """Of every frame."""
    points: Float[Tensor, "p 3"]


class PointProblem:
    """Frames that observe nothing are held."""

    def __init__(self, seen: Observations, frames: Frames, points: int, count: int) -> None:
        self.seen, self.frames = seen, frames
        self.frame = frames.of_photo[seen.photo]
        observed = torch.bincount(self.frame, minlength=count) > 0
        self.free = torch.nonzero(observed).flatten()
        place = torch.full((count,), -1)
        place[self.free] = torch.arange(len(self.free))
        self.structure = Structure(seen.point, points, 3, (KeptGroup(place[self.frame], len(self.free), 6),))

    def linearise(self, state: PosesAndPoints) -> Linearisation:
        """Residuals and their analytic Jacobians."""
        seen, cam_from_rig = self.seen, self.frames.cam_from_rig[self.seen.photo]
        pose = cam_from_rig @ state.rig_from_world[self.frame]
        at = placed(pose, state.points[seen.point])
        residual, by_point = bearing_residual(seen.bearings, seen.rows, at)
        return Linearisation(residual, by_point @ pose.rotation, (by_pose(by_point, at) @ adjoint(cam_from_rig),))

    def retract(self, state: PosesAndPoints, kept: Float[Tensor, " k"], eliminated: Float[Tensor, "count 3"]) -> PosesAndPoints:
        """exp(delta) T for frames."""
        step = torch.zeros(len(state.rig_from_world), 6, dtype=torch.float64)
        step[self.free] = kept.view(-1, 6)
        return PosesAndPoints(Pose.exp(step) @ state.rig_from_world, state.points + eliminated)

    def gauge(self, state: PosesAndPoints) -> Float[Tensor, "k g"]:
        """Columns for a common motion of all frames, and for the scale about their centres' mean where it is open."""
        pose = state.rig_from_world[self.free]
        centre = pose.centre
        about = Pose(torch.eye(3, dtype=torch.float64).expand(len(pose), 3, 3), -centre.mean(0).expand(len(pose), 3))
        columns = adjoint(pose @ about.inverse())
        if not self.frames.has_scale:
            arm = (pose.rotation @ (centre - centre.mean(0))[..., None])[..., 0]
            scale = torch.cat([torch.zeros_like(arm), -arm], -1)
            columns = torch.cat([columns, scale[..., None]], -1)
        return columns.flatten(0, 1)


@dataclass(frozen=True)
class Adjusted:
    """Poses and points after the adjustment."""

    state: PosesAndPoints
    residual: Float[Tensor, " n"]
    """Of every observation, in standard deviations."""
    scale: float
    """What a standard deviation turned out to be, from the residuals that are not gross errors and their degrees of freedom."""
    covariance: Float[np.ndarray, "f 6 6"]
    """Of every frame's left perturbation, for observations of that scale; NaN for frames that observe nothing."""
    converged: bool


def adjust_points(seen: Observations, frames: Frames, start: PosesAndPoints) -> Adjusted:
    """Poses and points with the least robust cost near a start."""
    count = len(start.rig_from_world)
    problem = PointProblem(seen, frames, len(start.points), count)
    solution = solve(problem, start, Loss("cauchy", BEND), MOST_ITERATIONS, TOLERANCE)
    residual = problem.linearise(solution.state).residual
    norm = residual.norm(dim=-1)
    scale = _scale(norm, 3 * len(start.points) + 6 * len(problem.free))
    covariance = np.full((count, 6, 6), np.nan)
    kept = solution.kept_covariance()
    for k, frame in enumerate(problem.free.tolist()):
        covariance[frame] = scale**2 * kept[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].numpy()
    good = solution.outcome in (Outcome.CONVERGED, Outcome.OUT_OF_ITERATIONS)
    return Adjusted(solution.state, norm, scale, covariance, good)


def _scale(norm: Float[Tensor, " n"], unknowns: int) -> float:
    """sqrt(sum |r|^2 / freedom) over what lies within GROSS times the median's estimate (the median of |r|^2 is 2 ln 2)."""
    typical = norm.median() / math.sqrt(2 * math.log(2)) * math.sqrt(2 * len(norm) / max(1, 2 * len(norm) - unknowns))
    fair = norm[norm <= GROSS * typical]
    return float((fair.square().sum() / max(1, 2 * len(fair) - unknowns)).sqrt())
