"""From a table of matched segments with poses and cameras to a line scene: triangulate, adjust, state the uncertainty."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.arcs import Arcs, ArcTable, arcs_from_segments
from omnilines.adjustment.line_table import line_table, too_uncertain
from omnilines.adjustment.lines import Adjusted, adjust_lines, drop_unknown
from omnilines.adjustment.memory import require_for_arcs
from omnilines.adjustment.prior import PosePrior
from omnilines.adjustment.rig import rig_of_photos
from omnilines.adjustment.state import LinesAndPoses
from omnilines.adjustment.suspects import Suspect, suspects
from omnilines.adjustment.weighting import weighting
from omnilines.costs import cost_function
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Progress
from omnilines.least_squares.devices import usable_device
from omnilines.records import ImagePoses, Lines, Segments
from omnilines.triangulation.batches import triangulate_on
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.robust import noise_level, robust_triangulate

LOSS_SCALE = 2.0
"""Robust losses bend at this many times the stated noise. Where none is stated, at the median residual of the start first, and
then at the noise that the residuals show."""
ROUNDS = 3
"""Times that poses are mended by the tracks that have a line before those that have none are triangulated again."""
REFINABLE = ("lines", "poses", "intrinsics", "rig")


@dataclass(frozen=True)
class AdjustedScene:
    """Adjusted lines and poses, and the same lines as they were triangulated."""

    lines: Lines
    poses: ImagePoses
    before: Lines
    adjusted: Adjusted
    table: ArcTable
    residual_px: Float[np.ndarray, "n 2"]
    """Orthogonal distance of both ends of every arc of `table`; NaN where its track has no line or where it was left out."""
    residual_before_px: Float[np.ndarray, "n 2"]
    rests_on_one: Bool[np.ndarray, " t"]
    """Lines that are `weak` for nothing but this: without one camera the planes of the others coincide."""
    wrong: tuple[Suspect, ...] = ()
    """Observations that the robust triangulation left out: they belong to another line."""
    suspect: tuple[Suspect, ...] = ()
    """Observations that took part and do not fit their line."""
    cameras: tuple[CameraModel, ...] = ()
    """In the order of the calibration, where they were refined."""
    cam_from_rig: Pose | None = None
    """Of every camera, where the rig was refined."""

    def rms_px(self, before: bool = False) -> float:
        """Root mean square of all orthogonal distances."""
        values = self.residual_before_px if before else self.residual_px
        return float(np.sqrt(np.nanmean(values**2)))


def reconstruct_lines(
    segments: Segments,
    poses: ImagePoses,
    cameras: Mapping[str, CameraModel],
    *,
    triangulation: str = "dual",
    triangulation_options: Mapping[str, Any] | None = None,
    cost: str = "sector",
    refine_poses: bool = False,
    refine_cameras: bool = False,
    refine_rig: bool = False,
    rig: Mapping[str, RigCamera] | None = None,
    pose_sigma: tuple[float, float] | None = None,
    robust: bool = False,
    loss: str = "none",
    cautious: bool = False,
    callback: Callable[[Progress], None] | None = None,
    device: str = "cpu",
) -> AdjustedScene:
    """Triangulate every track and adjust lines and, if asked, poses, cameras and the rig; a row of `lines` per track.

    `triangulation_options` are those of the method's function, `cautious` is that of `adjust_lines`. `rig` is that of the
    calibration; it holds the photos of a frame together where `poses` name frames. `pose_sigma` (rad, m) makes the given poses a
    prior. With `robust`, observations of other lines are found by consensus and left out. `device` is where lines are
    triangulated and the iterations of the adjustment run, `cpu` or `cuda`; the consensus stays on the processor.

    Raises InputError where files do not fit together or the problem into memory, GeometryError where no track has a line.
    """
    require_for_arcs(len(segments.track), len(segments.tracks), len(poses))
    table = arcs_from_segments(segments, poses, cameras)
    arcs, names = table.arcs, segments.tracks
    mounted, frames = rig_of_photos(poses, list(cameras), rig or {}, refine_rig)
    models = tuple(cameras.values()) if refine_cameras else ()
    state = LinesAndPoses(frames, _no_chart(), mounted, models)
    state, first, member = _started(
        arcs, state, (triangulation, triangulation_options or {}), robust, ROUNDS if refine_poses else 0, device
    )
    inner, tracks = drop_unknown(arcs.rows(member), first.known)
    centres = state.cam_from_world.centre[inner.image]
    state = replace(state, chart=LineChart.about_cameras(first.lines[tracks], centres, inner.track))

    def adjust(start: LinesAndPoses, bent: Loss) -> Adjusted:
        """From a start, with a loss at its scale."""
        return adjust_lines(
            inner,
            start.chart.lines(),
            start.rig_from_world,
            cost=cost,
            refine_poses=refine_poses,
            rig=start.rig,
            refine_rig=refine_rig,
            models=start.models,
            prior=_prior(frames, pose_sigma),
            loss=bent,
            cautious=cautious,
            callback=callback,
            device=device,
        )

    adjusted = adjust(state, _loss(loss, cost, inner, state))
    level = adjusted.noise.measured
    if loss != "none" and not arcs.sigma_known and math.isfinite(level) and level > 0:
        # Errors of the start are in the first scale.
        adjusted = adjust(adjusted.state, Loss(loss, LOSS_SCALE * level * _unit(cost, inner, adjusted.state)))
    final = inner.seen_by(adjusted.state.models) if models else inner
    before, before_px = line_table(names, inner, tracks, first, state, None)
    lines, after_px = line_table(names, final, tracks, first, adjusted.state, adjusted)
    used = member.clone()
    used[member] = first.known[arcs.track[member]]
    if refine_poses or refine_rig:
        poses = replace(poses, cam_from_world=adjusted.state.cam_from_world, covariance=adjusted.pose_covariance.numpy())
    return AdjustedScene(
        lines,
        poses,
        before,
        adjusted,
        table,
        _scattered(after_px, used),
        _scattered(before_px, used),
        first.rests_on_one.numpy() & ~too_uncertain(lines),
        _left_out(arcs, first, member, adjusted.state.cam_from_world, names, poses.images),
        suspects(final, adjusted.state.normals(final), tuple(names[k] for k in tracks.tolist()), poses.images),
        adjusted.state.models,
        adjusted.state.rig.cam_from_rig if refine_rig and adjusted.state.rig is not None else None,
    )


def _prior(frames: Pose, sigma: tuple[float, float] | None) -> PosePrior | None:
    """The poses of all frames with the same standard deviations (rad, m), or nothing."""
    if sigma is None:
        return None
    turn, shift = (torch.full((len(frames),), value, dtype=torch.float64) for value in sigma)
    return PosePrior(frames, turn, shift)


def _no_chart() -> LineChart:
    """The chart of no line, until there are some."""
    none = torch.zeros(0, 3, dtype=torch.float64)
    return LineChart(none, none[:, 0], none[..., None].expand(0, 3, 3), none[:, 0])


def _started(
    arcs: Arcs, state: LinesAndPoses, method: tuple[str, Mapping[str, Any]], robust: bool, rounds: int, device: str
) -> tuple[LinesAndPoses, Triangulation, Bool[Tensor, " n"]]:
    """Poses mended up to `rounds` times until every track has a line, the lines, and which arcs they rest on."""
    first, member = _triangulated(arcs, state.cam_from_world, method, robust, device)
    for _ in range(rounds):
        if bool(first.known.all()):
            break
        better = _mended(arcs.rows(member), first, state)
        again, member_again = _triangulated(arcs, better.cam_from_world, method, robust, device)
        if int(again.known.sum()) <= int(first.known.sum()):
            break
        state, first, member = better, again, member_again
    return state, first, member


def _mended(arcs: Arcs, first: Triangulation, state: LinesAndPoses) -> LinesAndPoses:
    """Poses that are off leave some tracks without a line. Those that have one mend the poses, so that the others can follow."""
    inner, tracks = drop_unknown(arcs, first.known)
    lines = first.lines[tracks]
    chart = LineChart.about_cameras(lines, state.cam_from_world.centre[inner.image], inner.track)
    loss = _loss("cauchy", "sector", inner, replace(state, chart=chart))
    adjusted = adjust_lines(inner, lines, state.rig_from_world, cost="sector", rig=state.rig, loss=loss)
    return replace(state, rig_from_world=adjusted.state.rig_from_world)


def _triangulated(
    arcs: Arcs, cam_from_world: Pose, method: tuple[str, Mapping[str, Any]], robust: bool, device: str
) -> tuple[Triangulation, Bool[Tensor, " n"]]:
    """Lines of all tracks by a method with its options, and which arcs they rest on."""
    name, options = method
    covariance = arcs.covariance_px2 if arcs.sigma_known else None
    poses = cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(arcs.bearings, poses, arcs.track, arcs.tracks, arcs.by_pixel, covariance)
    if not robust:
        return triangulate_on(usable_device(device), name, planes, **options), torch.ones(len(arcs), dtype=torch.bool)
    # Poses that are off enlarge residuals beyond the stated noise.
    level = noise_level(planes)
    if arcs.sigma_known and math.isfinite(level):
        level = max(level, 1.0)
    found = robust_triangulate(planes, method=name, sigma=level if math.isfinite(level) and level > 0 else None, **options)
    return found.triangulation, found.inlier


def _scattered(distance_px: Float[Tensor, "m 2"], used: Bool[Tensor, " n"]) -> Float[np.ndarray, "n 2"]:
    every = torch.full((len(used), 2), math.nan, dtype=torch.float64)
    every[used] = distance_px
    return every.numpy()


def _left_out(
    arcs: Arcs,
    first: Triangulation,
    member: Bool[Tensor, " n"],
    cam_from_world: Pose,
    names: tuple[str, ...],
    images: tuple[str, ...],
) -> tuple[Suspect, ...]:
    """The observations that the robust triangulation left out, with their distance from the line that the others give."""
    wrong = ~member & first.known[arcs.track]
    own = arcs.rows(wrong)
    poses = cam_from_world[own.image]
    normal = (poses.rotation @ first.lines[own.track].moment_about(poses.centre)[..., None])[..., 0]
    distance = own.orthogonal_px(normal).abs().amax(-1).tolist()
    rows = zip(own.track.tolist(), own.image.tolist(), distance, strict=True)
    return tuple(Suspect(names[track], images[image], px) for track, image, px in rows)


def _loss(name: str, cost: str, arcs: Arcs, start: LinesAndPoses) -> Loss:
    """The loss bent at the median size of the residuals of the start, which pose errors and outliers leave finite."""
    if name == "none":
        return Loss()
    if arcs.sigma_known:
        return Loss(name, LOSS_SCALE * _unit(cost, arcs, start))
    size = cost_function(cost, arcs)(arcs.bearings, start.normals(arcs))[0].norm(dim=-1).median()
    return Loss(name, max(LOSS_SCALE * float(size), 1e-12))


def _unit(cost: str, arcs: Arcs, state: LinesAndPoses) -> float:
    """Standard deviation of a residual of the cost for the stated noise, or for 1 px; two residuals an arc."""
    return math.sqrt(
        weighting(cost, arcs.seen_by(state.models) if state.models else arcs, state.normals(arcs), Loss(), 1.0).expected
        / (2 * len(arcs))
    )


def parse_refine(text: str) -> tuple[str, ...]:
    """What is refined, from a list such as `lines,poses`. Raises InputError on anything else."""
    parts = tuple(part.strip() for part in text.split(",") if part.strip())
    check_refine(parts)
    return parts


def check_refine(parts: Sequence[str]) -> None:
    """Raises InputError where something else than lines, with any of `REFINABLE`, is to be refined."""
    if "lines" not in parts or any(part not in REFINABLE for part in parts):
        raise InputError(
            f"`refine` was expected to be lines, with any of poses, intrinsics and rig, found '{','.join(parts)}'; give a list "
            "such as lines,poses."
        )
