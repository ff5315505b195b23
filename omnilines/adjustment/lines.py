"""Adjustment of 3D lines, camera poses, cameras and rigs: minimise a cost of all observed arcs, and say how certain it all is."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose, adjoint, hat
from omnilines.adjustment.arcs import Arcs
from omnilines.adjustment.engine import EXACT_FIT, LineEngine, LineSolution, is_compiled, lines_settled
from omnilines.adjustment.engine_layout import Layout, layout
from omnilines.adjustment.memory import engine_bytes, require_for_general, require_memory
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses, Rig
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, Solution, solve
from omnilines.least_squares.band import band_width
from omnilines.least_squares.devices import moved_to, usable_device

REWEIGHTED = 1e-6
"""Of the mean cost of an observation, by which new weights may still lower the whole: a step of 1e-3 standard deviations."""


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
    """Of the left perturbation of the pose of every photo, in the gauge of the adjustment; zero for held poses."""
    noise_factor: float
    """Square root of the variance factor: residuals over what the stated (or 1 px) noise of the end points predicts."""
    whitened: Solution[LinesAndPoses] | LineSolution
    """The whitened normal equations at the solution, which all covariances come from."""
    camera_covariance: tuple[Float[Tensor, "_ _"], ...] = ()
    """Of the parameters of each camera that was refined, in the order of `state.models`."""
    rig_covariance: Float[Tensor, "cameras 6 6"] | None = None
    """Of the left perturbation of `cam_from_rig`, where it was refined; zero for the first."""

    def joint_line_covariance(self, tracks: Int[Tensor, " k"]) -> Float[Tensor, "k4 k4"]:
        """Covariance of some lines together, four rows a line: the poses make the errors of all lines depend on each other."""
        return self.whitened.joint_eliminated_covariance(tracks) * self.noise_factor**2


def adjust_lines(
    arcs: Arcs,
    lines: PlueckerLines,
    cam_from_world: Pose,
    *,
    cost: str = "sector",
    refine_poses: bool = True,
    held: Bool[Tensor, " images"] | None = None,
    held_lines: Bool[Tensor, " tracks"] | None = None,
    rig: Rig | None = None,
    refine_rig: bool = False,
    models: tuple[CameraModel, ...] = (),
    prior: PosePrior | None = None,
    loss: Loss | None = None,
    max_iterations: int = 100,
    callback: Callable[[Progress], None] | None = None,
    device: str = "cpu",
) -> Adjusted:
    """Refine lines (world frame, one per track, all of them finite) and, if asked, poses, cameras and a rig from their arcs.

    `held` names poses that stay; photos without an arc are held in any case. With a rig `cam_from_world` is `rig_from_world` of
    its frames, and `held` and `prior` are those of frames. `models` are refined where given: all cameras of the calibration, in
    its order; the arcs must know their pixels. The covariance is that of the whitened residuals at the solution, scaled by their
    variance factor, so that it is right for any noise of the end points.

    With the device `cuda` the iterations run on a GPU, whose free memory must hold the problem; what is given and returned lies
    on the processor, which also works out the covariances. Cameras are refined on the processor only.

    Raises InputError where nothing that was asked for can move, and where the problem does not fit into memory (`memory.py`).
    """
    state = LinesAndPoses(cam_from_world, _no_chart(lines), rig, models)
    frame = arcs.image if rig is None else rig.frame[arcs.image]
    seen = torch.bincount(frame, minlength=len(cam_from_world)) > 0
    fixed = torch.zeros(len(cam_from_world), dtype=torch.bool) if held is None else held
    fixed = fixed | ~seen if refine_poses else torch.ones_like(fixed)
    if bool(fixed.all()) and refine_poses:
        raise InputError("At least one photo with matched segments and a pose that is not held was expected, found none.")
    centres = state.cam_from_world.centre[arcs.image]
    state = replace(state, chart=LineChart.about_cameras(lines, centres, arcs.track))
    freedom = Freedom(fixed, held_lines, bool(models), refine_rig)
    problem = LineProblem(arcs, cost, freedom, state, prior)
    _require_scale(problem, state)
    place = usable_device(device)
    if place.type != "cpu":
        if models:
            raise InputError("Cameras are refined on the processor, found the device cuda; use the device cpu.")
        found = _on_device(place, problem, state, loss, max_iterations, callback)
        if is_compiled(problem, found.state):
            return _with_sparse_uncertainty(problem, found, _layout_that_fits(problem))
        return _with_uncertainty(arcs, freedom, prior, found)
    if is_compiled(problem, state):
        engine = LineEngine(problem, loss or Loss(), _layout_that_fits(problem))
        found = engine.finish(engine.minimise(state, max_iterations, callback)).end
        return _with_sparse_uncertainty(problem, found, engine.layout)
    require_for_general(arcs, problem.structure.kept_size)
    solution: Solution[LinesAndPoses] | Minimum[LinesAndPoses]
    if problem.held_weights is None:
        settle = lines_settled(problem, loss or Loss())
        solution = solve(problem, state, loss, max_iterations=max_iterations, callback=callback, settle=settle)
    else:
        solution = _reweighted(problem, state, loss, max_iterations, callback)
    if solution.state.models:
        arcs = arcs.seen_by(solution.state.models)
    return _with_uncertainty(arcs, freedom, prior, solution)


def _require_scale(problem: LineProblem, state: LinesAndPoses) -> None:
    """Raise GeometryError where several held poses are meant to give the scene its scale and are too near each other: standard
    deviations would be endless. Too near is within the noise of an end point at the distance of the lines."""
    fixed = torch.nonzero(problem.freedom.held_frames & problem.observing).flatten()
    if len(fixed) < 2 or not len(problem.free) or not problem.only_poses_scale(state):
        return
    arcs, centre = problem.arcs, state.rig_from_world.centre[fixed]
    noise = arcs.by_pixel @ arcs.covariance_px2 @ arcs.by_pixel.mT
    noise_rad = float((0.5 * noise.diagonal(dim1=-2, dim2=-1).sum(-1)).median().sqrt())
    apart, least = float((centre - centre[0]).norm(dim=-1).max()), noise_rad * float(state.chart.scale.nanmedian())
    if apart <= least:
        raise GeometryError(
            f"Held poses at two places were expected to give the scene its scale, found {len(fixed)} at one place ({apart:.2g} m "
            f"apart, {least:.2g} m is noise); hold one that was taken elsewhere too, or only one, which leaves the scale open."
        )


def _reweighted(
    problem: LineProblem,
    state: LinesAndPoses,
    loss: Loss | None,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
) -> Minimum[LinesAndPoses]:
    """Solves with weights that are held, formed anew at the end of each, until they no longer change it (`intrinsics.py`)."""
    least = REWEIGHTED / len(problem.arcs)
    found = solve(problem, state, loss, max_iterations=max_iterations, tolerance=least, callback=callback)
    initial, iterations = found.initial_cost, found.iterations
    while found.outcome is Outcome.CONVERGED and iterations < max_iterations:
        again = LineProblem(problem.arcs, problem.cost_name, problem.freedom, found.state, problem.prior)
        left = max_iterations - iterations
        found = solve(again, found.state, loss, max_iterations=left, tolerance=least, callback=callback)
        iterations += found.iterations
        if found.initial_cost - found.cost <= least * found.cost + EXACT_FIT * 2 * len(problem.arcs):
            break
    return Minimum(found.state, found.outcome, found.cost, initial, iterations)


def _on_device(
    device: torch.device,
    problem: LineProblem,
    state: LinesAndPoses,
    loss: Loss | None,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
) -> Minimum[LinesAndPoses]:
    """The iterations of a problem on another device. Raises InputError where it does not fit there."""
    arcs, freedom, prior = moved_to(problem.arcs, device), moved_to(problem.freedom, device), moved_to(problem.prior, device)
    require_for_general(arcs, problem.structure.kept_size)
    own = moved_to(state, device)
    found = solve(LineProblem(arcs, problem.cost_name, freedom, own, prior), own, loss, max_iterations, callback=callback)
    end = moved_to(found.state, torch.device("cpu"))
    return Minimum(end, found.outcome, found.cost, found.initial_cost, found.iterations)


def _layout_that_fits(problem: LineProblem) -> Layout:
    """The engine's layout, which is small. Raises InputError where what follows it does not fit into memory."""
    found, arcs = layout(problem), problem.arcs
    pattern, threads = found.pattern, len(found.shares) - 1
    needed = engine_bytes(len(arcs), arcs.tracks, pattern.kept, len(pattern.row), band_width(pattern, 6), threads)
    require_memory(needed, len(arcs), arcs.tracks, arcs.images)
    return found


