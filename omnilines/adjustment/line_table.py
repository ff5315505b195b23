"""Adjusted or triangulated lines as the table of all tracks: end points, residuals, uncertainty, status."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.lines import end_sigma_m
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import segment_ends
from omnilines.records import Lines
from omnilines.triangulation.result import Triangulation


def too_uncertain(lines: Lines, weak_share: float) -> Bool[np.ndarray, " t"]:
    """Lines that are weak for the uncertainty of their ends."""
    assert lines.chart_scale_m is not None
    return ~(lines.sigma_m <= weak_share * lines.chart_scale_m)


def line_table(
    names: tuple[str, ...],
    inner: MatchedArcs,
    tracks: Int[Tensor, " k"],
    first: Triangulation,
    state: LinesAndPoses,
    *,
    views: Int[Tensor, " t"],
    adjusted: Adjusted | None,
    weak_share: float,
) -> tuple[Lines, Float[Tensor, "m 2"]]:
    """The table of all tracks for one state, and the orthogonal distances of the arcs `inner` that the lines rest on.

    `names` and `views` (photos) are those of all tracks, `tracks` the numbers of those that have a line, to which the tracks of
    `inner` refer.
    """
    count = len(names)
    lines = state.chart.lines()
    ends, _ = segment_ends(lines, state.cam_from_world[inner.image], inner.bearings, inner.track)
    distance = inner.orthogonal_px(state.normals(inner)).detach()
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
        weak = sigma[tracks] > weak_share * state.chart.scale
        for track in tracks[weak | ~torch.isfinite(sigma[tracks])].tolist():
            status[track] = "weak"
    # A line none of whose arcs lies in front of its camera has no ends to show.
    for track in tracks[~torch.isfinite(ends).all(-1).all(-1)].tolist():
        status[track], rms[track], sigma[track] = "behind", math.nan, math.nan
        ends_by_track[track] = math.nan
    centre, scale = np.full((count, 3), np.nan), np.full(count, np.nan)
    centre[tracks.numpy()], scale[tracks.numpy()] = state.chart.centre.numpy(), state.chart.scale.numpy()
    table = Lines(
        names,
        ends_by_track.numpy(),
        views.numpy(),
        rms.numpy(),
        sigma.numpy(),
        status=tuple(status),
        covariance=covariance,
        chart_centre_m=centre,
        chart_scale_m=scale,
    )
    return table, distance
