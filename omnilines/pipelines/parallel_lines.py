"""Lines that take the direction of their family of parallel lines into account, as far as their own is less certain.

A line that lies nearly in one plane with the cameras that show it is known across that plane, and hardly within it. A member of a
family of direction u has the direction u + a stray of t in each of two components (`FamilyOptions.tolerance_rad`): a second
measurement of it, of the covariance C_u + t^2 I, C_u that of the mean of the *other* members. Both are joined by their
covariances (a Kalman update of the four parameters of the line), so that a line whose direction is known better than t stays.

The families themselves, with their right angles, are those of the lines as they were measured.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.lines import end_sigma_m, motion_across
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.records import ImagePoses, Lines, Segments
from omnilines.structure.directions import across, line_directions
from omnilines.structure.families import Families


def guided_lines(lines: Lines, families: Families) -> Lines:
    """The lines after their families were taken into account; those without one as they are. Ends move across their line only.

    `families` are those of `lines`; `rms_px` is that of before.
    """
    rows = np.flatnonzero(families.family >= 0)
    if not len(rows):
        return lines
    step, covariance = _update(lines, families, rows, local_charts(lines, rows))
    return stepped_lines(lines, rows, step, covariance)


def local_charts(lines: Lines, rows: Int[np.ndarray, " m"]) -> LineChart:
    """Charts of some lines relative to their charts' centres, so that nothing depends on where the world origin is."""
    assert lines.chart_centre_m is not None and lines.chart_scale_m is not None
    ends = torch.as_tensor(lines.ends_m[rows] - lines.chart_centre_m[rows][:, None])
    scale = torch.as_tensor(lines.chart_scale_m[rows])
    return LineChart.from_lines(PlueckerLines.from_points(ends[:, 0], ends[:, 1]), torch.zeros_like(ends[:, 0]), scale)


def stepped_lines(
    lines: Lines, rows: Int[np.ndarray, " m"], step: Float[Tensor, "m 4"], covariance: Float[Tensor, "m 4 4"]
) -> Lines:
    """The lines of which `rows` made a step in their charts, with the covariances after it. Ends move across their line only."""
    assert lines.covariance is not None and lines.chart_centre_m is not None
    centre = torch.as_tensor(lines.chart_centre_m[rows])[:, None]
    ends = torch.as_tensor(lines.ends_m[rows]) - centre
    # Straight in space, not along the chart, which depends on the camera that it is about.
    ends = ends + (motion_across(local_charts(lines, rows), ends) @ step[:, None, :, None])[..., 0]
    moved = replace(lines, ends_m=_with_rows(lines.ends_m, rows, ends + centre))
    sigma = end_sigma_m(local_charts(moved, rows), covariance, ends)
    return replace(
        moved,
        sigma_m=_with_rows(lines.sigma_m, rows, sigma),
        covariance=_with_rows(lines.covariance, rows, covariance),
    )


def _update(
    lines: Lines, families: Families, rows: Int[np.ndarray, " m"], chart: LineChart
) -> tuple[Float[Tensor, "m 4"], Float[Tensor, "m 4 4"]]:
    """Steps of the charts, and the covariances after them."""
    every, noise = line_directions(lines)
    own = families.family[rows]
    u, t = torch.as_tensor(families.direction[own]), families.tolerance_rad
    d = every[rows]
    e, s, basis = across(d, noise[rows], u, t)
    side = torch.where((d * u).sum(-1) < 0, -1.0, 1.0)
    # The mean of all members without this one: its own measurement counts once.
    information = torch.linalg.inv(s)
    others = torch.linalg.inv(torch.linalg.inv(basis.mT @ torch.as_tensor(families.covariance[own]) @ basis) - information)
    e = e + (others @ information @ e[..., None])[..., 0]
    by_chart = side[:, None, None] * (basis.mT @ chart.jacobian()[:, :3])
    before = torch.as_tensor(lines.covariance)[rows]
    seen = by_chart @ before @ by_chart.mT + others + t**2 * torch.eye(2, dtype=torch.float64)
    gain = before @ by_chart.mT @ torch.linalg.inv(seen)
    after = before - gain @ by_chart @ before
    return -(gain @ e[..., None])[..., 0], 0.5 * (after + after.mT)


def _with_rows(values: np.ndarray, rows: Int[np.ndarray, " m"], chosen: Tensor) -> np.ndarray:
    new = values.copy()
    new[rows] = chosen.numpy()
    return new


def with_rms(lines: Lines, segments: Segments, poses: ImagePoses, cameras: Mapping[str, CameraModel]) -> Lines:
    """The lines with `rms_px` anew: of the orthogonal distances of both ends of their arcs, the `segments` whose `track` is the
    row of the line; a stretch of a line without an arc of its own keeps that of the line."""
    arcs = arcs_from_segments(segments, poses, cameras, with_nodes=False).arcs
    ends, row = torch.as_tensor(lines.ends_m), arcs.track.numpy()
    own = PlueckerLines.from_points(ends[:, 0], ends[:, 1])[arcs.track]
    square = arcs.orthogonal_px(own.projection_normal(poses.cam_from_world[arcs.image])).square().mean(-1).numpy()
    total, count = np.bincount(row, square, len(lines)), np.bincount(row, minlength=len(lines))
    return replace(lines, rms_px=np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), lines.rms_px))