def _no_chart(lines: PlueckerLines) -> LineChart:
    """A chart of the lines about the origin, until the poses of the photos are known."""
    zero = torch.zeros_like(lines.direction)
    return LineChart.from_lines(lines, zero, torch.ones_like(zero[:, 0]))


def _with_uncertainty(
    arcs: Arcs, freedom: Freedom, prior: PosePrior | None, solution: Solution[LinesAndPoses] | Minimum[LinesAndPoses]
) -> Adjusted:
    """Covariances from the whitened equations at the solution."""
    state = solution.state
    problem = LineProblem(arcs, "whitened", freedom, state, prior)
    whitened = solve(problem, state, max_iterations=0)
    variance = _variance(problem, whitened)
    kept = whitened.kept_covariance() * variance
    line_covariance = _zero_where_held(freedom, whitened.eliminated_covariance() * variance)
    low = 6 * len(problem.free)
    rig_covariance = None
    if state.rig is not None and len(problem.rig_cameras):
        rig_covariance = torch.zeros(len(state.rig.cam_from_rig), 6, 6, dtype=torch.float64)
        rig_covariance[problem.rig_cameras] = _blocks(kept, low, len(problem.rig_cameras))
        low += 6 * len(problem.rig_cameras)
    cameras = []
    for basis in problem.bases:
        high = low + basis.shape[1]
        cameras.append(basis @ kept[low:high, low:high] @ basis.mT)
        low = high
    return Adjusted(
        state,
        solution.outcome,
        solution.initial_cost,
        solution.cost,
        solution.iterations,
        line_covariance,
        _pose_covariance(problem, state, kept),
        math.sqrt(variance),
        whitened,
        tuple(cameras),
        rig_covariance,
    )


