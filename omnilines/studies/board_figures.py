"""What the board experiment measures of lines and poses, before and after the adjustment."""

import math
from dataclasses import dataclass
from functools import cached_property

import scipy.stats
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models._arrays import Array, as_tensor
from camera_models.pose import Pose
from omnilines.adjustment.accuracy import AlignedLines, PredictedError, align_lines, jackknife_error, predict_error
from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs, poses_of
from omnilines.calibration.board_lines import BoardLines
from omnilines.calibration.result import CameraCalibration
from omnilines.costs import sector
from omnilines.geometry.line import PlueckerLines, segment_ends
from omnilines.geometry.sphere import distance_to_great_circle
from omnilines.least_squares import Outcome
from omnilines.records import Check, Corners, ImagePoses
from omnilines.structure import regularity

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

    @property
    def aligned_ends_m(self) -> Float[Tensor, "t 2 3"]:
        """`ends_m` in the frame of the board."""
        return self.aligned.pose.transform((self.aligned.scale * self.ends_m).reshape(-1, 3)).reshape(-1, 2, 3)


CHANCE = 0.001
"""Probability with which noise alone may exceed the limit of an error over its prediction."""


@dataclass(frozen=True)
class Agreement:
    """The actual RMS error of the adjusted lines against a predicted one."""

    actual_m: float
    predicted_m: float
    limit: float
    """Of actual over predicted: sum |e|^2 / tr(C) follows about F(nu, f), nu the effective freedom of the error (a few modes of
    bending and twisting make up most of it) and f the freedom that C was estimated from; this is its 0.999 quantile's root."""

    @property
    def ratio(self) -> float:
        return self.actual_m / self.predicted_m


@dataclass(frozen=True, eq=False)
class BoardExperiment:
    """All that was found, for tables, checks and the report."""

    corners: Corners
    calibration: CameraCalibration
    board: BoardLines
    perturbed: ImagePoses
    """cam_from_board of the photos used, disturbed."""
    status: tuple[str, ...]
    """Of each board line after triangulation."""
    arcs: MatchedArcs
    """Of the lines that are known, renumbered."""
    tracks: Int[Tensor, " t"]
    """Board line of each of these."""
    adjusted: Adjusted
    before: LineState
    after: LineState
    cost: str

    @cached_property
    def predicted(self) -> PredictedError:
        """From the residuals of the lines, every end point with an error of its own."""
        return predict_error(self.adjusted, self.after.aligned)

    @cached_property
    def by_noise(self) -> Agreement:
        """Against the error that independent noise of the end points predicts."""
        freedom = 2 * len(self.arcs) - 4 * len(self.tracks) - 6 * len(self.perturbed) + 7
        return self._agreement(self.predicted.rms_m, freedom)

    @cached_property
    def by_photos(self) -> Agreement:
        """Against the error that the scatter between photos predicts, which holds what the end points of a photo share."""
        scatter = jackknife_error(self.arcs, self.adjusted, self.after.aligned, self.cost)
        return self._agreement(scatter.rms_m, len(self.perturbed) - 1)

    def _agreement(self, predicted_m: float, freedom: int) -> Agreement:
        quantile = scipy.stats.f.ppf(1 - CHANCE, self.predicted.effective_freedom, max(freedom, 1))
        return Agreement(self.after.aligned.rms_m, predicted_m, math.sqrt(float(quantile)))

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every line determined, every figure better than before, and the error as large as the photos predict."""
        before, after, agreement = self.before.figures, self.after.figures, self.by_photos
        total, known = float(len(self.status)), float(len(self.tracks))
        agrees = agreement.ratio <= agreement.limit
        return (
            Check("lines determined from the perturbed poses", known, total, "lines", known == total),
            *(
                Check(f"{name}: after, limit before", after[key], before[key], unit, after[key] < before[key])
                for key, name, unit in FIGURES
                if key not in UNCHECKED
            ),
            Check("error against the board over the error that the photos predict", agreement.ratio, agreement.limit, "", agrees),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what did not go as it should."""
        unknown = [f"{name} ({status})" for name, status in zip(self.board.segments.tracks, self.status, strict=True)
                   if status not in ("ok", "weak")]  # fmt: skip
        lost = (f"The perturbed poses do not determine the lines {', '.join(unknown)}; they are left out.",) if unknown else ()
        outcome = self.adjusted.outcome
        return lost + (() if outcome is Outcome.CONVERGED else (outcome.value,))


def measure(
    arcs: MatchedArcs,
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
    arcs: MatchedArcs, lines: PlueckerLines, poses: Pose, board_ends_m: Float[Tensor, "t 2 3"]
) -> Float[Tensor, "t 2 3"]:
    """End points of the segments, first ends first. Where a line is in front of no photo the board's nearest points stand in."""
    ends, positions = segment_ends(lines, poses, arcs.bearings, arcs.track)
    forward = torch.nan_to_num(torch.sign(positions[:, 1] - positions[:, 0]))
    votes = torch.zeros(len(lines), dtype=ends.dtype).index_add(0, arcs.track, forward)
    ends = torch.where((votes < 0)[:, None, None], ends.flip(1), ends)
    return torch.where(torch.isfinite(ends), ends, lines[:, None].closest_point(board_ends_m))


def _structure(aligned: AlignedLines, board_ends_m: Tensor, column: Tensor) -> dict[str, float]:
    points, direction = aligned.points_m, aligned.lines.direction
    off_plane, to_plane = regularity.coplanarity(points)
    means, pairs = regularity.orthogonality(direction[~column], direction[column])
    found = torch.cat([as_tensor(regularity.spacing(points[family])) for family in (~column, column)])
    true = torch.cat([as_tensor(regularity.spacing(board_ends_m[family])) for family in (~column, column)])
    relative = found / true
    return {
        "coplanarity_rms_mm": 1e3 * float(off_plane),
        "coplanarity_rms_deg": math.degrees(float(to_plane)),
        "parallelism_rows_rms_deg": math.degrees(_rms(regularity.parallelism(direction[~column]))),
        "parallelism_columns_rms_deg": math.degrees(_rms(regularity.parallelism(direction[column]))),
        "right_angle_means_deg": math.degrees(float(means)),
        "right_angle_pairs_rms_deg": math.degrees(_rms(pairs)),
        "spacing_spread_percent": 100 * float(relative.std() / relative.mean()),
        "spacing_error_rms_mm": 1e3 * _rms(found - true),
    }


def _rms(values: Array) -> float:
    return float(as_tensor(values).square().mean().sqrt())
