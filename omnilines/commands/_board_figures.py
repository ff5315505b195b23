"""What the board experiment measures of lines and poses, before and after the adjustment."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose
from omnilines import structure
from omnilines.adjustment.accuracy import AlignedLines, align_lines
from omnilines.adjustment.arcs import Arcs, poses_of
from omnilines.costs import sector
from omnilines.geometry.line import PlueckerLines, segment_ends
from omnilines.geometry.sphere import distance_to_great_circle

# (key in JSON, name for people, unit): the smaller the better.
FIGURES: tuple[tuple[str, str, str], ...] = (
    ("sphere_rms_deg", "angle of end bearings to the projection plane, RMS", "degrees"),
    ("sector_cost", "sector cost, sum over segments", ""),
    ("orthogonal_rms_px", "orthogonal distance of end points in the photo, RMS", "px"),
    ("orthogonal_max_px", "orthogonal distance of end points in the photo, largest", "px"),
    ("coplanarity_rms_mm", "distance of line ends from one plane, RMS", "mm"),
    ("coplanarity_rms_deg", "angle of lines to that plane, RMS", "degrees"),
    ("parallelism_rows_rms_deg", "angle of rows to their mean direction, RMS", "degrees"),
    ("parallelism_columns_rms_deg", "angle of columns to their mean direction, RMS", "degrees"),
    ("right_angle_pairs_rms_deg", "every row with every column, off a right angle, RMS", "degrees"),
    ("right_angle_means_deg", "mean directions of rows and columns, off a right angle", "degrees"),
    ("spacing_spread_percent", "relative spread of the spacing of neighbours", "%"),
    ("spacing_error_rms_mm", "spacing of neighbours against the board, RMS", "mm"),
    ("board_error_rms_mm", "distance of line ends from the board's own, RMS", "mm"),
)
UNCHECKED = ("right_angle_means_deg",)
"""Not an RMS but one signed number, which random poses bring near zero by luck: it is reported without a check."""


@dataclass(frozen=True)
class LineState:
    """Lines and poses at one stage, and what is measured of them."""

    lines: PlueckerLines
    cam_from_world: Pose
    ends_m: Float[Tensor, "t 2 3"]
    """Of the observed segments on the lines, in the frame of the poses."""
    aligned: AlignedLines
    """To the board, by a similarity."""
    orthogonal_px: Float[Tensor, "n 2"]
    figures: dict[str, float]


def measure(
    arcs: Arcs,
    lines: PlueckerLines,
    cam_from_world: Pose,
    board_ends_m: Float[Tensor, "t 2 3"],
    column: Bool[Tensor, " t"],
) -> LineState:
    """All figures of lines, one a track, that stand for the board lines with the given ends."""
    poses = poses_of(arcs, cam_from_world)
    normals = lines[arcs.track].projection_normal(poses)
    ends = _ends_in_observed_order(arcs, lines, poses, board_ends_m)
    aligned = align_lines(lines, ends, board_ends_m)
    orthogonal = arcs.orthogonal_px(normals)
    residual = sector.residual(sector.prepare(arcs.bearings[:, 0], arcs.bearings[:, 1]), normals)
    unit = normals / normals.norm(dim=-1, keepdim=True)
    figures = {
        "sphere_rms_deg": math.degrees(_rms(distance_to_great_circle(arcs.bearings, unit[:, None]))),
        "sector_cost": float(residual.square().sum()),
        "orthogonal_rms_px": _rms(orthogonal),
        "orthogonal_max_px": float(orthogonal.abs().max()),
        **_structure(aligned, board_ends_m, column),
        "board_error_rms_mm": 1e3 * aligned.rms_m,
    }
    return LineState(lines, cam_from_world, ends, aligned, orthogonal, figures)


def _ends_in_observed_order(
    arcs: Arcs, lines: PlueckerLines, poses: Pose, board_ends_m: Float[Tensor, "t 2 3"]
) -> Float[Tensor, "t 2 3"]:
    """End points of the segments, first ends first. Where a line is in front of no photo the board's nearest points stand in."""
    ends, positions = segment_ends(lines, poses, arcs.bearings, arcs.track)
    forward = torch.nan_to_num(torch.sign(positions[:, 1] - positions[:, 0]))
    votes = torch.zeros(len(lines), dtype=ends.dtype).index_add(0, arcs.track, forward)
    ends = torch.where((votes < 0)[:, None, None], ends.flip(1), ends)
    return torch.where(torch.isfinite(ends), ends, lines[:, None].closest_point(board_ends_m))


def _structure(aligned: AlignedLines, board_ends_m: Tensor, column: Tensor) -> dict[str, float]:
    points, direction = aligned.points_m, aligned.lines.direction
    off_plane, to_plane = structure.coplanarity(points)
    means, pairs = structure.orthogonality(direction[~column], direction[column])
    found = torch.cat([structure.spacing(points[family]) for family in (~column, column)])
    true = torch.cat([structure.spacing(board_ends_m[family]) for family in (~column, column)])
    relative = found / true
    return {
        "coplanarity_rms_mm": 1e3 * float(off_plane),
        "coplanarity_rms_deg": math.degrees(float(to_plane)),
        "parallelism_rows_rms_deg": math.degrees(_rms(structure.parallelism(direction[~column]))),
        "parallelism_columns_rms_deg": math.degrees(_rms(structure.parallelism(direction[column]))),
        "right_angle_means_deg": math.degrees(float(means)),
        "right_angle_pairs_rms_deg": math.degrees(_rms(pairs)),
        "spacing_spread_percent": 100 * float(relative.std() / relative.mean()),
        "spacing_error_rms_mm": 1e3 * _rms(found - true),
    }


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
