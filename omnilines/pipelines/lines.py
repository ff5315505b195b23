"""Arcs of photos with poses -> adjusted lines: matched and adjusted in rounds, where poses are refined."""

import math
from collections.abc import Sequence
from dataclasses import replace

from camera_models import Calibration, CameraModel, GeometryError
from omnilines.adjustment.parts_engine import Workers
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.matching.match import Matched, match_arcs
from omnilines.pipelines.arcs import FoundArcs, in_order, segments_of, viewed_arcs
from omnilines.pipelines.better_poses import poses_by_lines
from omnilines.pipelines.confirmed_lines import spare_of, with_confirmed
from omnilines.pipelines.kept_lines import KeptLines, kept_lines
from omnilines.pipelines.options import SceneOptions
from omnilines.progress import ProgressCallback
from omnilines.records import ImagePoses, Segments


def lines_of_arcs(
    found: Sequence[FoundArcs],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    progress: ProgressCallback,
    *,
    workers: Workers = Workers(),
) -> KeptLines:
    """Match, triangulate, adjust, clip and filter.

    With poses refined, photos whose pose the lines contradict, or that have none, are placed by the lines of the others, and
    arcs are matched again with the better poses until no photo moves and tracks gain no more arcs (`options.rounds`). `workers`
    adjust the parts of a scene that is divided (`options.partition`).

    Raises GeometryError naming the stage where no line is left.
    """
    turn, before, tolerance_px = 0, 0, math.inf
    while True:
        turn += 1
        # From the second round on poses are those of the adjustment: what they still lack is found anew.
        matched = match_arcs(
            viewed_arcs(found, poses, cameras),
            min_views=options.min_views,
            tolerance_px=options.tolerance_px,
            options=options.matching,
            seed=options.seed,
            progress=progress,
        )
        _require(matched)
        segments = _with_tracks(segments_of(in_order(found, poses)), matched)
        scene = _adjusted(segments, poses, cameras, options, progress, workers=workers)
        if "poses" not in options.refine or turn == options.rounds.max_rounds:
            break
        refined = replace(cameras, cameras=_refined(cameras, scene))
        moved = poses_by_lines(found, scene.poses, matched, refined, options, progress)
        members = len(matched.tracks.rows)
        settled = members < options.rounds.min_gain * before and matched.tolerance_px >= tolerance_px
        if moved is None and settled and turn >= options.rounds.min_rounds:
            break
        before, tolerance_px = members, matched.tolerance_px
        poses, cameras = scene.poses if moved is None else moved, refined
    refined = replace(cameras, cameras=_refined(cameras, scene))
    kept = kept_lines(found, segments, matched, scene, refined.cameras, options=options, progress=progress)
    return _with_spare(kept, found, refined, options, progress)


def _with_spare(
    kept: KeptLines, found: Sequence[FoundArcs], cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> KeptLines:
    """With the lines that a corner confirms. They are adjusted by themselves, with poses and cameras as they are."""
    spare = spare_of(kept.matched, options)
    if spare is None:
        return kept
    segments = _with_tracks(kept.segments, spare, len(kept.matched.tracks))
    alone = replace(options, refine=("lines",), partition=0)
    try:
        scene = _adjusted(segments, replace(kept.scene.poses, frames=None), cameras, alone, progress, workers=Workers())
    except GeometryError:
        # None of them has a line.
        return kept
    return with_confirmed(kept, found, spare, scene, cameras.cameras, options=options, progress=progress)


def _require(matched: Matched) -> None:
    if len(matched.tracks):
        return
    alike = int((matched.hypotheses.candidates > 0).sum())
    raise GeometryError(
        f"No line was found: of {len(matched.arcs)} arcs, {alike} have a partner that looks like them in another photo, and none "
        f"is confirmed by enough photos (slack {matched.tolerance_px} px); check that poses and calibration are of these photos, "
        "or give more of them."
    )


def _with_tracks(segments: Segments, matched: Matched, first: int = 0) -> Segments:
    """With the tracks, numbered from `first` on."""
    width = len(str(first or len(matched.tracks)))
    names = tuple(f"line{k:0{width}d}" for k in range(first, first + len(matched.tracks)))
    return replace(segments, track=matched.tracks.track, tracks=names, covariance_px2=matched.arcs.covariance_px2)


def _adjusted(
    segments: Segments,
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    progress: ProgressCallback,
    *,
    workers: Workers,
) -> AdjustedScene:
    progress("triangulating lines", 0, 0)
    return reconstruct_lines(
        segments,
        poses,
        cameras,
        triangulation=options.triangulation,
        triangulation_options=options.triangulation_options,
        cost=options.cost,
        refine_poses="poses" in options.refine,
        refine_cameras="intrinsics" in options.refine,
        refine_rig="rig" in options.refine,
        rig=cameras.rig,
        loss=options.loss,
        options=options.adjustment,
        # Arcs that stand out are mostly of near edges, and lines are off by them.
        cautious=True,
        device=options.device,
        partition=options.partition,
        workers=workers,
        callback=lambda step: progress("adjusting the scene", step.iteration, 0),
    )


def _refined(cameras: Calibration, scene: AdjustedScene) -> dict[str, CameraModel]:
    """The cameras as they were refined, where they were."""
    return dict(zip(cameras.cameras, scene.cameras, strict=True)) if scene.cameras else dict(cameras.cameras)
