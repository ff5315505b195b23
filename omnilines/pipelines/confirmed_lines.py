"""Lines of one photo fewer than are asked for, where a corner or a plane confirms them.

Arcs of three photos meet in a line that is not there far more often than those of four. But where they end together with the arcs
of another line, such a line passes that one somewhere: one that meets it, to within what is known of both, is there. So is one
that lies in the plane of a line beside it, among lines that mostly lie anywhere or in few planes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from camera_models import CameraModel
from omnilines.adjustment.scene import AdjustedScene
from omnilines.matching.match import Matched
from omnilines.matching.tracks import FIRST_VIEWS, spare_tracks
from omnilines.pipelines.coplanar_lines import lying
from omnilines.pipelines.cornered_lines import corners_of, meeting
from omnilines.pipelines.kept_lines import KeptLines, counted, photo_counts
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.passing_lines import PassingLines, passing_lines
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.progress import ProgressCallback
from omnilines.records import Lines, StageCount
from omnilines.structure.families import line_families


def spare_of(matched: Matched, options: SceneOptions) -> Matched | None:
    """The tracks that a corner or a plane may confirm, in place of those of `matched`; None where there are none."""
    views = max(options.min_views - 1, FIRST_VIEWS)
    kept = options.kept_lines
    if views == options.min_views or min(kept.min_meeting, kept.min_lying) >= 1.0:
        return None
    tracks = spare_tracks(matched.arcs, matched.hypotheses, matched.tracks, views, options.matching)
    return replace(matched, tracks=tracks) if len(tracks) else None


def with_confirmed(
    kept: KeptLines,
    found: Sequence[FoundArcs],
    spare: Matched,
    scene: AdjustedScene,
    cameras: Mapping[str, CameraModel],
    *,
    options: SceneOptions,
    progress: ProgressCallback,
) -> KeptLines:
    """The lines `kept`, as they are, and after them those of `spare`, adjusted in `scene` with the same poses, that meet one of
    them with more than `options.kept_lines.min_meeting`, or lie in the plane of one with more than `min_lying`."""
    more = passing_lines(found, spare, scene, cameras, options=options, progress=progress)
    confirmed = _confirmed(kept, more, options)
    first, rows = len(kept.scene.lines), np.flatnonzero(confirmed)
    table = _joined(kept.scene.lines, more.table, rows)
    number = np.full(len(confirmed) + 1, -1)
    number[rows] = first + np.arange(len(rows))
    own = np.where(kept.segments.track >= 0, kept.segments.track, number[more.row])
    segments = replace(kept.segments, track=own, tracks=table.tracks)
    dropped = counted([("of one photo fewer, not confirmed", len(confirmed) - len(rows))])
    stage = StageCount("lines, with confirmed ones of one photo fewer", len(table), dropped)
    return replace(
        kept,
        scene=replace(kept.scene, lines=table),
        segments=segments,
        stages=(*kept.stages, stage),
        photos=photo_counts(segments, kept.matched, options.min_views),
        track=np.append(kept.track, more.track[rows] + len(kept.matched.tracks)),
    )


def _confirmed(kept: KeptLines, more: PassingLines, options: SceneOptions) -> Bool[np.ndarray, " m"]:
    """The rows of `more` that meet a line that is kept, or lie in the plane of one. All are as they were measured: which families
    there are must not hang on lines that may not be there."""
    sure = np.arange(len(kept.track) + len(more.track)) < len(kept.track)
    track = np.append(kept.track, more.track + len(kept.matched.tracks))
    of_arc = np.where(kept.segments.track >= 0, kept.segments.track, np.where(more.row >= 0, more.row + len(kept.track), -1))
    arcs, corner = kept.matched.arcs.with_poses(kept.scene.poses.cam_from_world), options.structure.corners
    corners = corners_of(arcs, np.append(track, -1)[of_arc], corner)
    lines = _joined(kept.scene.lines, more.table, np.arange(len(more.track)))
    meets = meeting(lines, track, corners, sure, corner)[~sure] > options.kept_lines.min_meeting
    families = line_families(kept.scene.lines, options.structure.families)
    return meets | (lying(lines, track, families, sure, options.structure)[~sure] > options.kept_lines.min_lying)


def _joined(lines: Lines, more: Lines, rows: Int[np.ndarray, " k"]) -> Lines:
    """The lines, and some of others."""
    assert lines.covariance is not None and lines.chart_centre_m is not None and lines.chart_scale_m is not None
    assert more.covariance is not None and more.chart_centre_m is not None and more.chart_scale_m is not None
    assert lines.shown_share is not None and more.shown_share is not None
    # Moved photos were asked for lines of as many photos as the others have.
    chance = None if lines.chance_share is None else np.append(lines.chance_share, np.full(len(rows), np.nan))
    return Lines(
        lines.tracks + tuple(more.tracks[k] for k in rows.tolist()),
        np.append(lines.ends_m, more.ends_m[rows], axis=0),
        np.append(lines.views, more.views[rows]),
        np.append(lines.rms_px, more.rms_px[rows]),
        np.append(lines.sigma_m, more.sigma_m[rows]),
        lines.status + tuple(more.status[k] for k in rows.tolist()),
        np.append(lines.covariance, more.covariance[rows], axis=0),
        np.append(lines.chart_centre_m, more.chart_centre_m[rows], axis=0),
        np.append(lines.chart_scale_m, more.chart_scale_m[rows]),
        lines.unit,
        np.append(lines.shown_share, more.shown_share[rows]),
        chance,
    )
