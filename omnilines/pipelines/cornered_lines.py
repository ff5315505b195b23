"""Lines that take those into account that end where they do, as far as they are less certain.

That two lines end together is a measurement of both: of their gap, with the variance of the other line as it was measured, and
of how far such lines pass each other (`structure.corners`, `structure.gaps`): one corner of a line after the other, those with
the best known lines first. What the other line learns from its own corners is left out, so that nothing counts twice.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from omnilines.adjustment.lines import motion_across
from omnilines.matching.arcs import ViewedArcs
from omnilines.pipelines.parallel_lines import local_charts, stepped_lines
from omnilines.records import Lines
from omnilines.structure.corners import Corners, GapShares, corners_seen, gap_shares, likelihood, meeting_share
from omnilines.structure.gaps import learned
from omnilines.structure.options import CornerOptions


def corners_of(arcs: ViewedArcs, line: Int[np.ndarray, " n"], options: CornerOptions) -> Corners:
    """Where the lines of arcs end together; `line` is that of each arc, -1 where an arc has none."""
    rows, planes = np.flatnonzero(line >= 0), arcs.planes
    assert planes.arcs is not None
    ends, normal = planes.arcs.numpy()[rows], planes.normal.numpy()[rows]
    return corners_seen(arcs.image[rows], line[rows], ends, normal, arcs.px_rad[rows], options)


def cornered_lines(
    lines: Lines, track: Int[np.ndarray, " n"], corners: Corners, options: CornerOptions = CornerOptions()
) -> Lines:
    """The lines after their corners were taken into account; those without one as they are. Ends move across their line only.

    `track` is what `corners` knows each line by: the stretches of one line have the same, and move as one.
    """
    _, first, own = np.unique(track, return_index=True, return_inverse=True)
    corners = _crossing(lines, track, corners, options.min_sine)
    if not len(corners):
        return lines
    assert lines.covariance is not None and lines.chart_scale_m is not None
    gap, by_line, variance = _gaps(lines, corners.line)
    shares = gap_shares(gap, variance.sum(1), corners.photos, float(np.median(lines.chart_scale_m)), options)
    # Every corner is a measurement of both of its lines.
    corner = np.tile(np.arange(len(corners)), 2)
    seen = _Seen(corners.line.T.ravel(), corner, gap[corner], by_line.swapaxes(0, 1).reshape(-1, 4), variance[:, ::-1].T.ravel())
    rows, of = np.unique(seen.line, return_inverse=True)
    step, covariance = _update(lines.covariance[rows], seen._replace(line=of), shares)
    stretches = np.flatnonzero(np.isin(first[own], rows))
    at = np.searchsorted(rows, first[own][stretches])
    return stepped_lines(lines, stretches, torch.as_tensor(step[at]), torch.as_tensor(covariance[at]))


def meeting(
    lines: Lines, track: Int[np.ndarray, " n"], corners: Corners, sure: Bool[np.ndarray, " n"], options: CornerOptions
) -> Float[np.ndarray, " n"]:
    """With which probability each line meets one of the `sure` ones (the largest of its corners); 0 for those themselves.

    The shares of gaps are those of these corners alone: lines that are less sure meet others less often.
    """
    corners = _crossing(lines, track, corners, options.min_sine)
    corners = corners.rows(sure[corners.line].sum(-1) == 1)
    if not len(corners):
        return np.zeros(len(lines))
    assert lines.chart_scale_m is not None
    gap, _, variance = _gaps(lines, corners.line)
    meets = meeting_share(gap, variance.sum(1), corners.photos, float(np.median(lines.chart_scale_m)), options)
    _, own = np.unique(track, return_inverse=True)
    found = np.zeros(len(lines))
    np.maximum.at(found, own[corners.line[~sure[corners.line]]], meets)
    return np.where(sure, 0.0, found[own])


def _crossing(lines: Lines, track: Int[np.ndarray, " n"], corners: Corners, min_sine: float) -> Corners:
    """The corners by the first stretch of each line, without those of lines nearly parallel in space: where these are nearest
    to each other is not known."""
    known, first = np.unique(track, return_index=True)
    corners = replace(corners, line=first[np.searchsorted(known, corners.line)])
    along = lines.ends_m[corners.line, 1] - lines.ends_m[corners.line, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return corners.rows(np.linalg.norm(np.cross(along[:, 0], along[:, 1]), axis=-1) > min_sine)


class _Seen(NamedTuple):
    """What corners say of one of their lines each."""

    line: Int[np.ndarray, " n"]
    corner: Int[np.ndarray, " n"]
    gap_m: Float[np.ndarray, " n"]
    by_line: Float[np.ndarray, "n 4"]
    """Derivative of the gap by the chart of the line."""
    variance_m2: Float[np.ndarray, " n"]
    """Of the gap, by the other line."""


def _gaps(
    lines: Lines, pair: Int[np.ndarray, "k 2"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 2 4"], Float[np.ndarray, "k 2"]]:
    """Signed distance (m) from the first to the second line of each pair, across both, its derivatives by their charts, and its
    variance by each of them."""
    assert lines.chart_centre_m is not None and lines.covariance is not None
    ends, centre = lines.ends_m[pair], lines.chart_centre_m[pair]
    along = ends[:, :, 1] - ends[:, :, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(along[:, 0], along[:, 1])
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    between, normal = ends[:, 1, 0] - ends[:, 0, 0], across / sine
    by_line = np.empty((len(pair), 2, 4))
    for k in range(2):
        # The point of this line that is nearest to the other.
        place = (np.cross(between, along[:, 1 - k]) * normal).sum(-1, keepdims=True) / sine
        point = torch.as_tensor(ends[:, k, 0] + place * along[:, k] - centre[:, k])
        motion = motion_across(local_charts(lines, pair[:, k]), point[:, None])[:, 0].numpy()
        by_line[:, k] = (2 * k - 1) * (normal[:, None] @ motion)[:, 0]
    variance = np.einsum("kei,keij,kej->ke", by_line, lines.covariance[pair], by_line)
    return (between * normal).sum(-1), by_line, variance


def _update(
    covariance: Float[np.ndarray, "m 4 4"], seen: _Seen, shares: GapShares
) -> tuple[Float[np.ndarray, "m 4"], Float[np.ndarray, "m 4 4"]]:
    """Steps of the lines and the covariances after them: the first corner of every line, then the second, and so on."""
    order = np.lexsort((seen.variance_m2, seen.line))
    turn = np.arange(len(order)) - np.searchsorted(seen.line[order], seen.line[order])
    step, after = np.zeros((len(covariance), 4)), covariance.copy()
    for k in range(int(turn.max()) + 1):
        rows = order[turn == k]
        own, h = seen.line[rows], seen.by_line[rows]
        gap = seen.gap_m[rows] + (h * step[own]).sum(-1)
        known = np.einsum("ki,kij,kj->k", h, after[own], h) + seen.variance_m2[rows]
        weight = shares.share[shares.group[seen.corner[rows]]] * likelihood(gap, known, shares.gaps_m)
        weight /= weight.sum(-1, keepdims=True)
        spread = known[:, None] + shares.gaps_m**2
        more, after[own] = learned(after[own], h, np.broadcast_to(gap[:, None], spread.shape), spread, weight)
        step[own] += more
    return step, after
