"""Adjustment of 3D lines, camera poses, cameras and rigs: minimise a cost of all observed arcs, and say how certain it all is."""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose, adjoint, hat
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.engine import LineEngine, is_compiled, line_convergence
from omnilines.adjustment.engine_passes import EXACT_FIT
from omnilines.adjustment.engine_solution import LineSolution, line_solution
from omnilines.adjustment.memory import laid_out_to_fit, require_for_general
from omnilines.adjustment.noise import Noise
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.parts import require_divisible, why_in_one_piece
from omnilines.adjustment.parts_engine import PartsEngine, PartsSolution, Workers, parts_solution
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses, Rig
from omnilines.adjustment.uncertainty import Task, Uncertain, uncertainty
from omnilines.costs import WHITENED
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Minimum, Outcome, Progress, Solution, solve
from omnilines.least_squares.devices import moved_to, usable_device

MOST_TURNS, CONVERGED = 12, 1e-3
"""Times that the noise and a solution with a prior are found in turn, and the relative change of the noise that ends it."""
LEAST_LEVEL = 1e-9
"""Noise below it is that of rounding: it says nothing of what a prior weighs."""
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

    @property
    def noise_factor(self) -> float:
        """Noise that all covariances are for, over what is stated (or 1 px): 1 where it is stated and holds; NaN where the
        residuals were expected to tell and nothing is left over."""
        return self.noise.level

    def joint_line_covariance(self, tracks: Int[Tensor, " k"]) -> Float[Tensor, "k4 k4"]:
        """Covariance of some lines together, four rows a line: the poses make the errors of all lines depend on each other."""
        return self.whitened.joint_eliminated_covariance(tracks) * (self.scale * self.noise.widening(4))


