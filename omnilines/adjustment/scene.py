"""From a table of matched segments with poses and cameras to a line scene: triangulate, adjust, state the uncertainty."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.formats.calibration_data import RigCamera
from camera_models.pose import Pose
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import ArcTable, MatchedArcs, arcs_from_segments
from omnilines.adjustment.line_table import line_table, too_uncertain
from omnilines.adjustment.lines import adjust_lines, drop_unknown, lost_frames, lost_lines
from omnilines.adjustment.memory import require_for_arcs
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.adjustment.parallel import require_directions
from omnilines.adjustment.parts_engine import Workers
from omnilines.adjustment.prior import KnownPoses, PosePrior
from omnilines.adjustment.rig import rig_of_photos
from omnilines.adjustment.start import Method, no_chart, residual_sigma, scaled_loss, started
from omnilines.adjustment.state import LinesAndPoses, Rig
from omnilines.adjustment.suspects import Suspect, suspects
from omnilines.costs import cost_named
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Outcome, Progress
from omnilines.records import ImagePoses, Lines, Segments
from omnilines.triangulation.degeneracy import without_lines
from omnilines.triangulation.result import Triangulation

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
    unplaced: tuple[str, ...] = ()
    """Photos whose arcs do not tell where they were taken: poses stay as given, and `table` is without these arcs."""

    def rms_px(self, before: bool = False) -> float:
        """Root mean square of all orthogonal distances; NaN where there is none."""
        values = self.residual_before_px if before else self.residual_px
        known = values[np.isfinite(values)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


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
    known: KnownPoses | None = None,
    robust: bool = False,
    loss: str = "none",
    cautious: bool = False,
    options: AdjustmentOptions = AdjustmentOptions(),
    callback: Callable[[Progress], None] | None = None,
    device: str = "cpu",
    partition: int = 0,
    workers: Workers = Workers(),
) -> AdjustedScene:
    """Triangulate every track and adjust lines and, if asked, poses, cameras and the rig; a row of `lines` per track.

    `triangulation_options` are those of the method's function, `cautious` is that of `adjust_lines`. `rig` is that of the
    calibration; it holds the photos of a frame together where `poses` name frames. `known` are poses that a
    prior holds. With `robust`, observations of other lines are found by consensus and left out. `device` is where lines are
    triangulated and the iterations of the adjustment run, `cpu` or `cuda`; the consensus stays on the processor. `partition`
    and `workers` are those of `adjust_lines`.

    Raises InputError where files do not fit together or the problem into memory, GeometryError where no track has a line, and
    where poses are refined by lines that are all parallel.
    """
    require_for_arcs(len(segments.track), len(segments.tracks), len(poses))
    table = arcs_from_segments(segments, poses, cameras, with_nodes=cost_named(cost).integrates)
    names, unplaced = segments.tracks, torch.zeros(len(poses), dtype=torch.bool)

    def frames_of(photos: ImagePoses) -> tuple[Rig | None, Pose]:
        held = not (refine_poses or refine_rig)
        return rig_of_photos(photos, list(cameras), rig or {}, refine_rig, options.most_turned_deg, held=held)

    mounted, frames = frames_of(poses)
    prior = None if known is None else known.prior(poses, lambda photos: frames_of(photos)[1])
    given = LinesAndPoses(frames, no_chart(), mounted, tuple(cameras.values()) if refine_cameras else ())
    method = Method(triangulation, triangulation_options or {}, robust, device)

    def adjust(inner: MatchedArcs, start: LinesAndPoses, scaled: Loss | None = None) -> Adjusted:
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
            prior=prior,
            loss=scaled or scaled_loss(loss, cost, inner, start, options),
            cautious=cautious,
            options=options,
            callback=callback,
            device=device,
            partition=partition,
            workers=workers,
        )

    while True:
        arcs = table.arcs
        state, first, member = started(arcs, given, method, options.start_rounds if refine_poses else 0, options)
        if refine_poses and known is None:
            require_directions(arcs.rows(member), first)
        rests, state, adjusted = _sound(arcs, member, first, state, adjust)
        lost = _lost_photos(rests.inner, adjusted, prior, options.weak_share) if refine_poses else torch.zeros_like(unplaced)
        if not bool(lost.any()):
            break
        unplaced |= lost
        table = table.of_rows(~unplaced[arcs.image])
    level = adjusted.noise.measured
    if loss != "none" and not arcs.sigma_known and math.isfinite(level) and level > 0:
        # Errors of the start are in the first scale.
        unit = residual_sigma(cost, rests.inner, adjusted.state)
        adjusted = adjust(rests.inner, adjusted.state, Loss(loss, options.loss_scale * level * unit))
    if refine_poses or refine_rig:
        told = _told_photos(rests.inner, adjusted.state, refine_rig)[:, None, None]
        covariance = torch.where(told, adjusted.pose_covariance, math.nan).numpy()
        poses = replace(poses, cam_from_world=adjusted.state.cam_from_world, covariance=covariance)
    scene = _described(rests, state, adjusted, poses, names, table=table, refined_rig=refine_rig, options=options)
    return replace(scene, unplaced=tuple(name for name, lost in zip(poses.images, unplaced.tolist(), strict=True) if lost))


@dataclass(frozen=True)
class _Rests:
    """What the lines rest on."""

    inner: MatchedArcs
    """Arcs of tracks that have a line, which are renumbered."""
    tracks: Int[Tensor, " k"]
    """The old number of each."""
    member: Bool[Tensor, " n"]
    """Of all arcs, those that were not left out."""
    first: Triangulation


def _sound(
    arcs: MatchedArcs,
    member: Bool[Tensor, " n"],
    first: Triangulation,
    start: LinesAndPoses,
    adjust: Callable[[MatchedArcs, LinesAndPoses], Adjusted],
) -> tuple[_Rests, LinesAndPoses, Adjusted]:
    """The adjustment of all lines that stay determined, and its start. One that does not, such as one that comes to lie in a
    camera, is left out: it would leave all others, and the poses, without covariances."""
    while True:
        inner, tracks = drop_unknown(arcs.rows(member), first.known)
        centres = start.cam_from_world.centre[inner.image]
        state = replace(start, chart=LineChart.about_cameras(first.lines[tracks], centres, inner.track))
        adjusted = adjust(inner, state)
        lost = lost_lines(inner, adjusted.state) if adjusted.outcome is Outcome.DEGENERATE else {}
        if not any(bool(some.any()) for some in lost.values()):
            return _Rests(inner, tracks, member, first), state, adjusted
        for status, some in lost.items():
            first = without_lines(first, tracks[some], status)


def _told_photos(arcs: MatchedArcs, state: LinesAndPoses, refined_rig: bool) -> Bool[Tensor, " images"]:
    """Photos of which arcs tell something: their own, or those of another photo of their instant."""
    seen = torch.bincount(arcs.image, minlength=arcs.images) > 0
    if state.rig is None or refined_rig:
        return seen
    frames = torch.zeros(len(state.rig_from_world), dtype=torch.bool).index_fill(0, state.rig.frame[seen], True)
    return frames[state.rig.frame]


def _lost_photos(arcs: MatchedArcs, adjusted: Adjusted, prior: PosePrior | None, weak_share: float) -> Bool[Tensor, " images"]:
    """Photos whose arcs hardly tell where they were taken, nor a prior: one that its arcs leave undetermined would leave all
    others and the lines without covariances. None where the other photos have no line in common."""
    state, level = adjusted.state, adjusted.noise.level
    frames = lost_frames(arcs, state, weak_share, level if math.isfinite(level) else 1.0)
    if prior is not None:
        frames &= torch.isinf(prior.sigma_m)
    lost = frames if state.rig is None else frames[state.rig.frame]
    return lost if bool((arcs.rows(~lost[arcs.image]).photos() > 1).any()) else torch.zeros_like(lost)


def _described(
    rests: _Rests,
    state: LinesAndPoses,
    adjusted: Adjusted,
    poses: ImagePoses,
    names: tuple[str, ...],
    *,
    table: ArcTable,
    refined_rig: bool,
    options: AdjustmentOptions,
) -> AdjustedScene:
    """The scene before (`state`) and after the adjustment, with what does not fit it."""
    inner, tracks, member, first = rests.inner, rests.tracks, rests.member, rests.first
    final = inner.seen_by(adjusted.state.models) if adjusted.state.models else inner
    weak, views = options.weak_share, table.arcs.rows(member).photos()
    before, before_px = line_table(names, inner, tracks, first, state, views=views, adjusted=None, weak_share=weak)
    lines, after_px = line_table(names, final, tracks, first, adjusted.state, views=views, adjusted=adjusted, weak_share=weak)
    used = member.clone()
    used[member] = first.known[table.arcs.track[member]]
    end, seen = adjusted.state, tuple(names[k] for k in tracks.tolist())
    return AdjustedScene(
        lines=lines,
        poses=poses,
        before=before,
        adjusted=adjusted,
        table=table,
        residual_px=_scattered(after_px, used),
        residual_before_px=_scattered(before_px, used),
        rests_on_one=first.rests_on_one.numpy() & ~too_uncertain(lines, weak),
        wrong=_left_out(table.arcs, first, member, end.cam_from_world, names, images=poses.images),
        suspect=suspects(final, end.normals(final), seen, poses.images, options.significance),
        cameras=end.models,
        cam_from_rig=end.rig.cam_from_rig if refined_rig and end.rig is not None else None,
    )


def _scattered(distance_px: Float[Tensor, "m 2"], used: Bool[Tensor, " n"]) -> Float[np.ndarray, "n 2"]:
    every = torch.full((len(used), 2), math.nan, dtype=torch.float64)
    every[used] = distance_px
    return every.numpy()


def _left_out(
    arcs: MatchedArcs,
    first: Triangulation,
    member: Bool[Tensor, " n"],
    cam_from_world: Pose,
    names: tuple[str, ...],
    *,
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
