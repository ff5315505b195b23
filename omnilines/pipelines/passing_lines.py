"""Lines clipped to what the photos show, and those that fail left out."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage

from camera_models import CameraModel
from omnilines.adjustment.lines import end_sigma_m
from omnilines.adjustment.scene import AdjustedScene
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.matching.chance import line_evidence
from omnilines.matching.match import Matched
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.progress import ProgressCallback
from omnilines.records import Lines
from omnilines.structure.clipping import Stretches, supported_stretches


class Dropped(NamedTuple):
    """How many lines did not pass, by the reason."""

    far: int
    weak: int
    unsupported: int
    by_chance: int
    hardly_shown: int


class PassingLines(NamedTuple):
    """The lines of tracks that pass, clipped."""

    table: Lines
    """One row for each stretch."""
    track: Int[np.ndarray, " k"]
    """Of each row."""
    row: Int[np.ndarray, " n"]
    """Of the table that every arc supports, -1 for none."""
    limit_px: float
    """From their arcs, beyond which lines are far."""
    dropped: Dropped


def passing_lines(
    found: Sequence[FoundArcs],
    matched: Matched,
    scene: AdjustedScene,
    cameras: Mapping[str, CameraModel],
    *,
    options: SceneOptions,
    progress: ProgressCallback,
) -> PassingLines:
    """The lines that pass, of the adjusted tracks of `matched`; there may be none."""
    limits = options.kept_lines
    progress("clipping lines", 0, 0)
    lines = scene.lines
    limit_px = max(limits.max_rms_tolerances * matched.tolerance_px, limits.max_rms_px)
    known = lines.known
    far = known & (lines.rms_px > np.maximum(limit_px, limits.max_rms_tolerances * _typical_bow_px(matched)))
    # Of lines that rest on one camera most are right: the table calls them weak, and keeps them.
    weak = known & ~far & (np.array(lines.status) == "weak") & ~scene.rests_on_one
    kept = np.flatnonzero(known & ~far & ~weak)
    seen = _supported(matched, kept, scene, options)
    progress("comparing lines with chance", 0, 0)
    camera_of = {arcs.photo.name: cameras[arcs.camera] for arcs in found}
    stretches, shown_share = _evident(matched, kept, scene, seen, [camera_of[name] for name in scene.poses.images], options)
    enough = np.flatnonzero(shown_share >= limits.min_shown_share)
    shown, shown_share = stretches.rows(enough), shown_share[enough]
    left = [len(kept), *(len(np.unique(some.line)) for some in (seen, stretches, shown))]
    unsupported, by_chance, hardly_shown = (-np.diff(left)).tolist()
    stretches = shown
    table, row = _table(lines, scene, kept, stretches, shown_share, limits.min_length_sigmas)
    dropped = Dropped(int(far.sum()), int(weak.sum()), unsupported, by_chance, hardly_shown)
    supported = _arcs_of_stretches(matched, kept, scene, stretches, row)
    return PassingLines(table, kept[stretches.line[row]], supported, limit_px, dropped)


def _typical_bow_px(matched: Matched) -> Float[np.ndarray, " t"]:
    """Of each track the median of what its arcs were given as edges are not quite straight."""
    tracks = matched.tracks
    return ndimage.median(matched.bow_px, tracks.track, np.arange(len(tracks)))


def _lines_of(scene: AdjustedScene, tracks: Int[np.ndarray, " k"]) -> PlueckerLines:
    ends = torch.as_tensor(scene.lines.ends_m[tracks])
    return PlueckerLines.from_points(ends[:, 0], ends[:, 1])


def _supported(matched: Matched, kept: Int[np.ndarray, " k"], scene: AdjustedScene, options: SceneOptions) -> Stretches:
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
        options=options.structure.clipping,
    )


def _evident(
    matched: Matched,
    kept: Int[np.ndarray, " k"],
    scene: AdjustedScene,
    stretches: Stretches,
    cameras: Sequence[CameraModel],
    options: SceneOptions,
) -> tuple[Stretches, Float[np.ndarray, " s"]]:
    """The stretches that more photos show than would by chance, and the share of each that photos show (`line_evidence`);
    `cameras` has one for each photo."""
    own = _arcs_of_stretches(matched, kept, scene, stretches, np.arange(len(stretches.line)))
    lines = _lines_of(scene, kept)[torch.as_tensor(stretches.line)]
    arcs = matched.arcs.with_poses(scene.poses.cam_from_world)
    found = line_evidence(
        arcs, lines, stretches.positions_m, own, cameras, neighbours=matched.hypotheses.neighbours, options=options.matching
    )
    rows = np.flatnonzero(found.chance <= options.kept_lines.max_chance)
    return stretches.rows(rows), found.shown_share[rows]


def _table(
    lines: Lines,
    scene: AdjustedScene,
    kept: Int[np.ndarray, " k"],
    stretches: Stretches,
    shown_share: Float[np.ndarray, " s"],
    min_length_sigmas: float,
) -> tuple[Lines, Int[np.ndarray, " r"]]:
    """One row for each stretch, and which stretch it is; stretches too short for their uncertainty are left out."""
    track = kept[stretches.line]
    charted = np.flatnonzero(np.isfinite(lines.chart_scale_m)) if lines.chart_scale_m is not None else kept
    at = torch.as_tensor(np.searchsorted(charted, track))
    chart: LineChart = scene.adjusted.state.chart[at]
    sigma = end_sigma_m(chart, scene.adjusted.line_covariance[at], torch.as_tensor(stretches.ends_m)).numpy()
    length = np.linalg.norm(stretches.ends_m[:, 1] - stretches.ends_m[:, 0], axis=-1)
    row = np.flatnonzero(length > min_length_sigmas * sigma)
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
            shown_share=shown_share[row],
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
    matched: Matched, kept: Int[np.ndarray, " k"], scene: AdjustedScene, stretches: Stretches, row: Int[np.ndarray, " s"]
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