def adjust_lines(
    arcs: MatchedArcs,
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
    cautious: bool = False,
    options: AdjustmentOptions = AdjustmentOptions(),
    max_iterations: int = 100,
    callback: Callable[[Progress], None] | None = None,
    device: str = "cpu",
    partition: int = 0,
    workers: Workers = Workers(),
) -> Adjusted:
    """Refine lines (world frame, one per track, all of them finite) and, if asked, poses, cameras and a rig from their arcs.

    `held` names poses that stay; photos without an arc are held in any case. With a rig `cam_from_world` is `rig_from_world` of
    its frames, and `held` and `prior` are those of frames. `models` are refined where given: all cameras of the calibration, in
    its order; the arcs must know their pixels. A `prior` counts in standard deviations of itself, and the arcs in those of their
    noise, whatever the cost. Its unit is that of the residuals of the cost, as is the scale of the `loss`.

    Covariances are those of the estimate that the cost and the loss give (`weighting.py`), for the stated noise of the end
    points. Where none is stated, or the residuals are larger than it allows (chi-square), they are for the noise
    that the residuals show, and wider as few residuals ask for (`noise.py`). With a prior and no stated noise, the noise and
    the solution are found in turn.

    With `cautious` it is the noise that all residuals show, also those of arcs that stand out and whatever is stated: for arcs of
    photos, of which those that stand out are mostly of near edges, and pull at the lines.

    With the device `cuda` the iterations run on a GPU, whose free memory must hold the problem; what is given and returned lies
    on the processor, which also works out the covariances. Cameras are refined on the processor only.

    With a `partition` lines and poses are adjusted in parts of so many photos besides those that parts share
    (`parts_engine.py`), by `workers`; the result is the same. With 0 it is so, in parts of 500, only where the whole does not fit
    into memory. Scenes of fewer photos are adjusted in one piece.

    Raises InputError where nothing that was asked for can move, where the problem does not fit into memory (`memory.py`), and for
    a partition of what is adjusted in one piece only (`require_divisible`).
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
    if loss is None:
        loss = Loss()

    place = usable_device(device)
    whole = why_in_one_piece(
        cost=cost, poses=refine_poses, cameras=bool(models), rig=rig is not None, prior=prior is not None, device=device
    )
    require_divisible(partition, whole)
    plain = LineProblem(arcs, WHITENED, freedom, state)
    if prior is None:
        _require_scale(plain, state)
    laid_out, division = None, None
    if is_compiled(plain, state):
        laid_out, division = laid_out_to_fit(plain, partition, not whole)
    task = Task(
        arcs=arcs,
        cost=cost,
        freedom=freedom,
        loss=loss,
        layout=laid_out,
        division=division,
        workers=workers,
        cautious=cautious,
        options=options,
    )

    def minimum(start: LinesAndPoses, weighed: PosePrior | None) -> Minimum[LinesAndPoses]:
        return _minimum(task, start, weighed, max_iterations, callback, place=place)

    if prior is None or bool(fixed.all()):
        return _described(uncertainty(task, minimum(state, None)))
    return _described(_with_prior(task, state, prior, minimum))


def _minimum(
    task: Task,
    state: LinesAndPoses,
    prior: PosePrior | None,
    max_iterations: int,
    callback: Callable[[Progress], None] | None,
    *,
    place: torch.device,
) -> Minimum[LinesAndPoses]:
    """The least cost from a start, by the engine that takes the problem."""
    problem, loss = LineProblem(task.arcs, task.cost, task.freedom, state, prior), task.loss
    if place.type != "cpu":
        if state.models:
            raise InputError("Cameras are refined on the processor, found the device cuda; use the device cpu.")
        return _on_device(place, problem, state, loss, max_iterations, callback=callback)
    if task.division is not None:
        with closing(PartsEngine(problem, state, loss, task.division, task.workers)) as parts:
            return parts_solution(parts, parts.minimise(state, max_iterations, callback)).end
    if task.layout is not None and is_compiled(problem, state):
        engine = LineEngine(problem, loss, task.layout)
        return line_solution(engine, engine.minimise(state, max_iterations, callback)).end
    require_for_general(problem.arcs, problem.structure.kept_size)
    if problem.held_weights is not None:
        return _reweighted(problem, state, loss, max_iterations, callback)
    converge = line_convergence(problem, loss)
    found = solve(problem, state, loss, max_iterations=max_iterations, callback=callback, converge=converge)
    return Minimum(found.state, found.outcome, found.cost, found.initial_cost, found.iterations)


def _with_prior(
    task: Task,
    state: LinesAndPoses,
    prior: PosePrior,
    minimum: Callable[[LinesAndPoses, PosePrior | None], Minimum[LinesAndPoses]],
) -> Uncertain:
    """The solution with a prior that weighs what the noise of the arcs says. Where none is stated it is found in turn with the
    solution (variance components, W. Foerstner 1979). It begins small, as it is without the prior: one that begins large would
    let the prior hold the poses, and their errors then look like noise.
    """
    if task.stated:
        weighed = prior.weighing(task.weights(state, 1.0).unit)
        return uncertainty(task, minimum(state, weighed), weighed, 1.0)
    alone = uncertainty(task, minimum(state, None)).noise.level
    level = alone if math.isfinite(alone) and alone > LEAST_LEVEL else 1.0
    start, iterations = state, 0
    for _ in range(MOST_TURNS):
        weighed = prior.weighing(task.weights(start, level).unit)
        found = minimum(start, weighed)
        iterations += found.iterations
        result = uncertainty(task, found, weighed, level)
        again = result.noise.level
        if not math.isfinite(again) or abs(again / level - 1) < CONVERGED or again <= LEAST_LEVEL:
            break
        start, level = found.state, again
    return replace(result, found=replace(result.found, iterations=iterations))


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
    loss: Loss,
    max_iterations: int,
    *,
    callback: Callable[[Progress], None] | None,
) -> Minimum[LinesAndPoses]:
    """The iterations of a problem on another device. Raises InputError where it does not fit there."""
    arcs, freedom, prior = moved_to(problem.arcs, device), moved_to(problem.freedom, device), moved_to(problem.prior, device)
    require_for_general(arcs, problem.structure.kept_size)
    own = moved_to(state, device)
    found = solve(
        LineProblem(arcs, problem.cost_name, freedom, own, prior), own, loss, max_iterations=max_iterations, callback=callback
    )
    end = moved_to(found.state, torch.device("cpu"))
    return Minimum(end, found.outcome, found.cost, found.initial_cost, found.iterations)


def _no_chart(lines: PlueckerLines) -> LineChart:
    """A chart of the lines about the origin, until the poses of the photos are known."""
    zero = torch.zeros_like(lines.direction)
    return LineChart.from_lines(lines, zero, torch.ones_like(zero[:, 0]))


def _described(done: Uncertain) -> Adjusted:
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


def drop_unknown(arcs: MatchedArcs, known: Bool[Tensor, " t"]) -> tuple[MatchedArcs, Int[Tensor, " k"]]:
    """The arcs of tracks that have a line, tracks renumbered; and the old number of each new track.

    Raises GeometryError when no track has a line.
    """
    tracks = torch.nonzero(known).flatten()
    if not len(tracks):
        raise GeometryError("At least one track that determines a line was expected, found none; give photos from more places.")
    place = torch.full((arcs.tracks,), -1)
    place[tracks] = torch.arange(len(tracks))
    kept = arcs.rows(place[arcs.track] >= 0)
    return replace(kept, track=place[kept.track], tracks=len(tracks)), tracks
