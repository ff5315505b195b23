"""Arcs of photos with poses -> adjusted lines, clipped to what the photos show, and what every stage kept and dropped."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from camera_models import Calibration, CameraModel, GeometryError
from omnilines.adjustment.lines import end_sigma_m
from omnilines.adjustment.scene import LineScene, reconstruct_lines
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.matching.chance import chance_of_lines
from omnilines.matching.match import Matched, match_arcs
from omnilines.pipelines.arc_counts import arc_stages, counted, photo_counts
from omnilines.pipelines.line_poses import poses_by_lines
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.pipelines.viewed_arcs import segments_of, viewed_arcs
from omnilines.progress import ProgressCallback
from omnilines.records import ImagePoses, Lines, PhotoCount, Segments, StageCount
from omnilines.structure.clipping import Stretches, supported_stretches

MOST_SLACKS = 3.0
"""A line is dropped whose arcs lie farther from it (RMS) than so many times the slack, or LEAST_RMS_PX."""
LEAST_RMS_PX = 1.5
LEAST_ROUNDS, MOST_ROUNDS = 2, 12
"""Times that arcs are matched where poses are refined."""
STILL_GAINS = 1.01
"""Times the arcs that tracks had a round before from which on another round is worth its time."""
MOST_CHANCE = 1e-3
"""A line is dropped that photos would show with a larger probability if it were not there."""
LEAST_LENGTH_SIGMA = 3.0
"""A line shorter than so many standard deviations of its ends across it has no direction."""


@dataclass(frozen=True)
class SceneOptions:
    """How a line scene is made."""

    least_views: int
    slack_px: float | None
    triangulation: str
    cost: str
    loss: str
    refine: tuple[str, ...]
    device: str
    seed: int
    triangulation_options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class PhotoScene:
    """The scene of a set of photos."""

    scene: LineScene
    """`lines` are the supported ones."""
    segments: Segments
    """All arcs in photos with poses, with the track of each; covariances hold the slack."""
    stages: tuple[StageCount, ...]
    slack_px: float
    supported: Int[np.ndarray, " k"]
    """Line of `scene.lines` of every arc of `segments`, -1 for none."""
    photos: tuple[PhotoCount, ...]
    """What became of the arcs of each photo of `segments`."""
    matched: Matched
    """The tracks that the lines come from, with the poses that they were matched with."""


def photo_scene(
    found: Sequence[FoundArcs], poses: ImagePoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> PhotoScene:
    """Match, triangulate, adjust, clip and filter.

    With poses refined, photos whose pose the lines contradict, or that have none, are placed by the lines of the others, and
    arcs are matched again with the better poses until no photo moves and tracks gain no more arcs, MOST_ROUNDS times at most.

    Raises GeometryError naming the stage where no line is left.
    """
    turn, before, slack_px = 0, 0, math.inf
    while True:
        turn += 1
        # From the second round on poses are those of the adjustment: what they still lack is found anew.
        matched = match_arcs(
            viewed_arcs(found, poses, cameras),
            least_views=options.least_views,
            slack_px=options.slack_px,
            seed=options.seed,
            progress=progress,
        )
        _require(matched)
        segments = _with_tracks(segments_of(found, poses), matched)
        scene = _adjusted(segments, poses, cameras, options, progress)
        if "poses" not in options.refine or turn == MOST_ROUNDS:
            break
        refined = replace(cameras, cameras=_refined(cameras, scene))
        moved = poses_by_lines(found, scene.poses, matched, refined, options.seed, progress)
        members = len(matched.tracks.rows)
        settled = members < STILL_GAINS * before and matched.slack_px >= slack_px
        if moved is None and settled and turn >= LEAST_ROUNDS:
            break
        before, slack_px = members, matched.slack_px
        poses, cameras = scene.poses if moved is None else moved, refined
    return _clipped(found, segments, matched, scene, _refined(cameras, scene), options, progress)


def _require(matched: Matched) -> None:
    if len(matched.tracks):
        return
    alike = int((matched.hypotheses.candidates > 0).sum())
    raise GeometryError(
        f"No line was found: of {len(matched.arcs)} arcs, {alike} have a partner that looks like them in another photo, and none "
        f"is confirmed by enough photos (slack {matched.slack_px} px); check that poses and calibration are of these photos, or "
        "give more of them."
    )


def _with_tracks(segments: Segments, matched: Matched) -> Segments:
    width = len(str(len(matched.tracks)))
    names = tuple(f"line{k:0{width}d}" for k in range(len(matched.tracks)))
    return replace(segments, track=matched.tracks.track, tracks=names, covariance_px2=matched.arcs.covariance_px2)


def _adjusted(
    segments: Segments, poses: ImagePoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> LineScene:
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
        # Arcs that stand out are mostly of near edges, and lines are off by them.
        cautious=True,
        device=options.device,
        callback=lambda step: progress("adjusting the scene", step.iteration, 0),
    )


def _refined(cameras: Calibration, scene: LineScene) -> dict[str, CameraModel]:
    """The cameras as they were refined, where they were."""
    return dict(zip(cameras.cameras, scene.cameras, strict=True)) if scene.cameras else dict(cameras.cameras)


def _clipped(
    found: Sequence[FoundArcs],
    segments: Segments,
    matched: Matched,
    scene: LineScene,
    cameras: Mapping[str, CameraModel],
    options: SceneOptions,
    progress: ProgressCallback,
) -> PhotoScene:
    """The lines that pass, clipped, and the counts of all stages."""
    progress("clipping lines", 0, 0)
    lines = scene.lines
    limit_px = max(MOST_SLACKS * matched.slack_px, LEAST_RMS_PX)
    known = lines.known
    far = known & (lines.rms_px > limit_px)
    # Of lines that rest on one camera most are right: the table calls them weak, and keeps them.
    weak = known & ~far & (np.array(lines.status) == "weak") & ~scene.rests_on_one
    kept = np.flatnonzero(known & ~far & ~weak)
    seen = _supported(matched, kept, scene)
    progress("comparing lines with chance", 0, 0)
    camera_of = {arcs.photo.name: cameras[arcs.camera] for arcs in found}
    stretches = _beyond_chance(matched, kept, scene, seen, [camera_of[name] for name in scene.poses.images])
    unsupported, by_chance = -np.diff([len(kept), len(np.unique(seen.line)), len(np.unique(stretches.line))])
    table, row = _table(lines, scene, kept, stretches)
    if not len(table):
        none = f"{int((~known).sum())} have no line in space, {int(far.sum())} lie more than {limit_px:.1f} px from their arcs"
        raise GeometryError(
            f"No line was left: of {len(lines)} triangulated, {none}, {int(weak.sum())} are too uncertain, {unsupported} are "
            f"nowhere shown by {options.least_views} photos, and {by_chance} by chance alone; give photos from more places."
        )
    filtered = (
        *((f"status {status}", count) for status, count in Counter(lines.status).items() if status not in ("ok", "weak")),
        (f"more than {limit_px:.1f} px from their arcs", int(far.sum())),
        ("weak: too uncertain for their distance", int(weak.sum())),
        ("nowhere supported by enough photos", int(unsupported)),
        ("by chance as many photos would show them", int(by_chance)),
    )
    stages = (*arc_stages(found, segments, matched, options.least_views), StageCount("lines", len(table), counted(filtered)))
    supported = _arcs_of_stretches(matched, kept, scene, stretches, row)
    segments = replace(segments, track=supported, tracks=table.tracks)
    photos = photo_counts(segments, matched, options.least_views)
    return PhotoScene(replace(scene, lines=table), segments, stages, matched.slack_px, supported, photos, matched)


def _lines_of(scene: LineScene, tracks: Int[np.ndarray, " k"]) -> PlueckerLines:
    ends = torch.as_tensor(scene.lines.ends_m[tracks])
    return PlueckerLines.from_points(ends[:, 0], ends[:, 1])


def _supported(matched: Matched, kept: Int[np.ndarray, " k"], scene: LineScene) -> Stretches:
    """Stretches of the lines `kept`, numbered as there."""
    arcs, lines = matched.arcs.with_poses(scene.poses.cam_from_world), _lines_of(scene, kept)
    rows, line = matched.tracks.members(kept)
    positions, sigma, in_front = arcs.places(lines, rows, line)
    return supported_stretches(
        lines,
        line=line[in_front],
        positions_m=positions[in_front],
        sigma_m=sigma[in_front],
        image=arcs.image[rows[in_front]],
        enough_views=matched.tracks.enough_views[kept],
    )


def _beyond_chance(
    matched: Matched, kept: Int[np.ndarray, " k"], scene: LineScene, stretches: Stretches, cameras: Sequence[CameraModel]
) -> Stretches:
    """The stretches that more photos show than would by chance; `cameras` has one for each photo."""
    own = _arcs_of_stretches(matched, kept, scene, stretches, np.arange(len(stretches.line)))
    lines = _lines_of(scene, kept)[torch.as_tensor(stretches.line)]
    chance = chance_of_lines(matched.arcs.with_poses(scene.poses.cam_from_world), lines, stretches.positions_m, own, cameras)
    return stretches.rows(np.flatnonzero(chance <= MOST_CHANCE))


def _table(
    lines: Lines, scene: LineScene, kept: Int[np.ndarray, " k"], stretches: Stretches
) -> tuple[Lines, Int[np.ndarray, " s"]]:
    """One row for each stretch, and which stretch it is; stretches too short for their uncertainty are left out."""
    track = kept[stretches.line]
    charted = np.flatnonzero(np.isfinite(lines.chart_scale_m)) if lines.chart_scale_m is not None else kept
    at = torch.as_tensor(np.searchsorted(charted, track))
    chart: LineChart = scene.adjusted.state.chart[at]
    sigma = end_sigma_m(chart, scene.adjusted.line_covariance[at], torch.as_tensor(stretches.ends_m)).numpy()
    length = np.linalg.norm(stretches.ends_m[:, 1] - stretches.ends_m[:, 0], axis=-1)
    row = np.flatnonzero(length > LEAST_LENGTH_SIGMA * sigma)
    track = track[row]
    return (
        Lines(
            _names(lines.tracks, track),
            stretches.ends_m[row],
            stretches.views[row],
            lines.rms_px[track],
            sigma[row],
            tuple(lines.status[k] for k in track.tolist()),
            None if lines.covariance is None else lines.covariance[track],
            None if lines.chart_centre_m is None else lines.chart_centre_m[track],
            None if lines.chart_scale_m is None else lines.chart_scale_m[track],
        ),
        row,
    )


def _names(tracks: tuple[str, ...], track: Int[np.ndarray, " s"]) -> tuple[str, ...]:
    """line7 for the first stretch of a line, line7-2 for the second."""
    seen: Counter[int] = Counter()
    names = []
    for k in track.tolist():
        seen[k] += 1
        names.append(tracks[k] if seen[k] == 1 else f"{tracks[k]}-{seen[k]}")
    return tuple(names)


def _arcs_of_stretches(
    matched: Matched, kept: Int[np.ndarray, " k"], scene: LineScene, stretches: Stretches, row: Int[np.ndarray, " s"]
) -> Int[np.ndarray, " n"]:
    """The row of the table that every arc supports: of the stretches of its line the one that it overlaps most."""
    rows, line = matched.tracks.members(kept)
    positions, in_front = matched.arcs.with_poses(scene.poses.cam_from_world).positions(_lines_of(scene, kept), rows, line)
    first, last = (np.searchsorted(stretches.line, line, side) for side in ("left", "right"))
    arc = np.repeat(np.arange(len(rows)), last - first)
    stretch = np.arange(len(arc)) - np.repeat(np.cumsum(last - first) - last, last - first)
    low, high = stretches.positions_m[stretch].T
    overlap = np.minimum(positions[arc, 1], high) - np.maximum(positions[arc, 0], low)
    number = np.full(len(stretches.line), -1)
    number[row] = np.arange(len(row))
    usable = in_front[arc] & (overlap > 0) & (number[stretch] >= 0)
    # Of the stretches of one arc the longest overlap is written last.
    order = np.flatnonzero(usable)[np.argsort(overlap[usable], kind="stable")]
    place = np.full(len(matched.arcs), -1)
    place[rows[arc[order]]] = number[stretch[order]]
    return place
