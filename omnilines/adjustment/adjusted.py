"""Adjusted lines, poses, cameras and rig, with the covariances of all."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import adjoint
from omnilines.adjustment.engine_solution import LineSolution
from omnilines.adjustment.noise import Noise
from omnilines.adjustment.parts_engine import PartsSolution
from omnilines.adjustment.problem import LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.adjustment.uncertainty import Uncertain
from omnilines.least_squares import Outcome, Solution


@dataclass(frozen=True)
class Adjusted:
    """Adjusted lines, poses, cameras and rig with their uncertainty."""

    state: LinesAndPoses
    outcome: Outcome
    initial_cost: float
    cost: float
    iterations: int
    line_covariance: Float[Tensor, "t 4 4"]
    """In the chart of `state.chart`; NaN for tracks without observations, zero for held lines."""
    pose_covariance: Float[Tensor, "images 6 6"]
    """Of the left perturbation of the pose of every photo, in the frame of `datum.py`; zero for held poses."""
    noise: Noise
    """Of the end points: what is stated, what the residuals say, and which of the two all covariances are for."""
    whitened: Solution[LinesAndPoses] | LineSolution | PartsSolution
    """The normal equations of the whitened residuals at the solution, with the weights that the cost and the loss give them,
    for the noise that is stated (or 1 px); with a prior or a robust loss for that of `noise_factor` times as much."""
    scale: float
    """Times the covariances of `whitened`: those of the noise."""
    camera_covariance: tuple[Float[Tensor, "_ _"], ...] = ()
    """Of the parameters of each camera that was refined, in the order of `state.models`."""
    rig_covariance: Float[Tensor, "cameras 6 6"] | None = None
    """Of the left perturbation of `cam_from_rig`, where it was refined; zero for the first."""
    line_factor: Float[Tensor, " t"] | None = None
    """Times the covariance of each line, for its own noise, which `line_covariance` holds; None where all have the same."""

    @property
    def noise_factor(self) -> float:
        """Noise that all covariances are for, over what is stated (or 1 px): 1 where it is stated and holds; NaN where the
        residuals were expected to tell and nothing is left over."""
        return self.noise.level

    def joint_line_covariance(self, tracks: Int[Tensor, " k"]) -> Float[Tensor, "k4 k4"]:
        """Covariance of some lines together, four rows a line: the poses make the errors of all lines depend on each other."""
        joint = self.whitened.joint_eliminated_covariance(tracks) * (self.scale * self.noise.widening(4))
        if self.line_factor is None:
            return joint
        times = self.line_factor[tracks].sqrt().repeat_interleave(4)
        return times[:, None] * joint * times


def described(done: Uncertain) -> Adjusted:
    """All covariances, for the noise and its redundancy."""
    problem, equations, scale, noise = done.problem, done.equations, done.scale, done.noise
    state, freedom = done.found.state, problem.freedom
    rig_covariance, cameras = None, []
    if isinstance(equations, LineSolution | PartsSolution):
        of_frames, lines = equations.covariances()
        poses = torch.zeros(len(freedom.held_frames), 6, 6, dtype=torch.float64)
        poses[problem.free] = of_frames
    else:
        kept, lines = equations.kept_covariance(), equations.eliminated_covariance()
        poses, low = _pose_covariance(problem, state, kept), 6 * len(problem.free)
        if state.rig is not None and len(problem.rig_cameras):
            rig_covariance = torch.zeros(len(state.rig.cam_from_rig), 6, 6, dtype=torch.float64)
            rig_covariance[problem.rig_cameras] = _blocks(kept, low, len(problem.rig_cameras)) * (scale * noise.widening(6))
            low += 6 * len(problem.rig_cameras)
        for basis in problem.bases:
            high = low + basis.shape[1]
            cameras.append(basis @ kept[low:high, low:high] @ basis.mT * (scale * noise.widening(basis.shape[1])))
            low = high
    lines = lines * (scale * noise.widening(4))
    return Adjusted(
        state=state,
        outcome=done.found.outcome,
        initial_cost=done.found.initial_cost,
        cost=done.found.cost,
        iterations=done.found.iterations,
        line_covariance=lines if freedom.held_lines is None else torch.where(freedom.held_lines[:, None, None], 0.0, lines),
        pose_covariance=poses * (scale * noise.widening(6)),
        noise=noise,
        whitened=equations,
        scale=scale,
        camera_covariance=tuple(cameras),
        rig_covariance=rig_covariance,
    )


def _pose_covariance(problem: LineProblem, state: LinesAndPoses, kept: Float[Tensor, "k k"]) -> Float[Tensor, "images 6 6"]:
    """Of every photo: with the steps f of its frame and c of its camera, to first order,

    exp(c) C exp(f) F = exp(c + Ad(C) f) C F
    """
    frames, low = len(problem.freedom.held_frames), 6 * len(problem.free)
    # Held blocks stand in a last, empty place of the padded covariance.
    padded = torch.zeros(len(kept) + 6, len(kept) + 6, dtype=kept.dtype)
    padded[: len(kept), : len(kept)] = kept
    empty = torch.full((frames,), len(kept))
    of_frame = empty.index_copy(0, problem.free, 6 * torch.arange(len(problem.free)))
    within = torch.arange(6)
    if state.rig is None:
        columns = of_frame[:, None] + within
        return padded[columns[:, :, None], columns[:, None, :]]
    rig = state.rig
    of_camera = torch.full((len(rig.cam_from_rig),), len(kept))
    of_camera[problem.rig_cameras] = low + 6 * torch.arange(len(problem.rig_cameras))
    columns = torch.cat([of_frame[rig.frame][:, None] + within, of_camera[rig.camera][:, None] + within], -1)
    both = padded[columns[:, :, None], columns[:, None, :]]
    turn = adjoint(rig.cam_from_rig[rig.camera])
    into = torch.cat([turn, torch.eye(6, dtype=turn.dtype).expand_as(turn)], -1)
    return into @ both @ into.mT


def _blocks(kept: Float[Tensor, "k k"], low: int, count: int) -> Float[Tensor, "count 6 6"]:
    """The diagonal blocks of `count` poses from column `low` on."""
    part = kept[low : low + 6 * count, low : low + 6 * count]
    return part.reshape(count, 6, count, 6).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
