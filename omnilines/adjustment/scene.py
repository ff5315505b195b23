"""From a table of matched segments with poses and cameras to a line scene: triangulate, adjust, state the uncertainty."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from omnilines.adjustment.arcs import Arcs, ArcTable, arcs_from_segments
from omnilines.adjustment.lines import Adjusted, LinesAndPoses, adjust_lines, drop_unknown, end_sigma_m, factor_of
from omnilines.costs import sector
from omnilines.geometry.line import PlueckerLines, segment_ends
from omnilines.geometry.line_chart import LineChart
from omnilines.least_squares import Loss, Progress
from omnilines.records import ImagePoses, Lines, Segments
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation

WEAK_SIGMA = 0.1
"""A line whose ends are uncertain by more than this share of its distance from the cameras is called weak."""
LOSS_SCALE = 2.0
"""Robust losses bend at this many times the known noise, or the median residual of the start where no noise is given."""


@dataclass(frozen=True)
class LineScene:
    """Adjusted lines and poses, and the same lines as they were triangulated."""

    lines: Lines
    poses: ImagePoses
    before: Lines
    adjusted: Adjusted
    table: ArcTable
    residual_px: Float[np.ndarray, "n 2"]
    """Orthogonal distance of both ends of every arc of `table`; NaN for tracks without a line."""
    residual_before_px: Float[np.ndarray, "n 2"]

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
    cost: str = "sector",
    refine_poses: bool = False,
    loss: str = "none",
    callback: Callable[[Progress], None] | None = None,
) -> LineScene:
    """Triangulate every track and adjust lines and, if asked, poses. One row of `lines` per track, with its status.

    Raises InputError where files do not fit together and GeometryError when no track determines a line.
    """
    table = arcs_from_segments(segments, poses, cameras)
    arcs = table.arcs
    per_row = poses.cam_from_world[arcs.image]
    first = triangulate(triangulation, PlaneObservations.from_arcs(arcs.bearings, per_row, arcs.track, arcs.tracks))
    inner, tracks = drop_unknown(arcs, first.known)
    start = first.lines[tracks]
    start_state = _state(inner, start, poses.cam_from_world)
    adjusted = adjust_lines(
        inner,
        start,
        poses.cam_from_world,
        cost=cost,
        refine_poses=refine_poses,
        loss=_loss(loss, cost, inner, start_state),
        callback=callback,
    )
    before, before_px = _rows(segments, arcs, inner, tracks, first, start_state, None)
    lines, after_px = _rows(segments, arcs, inner, tracks, first, adjusted.state, adjusted)
    moved = replace(poses, cam_from_world=adjusted.state.cam_from_world, covariance=adjusted.pose_covariance.numpy())
    return LineScene(lines, moved if refine_poses else poses, before, adjusted, table, after_px, before_px)


def _state(arcs: Arcs, lines: PlueckerLines, cam_from_world: Pose) -> LinesAndPoses:
    return LinesAndPoses(cam_from_world, LineChart.about_cameras(lines, cam_from_world.centre[arcs.image], arcs.track))


def _loss(name: str, cost: str, arcs: Arcs, start: LinesAndPoses) -> Loss:
    """The loss bent at the median size of the residuals of the start, which pose errors and outliers leave finite."""
    if name == "none":
        return Loss()
    if cost == "whitened" and arcs.sigma_known:
        return Loss(name, LOSS_SCALE)
    normal = start.normals(arcs)
    size = sector.residual(factor_of(cost, arcs, normal), normal).norm(dim=-1).median()
    return Loss(name, max(LOSS_SCALE * float(size), 1e-12))


def _rows(
    segments: Segments,
    arcs: Arcs,
    inner: Arcs,
    tracks: Tensor,
    first: Triangulation,
    state: LinesAndPoses,
    adjusted: Adjusted | None,
) -> tuple[Lines, Float[np.ndarray, "n 2"]]:
    """The table of all tracks for one state, and the orthogonal distances of every arc."""
    count = arcs.tracks
    lines = state.chart.lines()
    ends, _ = segment_ends(lines, state.cam_from_world[inner.image], inner.bearings, inner.track)
    distance = inner.orthogonal_px(state.normals(inner)).detach()
    place = torch.full((count,), -1)
    place[tracks] = torch.arange(len(tracks))
    every = torch.full((len(arcs), 2), math.nan, dtype=torch.float64)
    every[place[arcs.track] >= 0] = distance
    squares = torch.zeros(len(tracks), dtype=torch.float64).index_add_(0, inner.track, (distance**2).sum(-1))
    ends_by_track = torch.full((count, 2, 3), math.nan, dtype=torch.float64)
    rms = torch.full((count,), math.nan, dtype=torch.float64)
    sigma = torch.full((count,), math.nan, dtype=torch.float64)
    ends_by_track[tracks] = ends
    rms[tracks] = (squares / (2 * torch.bincount(inner.track, minlength=len(tracks)))).sqrt()
    status = list(first.status_names)
    covariance = None
    if adjusted is not None:
        sigma[tracks] = end_sigma_m(state.chart, adjusted.line_covariance, ends)
        covariance = np.full((count, 4, 4), np.nan)
        covariance[tracks.numpy()] = adjusted.line_covariance.numpy()
        weak = sigma[tracks] > WEAK_SIGMA * state.chart.scale
        for track in tracks[weak | ~torch.isfinite(sigma[tracks])].tolist():
            status[track] = "weak"
    # A line none of whose arcs lies in front of its camera has no ends to show.
    for track in tracks[~torch.isfinite(ends).all(-1).all(-1)].tolist():
        status[track], rms[track], sigma[track] = "behind", math.nan, math.nan
        ends_by_track[track] = math.nan
    centre, scale = np.full((count, 3), np.nan), np.full(count, np.nan)
    centre[tracks.numpy()], scale[tracks.numpy()] = state.chart.centre.numpy(), state.chart.scale.numpy()
    table = Lines(
        segments.tracks,
        ends_by_track.numpy(),
        first.views.numpy(),
        rms.numpy(),
        sigma.numpy(),
        tuple(status),
        covariance,
        centre,
        scale,
    )
    return table, every.numpy()


def parse_refine(text: str) -> bool:
    """Whether poses are refined, from a list such as `lines,poses`. Raises InputError on anything else."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [part for part in parts if part not in ("lines", "poses")]
    if unknown or "lines" not in parts:
        raise InputError(f"--refine was expected to be lines or lines,poses, found '{text}'; choose one of these.")
    return "poses" in parts
