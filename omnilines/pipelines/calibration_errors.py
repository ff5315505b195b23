"""What errors of the calibration leave uncertain of the lines and poses of a scene, where its file states them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import Calibration
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.by_calibration import MOST_ITERATIONS, CalibrationErrors, Followed, KnownCalibration, calibration_errors
from omnilines.adjustment.line_table import too_uncertain
from omnilines.adjustment.lines import end_sigma_m
from omnilines.adjustment.noise import Noise
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.rig import rig_of_photos
from omnilines.adjustment.start import scaled_loss
from omnilines.adjustment.state import LinesAndPoses
from omnilines.geometry.line import PlueckerLines
from omnilines.geometry.line_chart import LineChart
from omnilines.pipelines.options import SceneOptions
from omnilines.records import ImagePoses, Lines, PosePoints


def states_errors(cameras: Calibration) -> bool:
    """Whether the file of a calibration says how uncertain cameras or the rig are."""
    known = [one.covariance for one in cameras.estimates.values()] + [one.covariance for one in cameras.rig.values()]
    return any(covariance is not None for covariance in known)


def errors_by_calibration(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    points: Mapping[str, PosePoints],
    *,
    prior: KnownPoses | None = None,
    iterations: int = MOST_ITERATIONS,
) -> CalibrationErrors | None:
    """Covariances from errors of the calibration alone, of each line (NaN where there is none) and pose; None where cameras were
    refined or the file does not state its errors.

    The tracks of `arcs` are rows of `lines`; rows of one `track` are stretches of one line. `points` are those that poses were
    found from, which move with the cameras unless lines refine them; `prior` are poses that one holds, as uncertain as it weighs
    beside what arcs state of their noise (beside 1 px where they state nothing); `iterations` are those of the lines and poses
    that follow.
    """
    if not states_errors(cameras) or "intrinsics" in options.refine or options.partition or not lines.known.any():
        return None
    held = "poses" not in options.refine
    calibration, frames = known_calibration(poses, cameras, options)
    inner, rows, first, line = whole_lines(lines, arcs, track)
    own = charts_of(lines, rows)
    start = own[torch.as_tensor(first)]
    loss = scaled_loss(options.loss, options.cost, inner, LinesAndPoses(poses.cam_from_world, start), options.adjustment)
    places = {poses.images.index(name): seen for name, seen in points.items() if held and name in poses.images}
    weighed = None if prior is None else prior.prior(poses, lambda table: known_calibration(table, cameras, options)[1])
    followed = Followed(inner, start.lines(), frames, not held, options.cost, loss, places, weighed, iterations)
    found = calibration_errors(followed, calibration, own, torch.as_tensor(line))
    of_lines = torch.full((len(lines), 4, 4), torch.nan, dtype=torch.float64)
    of_lines[torch.as_tensor(rows)] = found.lines
    return replace(found, lines=of_lines)


def beside_stated(prior: KnownPoses | None, noise: Noise) -> KnownPoses | None:
    """A prior beside what arcs state of their noise that weighs as it does beside the noise that they show."""
    return prior.loosened(1.0 / noise.level) if prior is not None and noise.level > 0.0 else prior


def poses_with_calibration_errors(poses: ImagePoses, errors: CalibrationErrors | None) -> ImagePoses:
    """Poses whose covariances, where they have some, hold errors of the calibration too."""
    if errors is None or poses.covariance is None:
        return poses
    return replace(poses, covariance=poses.covariance + errors.poses.numpy())


def lines_with_calibration_errors(lines: Lines, errors: CalibrationErrors | None, weak_share: float) -> Lines:
    """Lines whose covariances hold errors of the calibration too, and `calibration_sigma_m`, their share; those that are too
    uncertain then are weak."""
    if errors is None or lines.covariance is None:
        return lines
    return replace(wider_lines(lines, errors.lines, weak_share), calibration_sigma_m=sigma_m(lines, errors.lines))


def wider_lines(lines: Lines, errors: Float[Tensor, "n 4 4"], weak_share: float) -> Lines:
    """Lines whose covariances hold other errors too; those that are too uncertain then are weak."""
    assert lines.covariance is not None
    whole = torch.as_tensor(lines.covariance) + errors
    wider = replace(lines, covariance=whole.numpy(), sigma_m=np.where(lines.known, sigma_m(lines, whole), lines.sigma_m))
    weak = too_uncertain(wider, weak_share)
    return replace(wider, status=tuple("weak" if weak[k] and one == "ok" else one for k, one in enumerate(lines.status)))


def sigma_m(lines: Lines, covariance: Float[Tensor, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Of the ends of each line; NaN where there is none."""
    rows, sigma = np.flatnonzero(lines.known), np.full(len(lines), np.nan)
    known = covariance[torch.as_tensor(rows)]
    sigma[rows] = end_sigma_m(charts_of(lines, rows), known, torch.as_tensor(lines.ends_m[rows])).numpy()
    return sigma


def whole_lines(
    lines: Lines, arcs: MatchedArcs, track: Int[np.ndarray, " n"]
) -> tuple[MatchedArcs, Int[np.ndarray, " r"], Int[np.ndarray, " k"], Int[np.ndarray, " r"]]:
    """Arcs whose tracks are whole lines, all stretches of one together; the rows that have a line; of these the first of each
    whole line, and the whole line of each. The tracks of `arcs` are rows of `lines`; rows of one `track` are of one line."""
    rows = np.flatnonzero(lines.known)
    _, first, line = np.unique(track[rows], return_index=True, return_inverse=True)
    line_of_row = np.full(len(lines), -1)
    line_of_row[rows] = line
    of_arc = torch.as_tensor(line_of_row)[arcs.track]
    return replace(arcs, track=of_arc, tracks=len(first)).rows(of_arc >= 0), rows, first, line


def charts_of(lines: Lines, rows: Int[np.ndarray, " k"]) -> LineChart:
    """Of rows that have a line."""
    assert lines.chart_centre_m is not None and lines.chart_scale_m is not None
    ends, centre, scale = (torch.as_tensor(a[rows]) for a in (lines.ends_m, lines.chart_centre_m, lines.chart_scale_m))
    return LineChart.from_lines(PlueckerLines.from_points(ends[:, 0], ends[:, 1]), centre, scale)


def known_calibration(poses: ImagePoses, cameras: Calibration, options: SceneOptions) -> tuple[KnownCalibration, Pose]:
    """The calibration with its errors, and the poses that lines are adjusted with."""
    names, rigid = list(cameras), cameras.rig and "rig" not in options.refine
    held = not {"poses", "rig"} & set(options.refine)
    mounted, frames = rig_of_photos(poses, names, cameras.rig, False, options.adjustment.most_turned_deg, held=held)
    camera = torch.tensor([names.index(name) for name in poses.cameras or (names[0],) * len(poses)])
    mounts = tuple(cameras.rig[name] for name in names) if rigid else ()
    estimates = tuple(cameras.estimates.get(name) for name in names)
    return KnownCalibration(tuple(cameras.values()), estimates, camera, mounted, mounts), frames
