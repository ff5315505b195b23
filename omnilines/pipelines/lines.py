"""Arcs of photos with poses -> adjusted lines: matched and adjusted in rounds, where poses are refined."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from camera_models import Calibration, CameraModel, GeometryError, InputError
from omnilines.adjustment.parts_engine import Workers
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import AdjustedScene, reconstruct_lines
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.match import Matched, match_arcs, with_long_edges
from omnilines.pipelines.better_poses import poses_by_lines
from omnilines.pipelines.chance_lines import MovedLines, with_chance
from omnilines.pipelines.confirmed_lines import spare_of, with_confirmed
from omnilines.pipelines.kept_lines import KeptLines, kept_lines
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, in_order, segments_of, viewed_arcs
from omnilines.progress import Each, ProgressCallback
from omnilines.records import ImagePoses, Segments

FEWEST_HELD = 2
"""Given poses that say how large the scene is."""


def lines_of_arcs(
    found: Sequence[FoundArcs],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    progress: ProgressCallback,
    *,
    known: KnownPoses | None = None,
    workers: Workers = Workers(),
    compare: Each | None = None,
) -> KeptLines:
    """Match, triangulate, adjust, clip and filter.

    With poses refined, photos whose pose the lines contradict, or that have none, are placed by the lines of the others, and
    arcs are matched again with the better poses until no photo moves and tracks gain no more arcs (`options.rounds`). A prior
    holds the poses `known`, but for those of photos that lines put elsewhere in the end. `workers` adjust the parts of a
    scene that is divided (`options.partition`), and those of `compare` compare arcs.

    Raises GeometryError naming the stage where no line is left, and InputError where lines contradict the poses known.
    """
    turn, before, tolerance_px = 0, 0, math.inf
    held = None if known is None else _held_at_first(known, poses, options)
    while True:
        turn += 1
        # From the second round on poses are those of the adjustment: what they still lack is found anew.
        matched = _matched(viewed_arcs(found, poses, cameras), options, progress, compare)
        _require(matched)
        segments = _with_tracks(segments_of(in_order(found, poses)), matched)
        scene = _adjusted(segments, poses, cameras, options, progress, workers=workers, known=held)
        if "poses" not in options.refine or turn == options.rounds.max_rounds:
            break
        refined = replace(cameras, cameras=_refined(cameras, scene))
        moved = poses_by_lines(found, scene.poses, matched, refined, options, progress)
        members = len(matched.tracks.rows)
        settled = members < options.rounds.min_gain * before and matched.tolerance_px >= options.rounds.same_slack * tolerance_px
        if moved is None and settled and turn >= options.rounds.min_rounds:
            break
        held = still_held(known, held, scene.poses, scene.poses if moved is None else moved, options)
        before, tolerance_px = members, matched.tolerance_px
        poses, cameras = scene.poses if moved is None else moved, refined
    cameras = replace(cameras, cameras=_refined(cameras, scene))
    # Only now do long edges that bow take part: poses are those of edges that fit as they are.
    longer = _with_long_edges(matched, options, progress)
    last = still_held(known, held, scene.poses, scene.poses, options)
    if longer is not matched or last is not held:
        matched, segments, held = longer, _with_tracks(segments, longer), last
        scene = _adjusted(segments, scene.poses, cameras, options, progress, workers=workers, known=held)
        cameras = replace(cameras, cameras=_refined(cameras, scene))
    kept = kept_lines(found, segments, matched, scene, cameras.cameras, options=options, progress=progress)
    kept = replace(kept, held=held)
    again = _moved_lines(kept, found, cameras, options, progress, compare)
    kept = with_chance(kept, found, cameras.cameras, again, options=options, progress=progress)
    return _with_spare(kept, found, cameras, options, progress)


def _held_at_first(known: KnownPoses, poses: ImagePoses, options: SceneOptions) -> KnownPoses:
    """Those that agree with the poses to begin with, which may have been made better; all where too few do, as poses that are
    better beside each other may lie elsewhere as a whole."""
    agreeing = known.agreeing(poses, options.adjustment.significance)
    return known if len(agreeing.poses) < FEWEST_HELD else agreeing


def still_held(
    known: KnownPoses | None, held: KnownPoses | None, before: ImagePoses, moved: ImagePoses, options: SceneOptions
) -> KnownPoses | None:
    """Of the poses known those of photos that were held and have not moved, and all that agree with what lines tell now.

    A photo that lines moved with the poses of an early round is so held again where they put it back. Raises InputError where two
    are not left, which say how large the scene is.
    """
    if known is None or held is None:
        return None
    significance = options.adjustment.significance
    own = [moved.images.index(image) for image in before.images]
    same = (moved.cam_from_world[own].translation == before.cam_from_world.translation).all(-1).tolist()
    stayed = {image for image, stays in zip(before.images, same, strict=True) if stays}
    kept = stayed.intersection([*held.poses.images, *known.agreeing(before, significance).poses.images])
    kept |= set(known.agreeing(moved, significance).poses.images)
    if kept == set(held.poses.images):
        return held
    rows = [k for k, image in enumerate(known.poses.images) if image in kept]
    if len(rows) < FEWEST_HELD:
        raise InputError(
            f"Given poses within `pose_sigma_deg` and `pose_sigma_m` of where lines put their photos were expected, found "
            f"{len(rows)} of {len(known.poses)}; give larger deviations, or leave them out."
        )
    return replace(known, poses=known.poses.rows(rows))


def _matched(arcs: ViewedArcs, options: SceneOptions, progress: ProgressCallback, compare: Each | None) -> Matched:
    return match_arcs(
        arcs,
        min_views=options.min_views,
        tolerance_px=options.tolerance_px,
        options=options.matching,
        seed=options.seed,
        progress=progress,
        workers=compare,
    )


def _with_long_edges(matched: Matched, options: SceneOptions, progress: ProgressCallback) -> Matched:
    return with_long_edges(
        matched, min_views=options.min_views, bow_share=options.bow_share, options=options.matching, progress=progress
    )


def _moved_lines(
    kept: KeptLines,
    found: Sequence[FoundArcs],
    cameras: Calibration,
    options: SceneOptions,
    progress: ProgressCallback,
    compare: Each | None,
) -> MovedLines:
    """Matches and adjusts arcs in photos that stand elsewhere, as those of `kept` were, and with their slack and bow."""
    slack = replace(options, tolerance_px=kept.tolerance_px, bow_share=kept.matched.bow_share)
    alone = replace(slack, refine=("lines",), partition=0)

    def again(poses: ImagePoses, rows: Int[np.ndarray, " k"]) -> tuple[Matched, AdjustedScene] | None:
        """The tracks of some of the arcs, and their lines."""
        try:
            arcs = viewed_arcs(found, poses, cameras).rows(rows)
            matched = _with_long_edges(_matched(arcs, slack, progress, compare), slack, progress)
            if not len(matched.tracks):
                return None
            segments = _with_tracks(kept.segments.rows(rows), matched)
            return matched, _adjusted(segments, poses, cameras, alone, progress, workers=Workers())
        except GeometryError:
            # Too few arcs are left for any line.
            return None

    return again


def _with_spare(
    kept: KeptLines, found: Sequence[FoundArcs], cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> KeptLines:
    """With the lines that a corner or a plane confirms. They are adjusted by themselves, with cameras as they are, and poses as
    far as they are known: what poses that were refined leave uncertain is in the covariances of the lines."""
    spare = spare_of(kept.matched, options)
    if spare is None:
        return kept
    segments = _with_tracks(kept.segments, spare, len(kept.matched.tracks))
    poses = replace(kept.scene.poses, frames=None)
    known = _as_known(poses) if "poses" in options.refine else None
    alone = replace(options, refine=("lines",) if known is None else ("lines", "poses"), partition=0)
    try:
        scene = _adjusted(segments, poses, cameras, alone, progress, workers=Workers(), known=known)
    except GeometryError:
        # None of them has a line.
        return kept
    return with_confirmed(kept, found, spare, scene, cameras.cameras, options=options, progress=progress)


def _as_known(poses: ImagePoses) -> KnownPoses | None:
    """The poses with the standard deviations of a component of them, in the quadratic mean; None where none is uncertain."""
    if poses.covariance is None:
        return None
    variance = np.diagonal(poses.covariance, axis1=1, axis2=2)
    turn, shift = np.sqrt(variance[np.isfinite(variance).all(1)].reshape(-1, 2, 3).mean((0, 2)))
    return KnownPoses(poses, float(turn), float(shift)) if turn > 0.0 and shift > 0.0 else None


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
    known: KnownPoses | None = None,
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
        known=known,
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
