"""Poses and points refined together from bearings, on the whole sphere; rigs move as one, cameras are held.

    minimise  sum_i loss(|r_i|^2),   r_i the residual of bearing i in standard deviations (bearing_residual.py),

over rig_from_world of every frame (a photo alone is its own frame) and every point. Points are the eliminated blocks
(kernels/point.py). Bearings leave a similarity of the world open, or a rigid motion where a rig has a baseline: the step is kept
across it, and covariances weigh every frame by what is known of it (`least_squares/datum.py`).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose, adjoint
from omnilines.least_squares import Outcome, Step, minimise
from omnilines.least_squares.datum import pose_weights
from omnilines.least_squares.pattern import narrower_order, pair_pattern, summed_pieces
from omnilines.least_squares.reduced_system import ReducedSystem
from omnilines.posing.kernels import point as point_kernel
from omnilines.posing.kernels.point import FrameSums, PointBlocks, Sightings
from omnilines.posing.options import ResectionOptions
from omnilines.posing.tracks import Observations
from omnilines.progress import in_shares

MAX_ITERATIONS = 40
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


@dataclass(frozen=True)
class _Reduction:
    """What one pass over the points gives."""

    solved: PointBlocks
    system: ReducedSystem
    right: Float[np.ndarray, " k"]
    gradient: Float[np.ndarray, " k"]
    """Of the frames themselves, before the reduction."""
    own: Float[np.ndarray, "free 6 6"]
    """What every frame's observations say of it while the points stay, undamped."""


class PointEngine:
    """An `Engine` (least_squares) of one problem. Frames that observe nothing are held; the others have places, in an order that
    makes the band of the reduced system narrow. Observations are sorted by point and place."""

    def __init__(self, seen: Observations, frames: Frames, points: int, loss_scale: float) -> None:
        self.frames, self.points, self.residuals = frames, points, 2 * len(seen)
        frame, point = frames.of_photo[seen.photo].numpy(), seen.point.numpy()
        self.free = np.unique(frame)
        start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=points))])

        def laid_out() -> np.ndarray:
            place = np.full(int(frames.of_photo.max()) + 1, -1)
            place[self.free] = np.arange(len(self.free))
            self.order = np.argsort(point * len(self.free) + place[frame], kind="stable")
            return place[frame][self.order]

        places = laid_out()
        self.pattern = pair_pattern(start, places, len(self.free))
        better = narrower_order(self.pattern)
        if better is not None:
            self.free = self.free[better]
            places = laid_out()
            self.pattern = pair_pattern(start, places, len(self.free))
        own = frames.cam_from_rig[seen.photo[self.order]]
        bearings = (own.rotation.mT @ seen.bearings[self.order, :, None])[..., 0]
        rows = seen.rows[self.order] @ own.rotation
        b, p, arm = (np.ascontiguousarray(array.numpy()) for array in (bearings, rows, own.centre))
        self.seen = Sightings(start, places, b, p, arm, loss_scale)
        self.shares = summed_pieces(start, self.pattern)

    def cost(self, state: PosesAndPoints) -> float:
        """Sum of the loss."""
        pose, at = self._arrays(state)
        return sum(in_shares(lambda _, low, high: point_kernel.cost_of_points(low, high, self.seen, pose, at), self.shares))

    def step(self, state: PosesAndPoints, damping: float) -> Step[PosesAndPoints] | None:
        """The step of frames and points from a state; None where the equations are singular."""
        found = self.reduce(state, damping)
        if found is None:
            return None
        kept = found.system.solve(found.right[:, None])[:, 0]
        if not np.isfinite(kept).all():
            return None
        step = kept.reshape(-1, 6)
        whole = torch.zeros(len(state.rig_from_world), 6, dtype=torch.float64)
        whole[torch.from_numpy(self.free)] = torch.from_numpy(step)
        trial = PosesAndPoints(Pose.exp(whole) @ state.rig_from_world, torch.empty_like(state.points))
        (pose, at), (moved_pose, moved) = self._arrays(state), self._arrays(trial)

        def follow(_: int, low: int, high: int) -> tuple[float, float]:
            return point_kernel.follow_frames(low, high, self.seen, pose, moved_pose, step, at, damping, found.solved, moved)

        parts = in_shares(follow, self.shares)
        diagonal = found.own.diagonal(axis1=1, axis2=2).ravel()
        promised = float((kept * (found.gradient + damping * kept * diagonal)).sum())
        return Step(trial, float(sum(part[0] for part in parts)), promised + float(sum(part[1] for part in parts)))

    def reduce(self, state: PosesAndPoints, damping: float) -> _Reduction | None:
        """One pass over the points; None where the frames are not determined, or with damping a point is not. Without, such a
        point takes no part: one in the direction of a walk has no distance, and says nothing of the poses."""
        pose, at = self._arrays(state)
        solved = PointBlocks(np.empty((self.points, 6)), np.empty((self.points, 3)), np.empty((self.points, 3)))
        free, blocks = len(self.free), len(self.pattern.row)
        sums = [FrameSums(np.zeros((blocks, 6, 6)), np.zeros((free, 12)), np.zeros((free, 6, 6))) for _ in self.shares[1:]]
        window, block_of = self.pattern.window, self.pattern.block_of

        def share(k: int, low: int, high: int) -> int:
            return point_kernel.reduce_points(low, high, self.seen, pose, at, damping, window, block_of, sums[k], solved)

        singular = sum(in_shares(share, self.shares))
        if singular and damping > 0.0:
            return None
        total = FrameSums(*(np.sum(arrays, axis=0) for arrays in zip(*sums, strict=True)))
        within = np.arange(6)
        total.blocks[self.pattern.diagonal[:, None], within, within] += damping * total.own[:, within, within]
        system = ReducedSystem.of(self.pattern, total.blocks, self._gauge(state), damping, self._step_sizes(state))
        if system is None:
            return None
        own = np.triu(total.own) + np.triu(total.own, 1).transpose(0, 2, 1)
        return _Reduction(solved, system, total.gradient[:, :6].ravel(), total.gradient[:, 6:].ravel(), own)

    def in_datum(self, state: PosesAndPoints) -> ReducedSystem | None:
        """The undamped system of the frames with a place, each weighed by what is known of it; None where the observations do not
        determine them."""
        found = self.reduce(state, 0.0)
        if found is None:
            return None
        centre = state.rig_from_world[torch.from_numpy(self.free)].centre[torch.from_numpy(self.seen.frame)]
        of_sighting = torch.from_numpy(np.repeat(np.arange(self.points), np.diff(self.seen.start)))
        distance_m = float((state.points[of_sighting] - centre).norm(dim=-1).median())
        return found.system.in_datum(pose_weights(found.own, distance_m))

    def norms(self, state: PosesAndPoints) -> Float[Tensor, " n"]:
        """|r| of every observation, in the order in which they were given."""
        norm, back = np.empty(len(self.order)), np.empty(len(self.order))
        point_kernel.residual_norms(self.seen, *self._arrays(state), norm)
        back[self.order] = norm
        return torch.from_numpy(back)

    def _arrays(self, state: PosesAndPoints) -> tuple[Float[np.ndarray, "free 12"], Float[np.ndarray, "p 3"]]:
        pose = state.rig_from_world[torch.from_numpy(self.free)]
        return torch.cat([pose.rotation.flatten(1), pose.translation], 1).numpy(), state.points.numpy()

    def _step_sizes(self, state: PosesAndPoints) -> Float[np.ndarray, " k"]:
        """A radian, and how far the cameras are from their mean, for every frame: no step depends on the unit of length."""
        centre = state.rig_from_world[torch.from_numpy(self.free)].centre
        size = float((centre - centre.mean(0)).square().sum(-1).mean().sqrt())
        return np.tile(np.repeat([1.0, size if size > 0 else 1.0], 3), len(self.free))

    def _gauge(self, state: PosesAndPoints) -> Float[np.ndarray, "k g"]:
        """Columns for a common motion of all frames, and for the scale about their centres' mean where it is open."""
        pose = state.rig_from_world[torch.from_numpy(self.free)]
        centre = pose.centre
        about = Pose(torch.eye(3, dtype=torch.float64).expand(len(pose), 3, 3), -centre.mean(0).expand(len(pose), 3))
        columns = adjoint(pose @ about.inverse())
        if not self.frames.has_scale:
            arm = (pose.rotation @ (centre - centre.mean(0))[..., None])[..., 0]
            scale = torch.cat([torch.zeros_like(arm), -arm], -1)
            columns = torch.cat([columns, scale[..., None]], -1)
        return columns.flatten(0, 1).numpy()


