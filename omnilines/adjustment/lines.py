"""Adjustment of 3D lines, camera poses, cameras and rigs: minimise a cost of all observed arcs, and say how certain it all is."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, GeometryError, InputError
from camera_models.pose import Pose, hat
from camera_models.wording import rounded
from omnilines.adjustment.adjusted import Adjusted, described
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.datum import framed
from omnilines.adjustment.engine import is_compiled
from omnilines.adjustment.information import pose_information
from omnilines.adjustment.memory import laid_out_to_fit
from omnilines.adjustment.minimum import line_minimum
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.own_noise import with_own_noise
from omnilines.adjustment.parts import require_divisible, why_in_one_piece
from omnilines.adjustment.parts_engine import Workers
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses, Rig
from omnilines.adjustment.uncertainty import Task, Uncertain, uncertainty
from omnilines.costs import WHITENED
from omnilines.geometry.line import PlueckerLines, weighted_median_by_group
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Minimum, Progress
from omnilines.least_squares.dense import LEAST_EIGENVALUE
from omnilines.least_squares.devices import usable_device

MOST_TURNS, CONVERGED = 12, 1e-3
"""Times that the noise and a solution with a prior are found in turn, and the relative change of the noise that ends it."""
IN_A_CAMERA = 1e-4
"""Distance of a line from a camera, over that from its cameras (median), below which it lies in it."""
LEAST_LEVEL = 1e-9
"""Noise below it is that of rounding: it says nothing of what a prior weighs."""


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
    max_iterations: int = 300,
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

    Where nothing holds the scene, it and its covariances are in the frame of the poses it starts from (`datum.py`).

    Covariances are those of the estimate that the cost and the loss give (`weighting.py`), for the stated noise of the end
    points. Where none is stated, or the residuals are larger than it allows (chi-square), they are for the noise
    that the residuals show, and wider as few residuals ask for (`noise.py`). With a prior and no stated noise, the noise and
    the solution are found in turn.

    With `cautious` it is the noise that all residuals show, also those of arcs that stand out and whatever is stated: for arcs of
    photos, of which those that stand out are mostly of near edges, and pull at the lines. Covariances of lines are then for what
    each line shows of its own noise, too (`own_noise.py`).

    With the device `cuda` the iterations run on a GPU, whose free memory must hold the problem; what is given and returned lies
    on the processor, which also works out the covariances. Cameras are refined on the processor only.

    With a `partition` lines and poses are adjusted in parts of so many photos besides those that parts share
    (`parts_engine.py`), by `workers`; the result is the same. With 0 it is so, in parts of 500, only where the whole does not fit
    into memory. Scenes of fewer photos are adjusted in one piece.

    Raises InputError where nothing that was asked for can move, where the problem does not fit into memory (`memory.py`), and for
    a partition of what is adjusted in one piece only (`require_divisible`).
    """
    state = LinesAndPoses(cam_from_world, _no_chart(lines), rig, models)
    fixed = _held_frames(arcs, rig, len(cam_from_world), held, refine_poses)
    centres = state.cam_from_world.centre[arcs.image]
    state = replace(state, chart=LineChart.about_cameras(lines, centres, arcs.track))
    freedom = Freedom(fixed, held_lines, bool(models), refine_rig)
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
        loss=Loss() if loss is None else loss,
        layout=laid_out,
        division=division,
        workers=workers,
        cautious=cautious,
        options=options,
    )

    def minimum(start: LinesAndPoses, weighed: PosePrior | None) -> Minimum[LinesAndPoses]:
        found = line_minimum(task, start, weighed, max_iterations, callback, place=place)
        return replace(found, state=framed(LineProblem(arcs, WHITENED, freedom, found.state, weighed), found.state, state))

    if prior is None or bool(fixed.all()):
        found = described(uncertainty(task, minimum(state, None)))
    else:
        found = described(_with_prior(task, state, prior, minimum))
    return with_own_noise(found, task.seen_by(found.state).arcs) if cautious else found