def _variance(problem: LineProblem, whitened: Solution[LinesAndPoses] | LineSolution) -> float:
    """Variance factor of the whitened residuals; NaN where nothing is left over."""
    arcs, freedom = problem.arcs, problem.freedom
    observed = torch.bincount(arcs.track, minlength=arcs.tracks) > 0
    moving = observed if freedom.held_lines is None else observed & ~freedom.held_lines
    known = 0 if problem.prior is None else 6 * len(problem.free)
    degrees = 2 * len(arcs) + known - 4 * int(moving.sum()) - problem.structure.kept_size + whitened.gauge.shape[1]
    return whitened.cost / degrees if degrees > 0 else math.nan


def _zero_where_held(freedom: Freedom, covariance: Float[Tensor, "t 4 4"]) -> Float[Tensor, "t 4 4"]:
    return covariance if freedom.held_lines is None else torch.where(freedom.held_lines[:, None, None], 0.0, covariance)


def _with_sparse_uncertainty(problem: LineProblem, found: Minimum[LinesAndPoses], laid_out: Layout) -> Adjusted:
    """The same by the compiled engine: only the blocks that are needed of the covariance of all poses are formed."""
    freedom, state = problem.freedom, found.state
    engine = LineEngine(LineProblem(problem.arcs, "whitened", freedom, state, problem.prior), Loss(), laid_out)
    whitened = engine.finish(engine.minimise(state, 0))
    variance = _variance(engine.problem, whitened)
    of_frames, of_lines = whitened.covariances()
    pose_covariance = torch.zeros(len(freedom.held_frames), 6, 6, dtype=torch.float64)
    pose_covariance[problem.free] = of_frames * variance
    return Adjusted(
        state,
        found.outcome,
        found.initial_cost,
        found.cost,
        found.iterations,
        _zero_where_held(freedom, of_lines * variance),
        pose_covariance,
        math.sqrt(variance),
        whitened,
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