@dataclass(frozen=True)
class Adjusted:
    """Poses and points after the adjustment."""

    state: PosesAndPoints
    residual: Float[Tensor, " n"]
    """Of every observation, in standard deviations."""
    scale: float
    """What a standard deviation turned out to be, from the residuals that are not gross errors and their degrees of freedom."""
    covariance: Float[np.ndarray, "f 6 6"]
    """Of every frame's left perturbation, for observations of that scale, in the frame nearest to the truth, each weighed by what
    is known of it; NaN for frames that observe nothing or are not determined."""
    converged: bool


def adjust_points(
    seen: Observations, frames: Frames, start: PosesAndPoints, options: ResectionOptions = ResectionOptions()
) -> Adjusted:
    """Poses and points with the least robust cost near a start; every point needs two observations."""
    engine = PointEngine(seen, frames, len(start.points), options.loss_scale)
    found = minimise(engine, start, MAX_ITERATIONS, tolerance=TOLERANCE)
    norm = engine.norms(found.state)
    scale = _scale(norm, 3 * len(start.points) + 6 * len(engine.free), options.gross_sigmas)
    covariance = np.full((len(start.rig_from_world), 6, 6), np.nan)
    system = engine.in_datum(found.state)
    if system is not None:
        covariance[engine.free] = scale**2 * system.covariance_blocks()[engine.pattern.diagonal]
    good = system is not None and found.outcome in (Outcome.CONVERGED, Outcome.OUT_OF_ITERATIONS)
    return Adjusted(found.state, norm, scale, covariance, good)


def _scale(norm: Float[Tensor, " n"], unknowns: int, gross: float) -> float:
    """sqrt(sum |r|^2 / freedom) over what lies within `gross` times the median's estimate (the median of |r|^2 is 2 ln 2)."""
    typical = norm.median() / math.sqrt(2 * math.log(2)) * math.sqrt(2 * len(norm) / max(1, 2 * len(norm) - unknowns))
    fair = norm[norm <= gross * typical]
    return float((fair.square().sum() / max(1, 2 * len(fair) - unknowns)).sqrt())