def _held_frames(
    arcs: MatchedArcs, rig: Rig | None, frames: int, held: Bool[Tensor, " frames"] | None, refine_poses: bool
) -> Bool[Tensor, " frames"]:
    """Poses that stay: those that are held, those of photos without an arc, and all where none is refined. Raises InputError
    where poses are to be refined and none can."""
    if not refine_poses:
        return torch.ones(frames, dtype=torch.bool)
    frame = arcs.image if rig is None else rig.frame[arcs.image]
    unseen = torch.bincount(frame, minlength=frames) == 0
    fixed = unseen if held is None else held | unseen
    if bool(fixed.all()):
        raise InputError("At least one photo with matched segments and a pose that is not held was expected, found none.")
    return fixed


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
            f"Held poses at two places were expected to give the scene its scale, found {len(fixed)} at one place "
            f"({rounded(apart)} m "
            f"apart, {rounded(least)} m is noise); hold one that was taken elsewhere too, or only one, which leaves the "
            "scale open."
        )


def _no_chart(lines: PlueckerLines) -> LineChart:
    """A chart of the lines about the origin, until the poses of the photos are known."""
    zero = torch.zeros_like(lines.direction)
    return LineChart.from_lines(lines, zero, torch.ones_like(zero[:, 0]))


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


def lost_lines(arcs: MatchedArcs, state: LinesAndPoses) -> dict[str, Bool[Tensor, " t"]]:
    """Lines that their arcs do not determine where they came to lie, whatever is known of the cameras, by the status that says
    why: they lie in a camera, or their planes coincide."""
    everywhere = torch.ones(len(state.rig_from_world), dtype=torch.bool)
    at = LineProblem(arcs, WHITENED, Freedom(everywhere), state).linearise(state)
    blocks = torch.zeros(arcs.tracks, 4, 4, dtype=torch.float64)
    blocks.index_add_(0, arcs.track, torch.nan_to_num(at.by_eliminated.mT @ at.by_eliminated))
    lost = _undetermined(blocks)
    away = state.chart.lines()[arcs.track].distance_to(state.cam_from_world.centre[arcs.image])
    nearest = torch.full_like(state.chart.scale, torch.inf).scatter_reduce(0, arcs.track, away, "amin")
    inside = nearest < IN_A_CAMERA * state.chart.scale
    return {"through_centre": lost & inside, "parallel_planes": lost & ~inside}


def lost_frames(arcs: MatchedArcs, state: LinesAndPoses, weak_share: float, level: float = 1.0) -> Bool[Tensor, " frames"]:
    """Frames (photos, without a rig) whose arcs hardly tell where they came to lie, whatever is known of the lines: for noise of
    this level they are turned (rad), or moved over the distance of their lines, by more than `weak_share` (standard deviations).
    One or two arcs tell nothing, parallel ones little. Frames without an arc are none of them."""
    frames = len(state.rig_from_world)
    frame = arcs.image if state.rig is None else state.rig.frame[arcs.image]
    normal = pose_information(arcs, state)[0]
    lost = _undetermined(normal)
    known = torch.where(lost[:, None, None], torch.eye(6, dtype=torch.float64), normal)
    sigma = level * torch.linalg.inv(known).diagonal(dim1=1, dim2=2).sqrt()
    turn, move = sigma.unflatten(1, (2, 3)).amax(-1).unbind(1)
    away = state.chart.lines()[arcs.track].distance_to(state.cam_from_world.centre[arcs.image])
    distance = weighted_median_by_group(away, torch.ones_like(away), frame, frames)
    return (lost | (turn > weak_share) | (move > weak_share * distance)) & (torch.bincount(frame, minlength=frames) > 0)


def _undetermined(normal: Float[Tensor, "blocks k k"]) -> Bool[Tensor, " blocks"]:
    """Blocks of parameters whose normal matrix leaves some combination of them open."""
    unit = normal.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    return torch.linalg.eigvalsh(normal * unit[:, :, None] * unit[:, None])[:, 0] < LEAST_EIGENVALUE


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
