"""Adjustment of 3D lines and camera poses: minimise the sector or the whitened cost of all observed arcs."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import GeometryError, InputError
from camera_models.pose import Pose, hat
from omnilines.adjustment.arcs import Arcs, poses_of
from omnilines.costs import COSTS, sector, whitened
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import KeptGroup, Linearisation, Loss, Outcome, Progress, Solution, Structure, solve

REWEIGHTINGS = 3
"""The whitened cost freezes the noise across the line at each of these rounds; it settles after the second."""


@dataclass(frozen=True)
class LinesAndPoses:
    """State of the adjustment."""

    cam_from_world: Pose
    chart: LineChart

    def normals(self, arcs: Arcs) -> Float[Tensor, "n 3"]:
        """Projection-plane normal M of every observation, camera frame."""
        return self.chart[arcs.track].projection_normal(poses_of(arcs, self.cam_from_world))[0]


class LineProblem:
    """Camera poses are the kept blocks, lines the eliminated ones.

    `held` poses do not move. With all poses free, the similarity that bearings leave open is fixed by seven constraints on the
    step: the poses neither shift, turn nor scale as a whole (with one held pose, the scale about it).
    """

    def __init__(self, arcs: Arcs, factor: Float[Tensor, "n 2 3"], held: Bool[Tensor, " images"]) -> None:
        self.arcs, self.factor, self.held = arcs, factor, held
        self.observing = torch.bincount(arcs.image, minlength=len(held)) > 0
        self.free = torch.nonzero(~held).flatten()
        place = torch.full((len(held),), -1, device=held.device)
        place[self.free] = torch.arange(len(self.free), device=held.device)
        groups = (KeptGroup(place[arcs.image], len(self.free), 6),) if len(self.free) else ()
        self.structure = Structure(arcs.track, arcs.tracks, 4, groups)

    def linearise(self, state: LinesAndPoses) -> Linearisation:
        """F M / |M| of every observation and its analytic Jacobians; see `costs.sector.line_residual`."""
        poses = poses_of(self.arcs, state.cam_from_world)
        r, by_pose, by_line = sector.line_residual(self.factor, state.chart[self.arcs.track], poses)
        return Linearisation(r, by_line, (by_pose,) if self.structure.groups else ())

    def retract(self, state: LinesAndPoses, kept: Tensor, eliminated: Tensor) -> LinesAndPoses:
        """exp(delta) T for poses, the orthonormal chart for lines, which is re-centred where it becomes badly scaled."""
        chart = state.chart.retract(eliminated).recentred()
        if not len(self.free):
            return LinesAndPoses(state.cam_from_world, chart)
        moved = Pose.exp(kept.view(-1, 6)) @ state.cam_from_world[self.free]
        rotation, translation = state.cam_from_world.rotation.clone(), state.cam_from_world.translation.clone()
        rotation[self.free], translation[self.free] = moved.rotation, moved.translation
        return LinesAndPoses(Pose(rotation, translation), chart)

    def gauge(self, state: LinesAndPoses) -> Float[Tensor, "k g"]:
        """Columns of d pose (rad, m) for a common turn, shift and scale of the scene, about which the residuals say nothing."""
        rotation, centre = state.cam_from_world.rotation[self.free], state.cam_from_world.centre
        # A held pose anchors the scene only where a photo observes it.
        fixed = torch.nonzero(self.held & self.observing).flatten()
        if len(fixed) > 1 or not len(self.free):
            return rotation.new_zeros(6 * len(self.free), 0)
        origin = centre[fixed[0]] if len(fixed) else centre[self.free].mean(0)
        arm = centre[self.free] - origin
        # World X' = X + w x X + v + s X: the pose turns by -R w and its centre moves by dC, which is -R dC in delta.
        scale = torch.cat([torch.zeros_like(arm), -(rotation @ arm[..., None])[..., 0]], -1).reshape(-1, 1)
        if len(fixed):
            return scale
        eye = torch.eye(3, dtype=arm.dtype, device=arm.device).expand(len(arm), 3, 3)
        turns = torch.cat([-rotation, -rotation @ torch.linalg.cross(eye, arm[:, None, :].expand(-1, 3, -1)).mT], 1)
        shifts = torch.cat([torch.zeros_like(rotation), -rotation], 1)
        return torch.cat([turns.reshape(-1, 3), shifts.reshape(-1, 3), scale], 1)


@dataclass(frozen=True)
class Adjusted:
    """Adjusted lines and poses with their uncertainty."""

    state: LinesAndPoses
    outcome: Outcome
    initial_cost: float
    cost: float
    iterations: int
    line_covariance: Float[Tensor, "t 4 4"]
    """In the chart of `state.chart`; NaN for tracks without observations."""
    pose_covariance: Float[Tensor, "images 6 6"]
    """Of the left perturbation, in the gauge of the adjustment; zero for held poses."""
    noise_factor: float
    """Square root of the variance factor: residuals over what the stated (or 1 px) noise of the end points predicts."""
    whitened: Solution[LinesAndPoses]
    """The whitened normal equations at the solution, which both covariances come from."""

    def joint_line_covariance(self, tracks: Int[Tensor, " k"]) -> Float[Tensor, "k4 k4"]:
        """Covariance of some lines together, four rows a line: the poses make the errors of all lines depend on each other."""
        return self.whitened.joint_eliminated_covariance(tracks) * self.noise_factor**2


def factor_of(cost: str, arcs: Arcs, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 3"]:
    """The factor F of the named cost for every observation. Raises InputError on an unknown name."""
    if cost == "sector":
        return sector.prepare(arcs.bearings[:, 0], arcs.bearings[:, 1])
    if cost == "whitened":
        return whitened.prepare(arcs.bearings, arcs.by_pixel, arcs.covariance_px2, normal)
    raise InputError(f"A cost is one of {', '.join(dict(COSTS))}, found '{cost}'; choose one of these.")


def adjust_lines(
    arcs: Arcs,
    lines: PlueckerLines,
    cam_from_world: Pose,
    *,
    cost: str = "sector",
    refine_poses: bool = True,
    held: Bool[Tensor, " images"] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 100,
    callback: Callable[[Progress], None] | None = None,
) -> Adjusted:
    """Refine lines (world frame, one per track, all of them finite) and, if asked, poses from the arcs that observe them.

    `held` names poses that stay; photos without an arc are held in any case. The covariance is that of the whitened residuals
    at the solution, scaled by their variance factor, so that it is right for any noise of the end points.
    """
    seen = torch.bincount(arcs.image, minlength=arcs.images) > 0
    fixed = torch.zeros(arcs.images, dtype=torch.bool) if held is None else held
    fixed = fixed | ~seen if refine_poses else torch.ones_like(fixed)
    if bool(fixed.all()) and refine_poses:
        raise InputError("At least one photo with matched segments and a pose that is not held was expected, found none.")
    centres = cam_from_world.centre[arcs.image]
    state = LinesAndPoses(cam_from_world, LineChart.about_cameras(lines, centres, arcs.track))
    initial, iterations = None, 0
    solution: Solution[LinesAndPoses] | None = None
    for _ in range(REWEIGHTINGS if cost == "whitened" else 1):
        problem = LineProblem(arcs, factor_of(cost, arcs, state.normals(arcs)), fixed)
        solution = solve(problem, state, loss, max_iterations=max_iterations, callback=callback)
        state, iterations = solution.state, iterations + solution.iterations
        initial = solution.initial_cost if initial is None else initial
    assert solution is not None and initial is not None
    line_covariance, pose_covariance, noise, whitened_at = _uncertainty(arcs, state, fixed)
    return Adjusted(
        state, solution.outcome, initial, solution.cost, iterations, line_covariance, pose_covariance, noise, whitened_at
    )


def _uncertainty(arcs: Arcs, state: LinesAndPoses, fixed: Tensor) -> tuple[Tensor, Tensor, float, Solution[LinesAndPoses]]:
    """Covariances of lines and poses, the noise factor, and the whitened equations at the solution that they come from."""
    problem = LineProblem(arcs, factor_of("whitened", arcs, state.normals(arcs)), fixed)
    solution = solve(problem, state, max_iterations=0)
    observed = torch.bincount(arcs.track, minlength=arcs.tracks) > 0
    constraints = solution.gauge.shape[1]
    freedom = 2 * len(arcs) - 4 * int(observed.sum()) - problem.structure.kept_size + constraints
    variance = solution.cost / freedom if freedom > 0 else math.nan
    poses = torch.zeros(arcs.images, 6, 6, dtype=torch.float64)
    blocks = solution.kept_covariance().view(len(problem.free), 6, len(problem.free), 6)
    poses[problem.free] = blocks.diagonal(dim1=0, dim2=2).permute(2, 0, 1) * variance
    return solution.eliminated_covariance() * variance, poses, math.sqrt(variance), solution


def motion_across(chart: LineChart, points_m: Float[Tensor, "t k 3"]) -> Float[Tensor, "t k 3 4"]:
    """Derivative by the chart of k points of each line, across it (m/rad): d X = d x (dm - X x dd)."""
    by_direction, by_moment = chart.jacobian()[:, None].split(3, dim=-2)
    return hat(chart.S[:, :, 0])[:, None] @ (by_moment - hat(points_m) @ by_direction)


def end_sigma_m(chart: LineChart, covariance: Float[Tensor, "t 4 4"], ends_m: Float[Tensor, "t 2 3"]) -> Float[Tensor, " t"]:
    """Largest standard deviation (m) of either end of each line across the line; NaN where the covariance is."""
    across = motion_across(chart, ends_m)
    spread = across @ covariance[:, None] @ across.mT
    finite = torch.isfinite(spread).flatten(1).all(-1)
    largest = torch.linalg.eigvalsh(torch.where(finite[:, None, None, None], spread, 0.0))[..., -1].clamp_min(0).sqrt()
    return torch.where(finite, largest.amax(-1), math.nan)


def drop_unknown(arcs: Arcs, known: Bool[Tensor, " t"]) -> tuple[Arcs, Int[Tensor, " k"]]:
    """The arcs of tracks that have a line, tracks renumbered; and the old number of each new track.

    Raises GeometryError when no track has a line.
    """
    tracks = torch.nonzero(known).flatten()
    if not len(tracks):
        raise GeometryError(
            "At least one track that determines a line was expected, found none; lines.csv names the reason of each track."
        )
    place = torch.full((arcs.tracks,), -1)
    place[tracks] = torch.arange(len(tracks))
    kept = arcs.rows(place[arcs.track] >= 0)
    return replace(kept, track=place[kept.track], tracks=len(tracks)), tracks
