"""What errors of the calibration leave uncertain of the lines and poses of a scene, where its file states them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from camera_models import Calibration
from camera_models.pose import Pose
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.by_calibration import CalibrationErrors, Followed, KnownCalibration, calibration_errors
from omnilines.adjustment.line_table import too_uncertain
from omnilines.adjustment.lines import end_sigma_m
from omnilines.adjustment.rig import rig_of_photos
from omnilines.adjustment.scene import pose_prior
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


def unfollowed_errors(cameras: Calibration, options: SceneOptions) -> tuple[str, ...]:
    """What is not in the uncertainty of lines, though the file of the calibration states errors."""
    if not states_errors(cameras) or "intrinsics" in options.refine:
        return ()
    if options.partition:
        return (
            "Errors of the calibration are not in the uncertainty of the lines: in parts (`partition`) they are not followed.",
        )
    known = [name for name, one in cameras.estimates.items() if one.covariance is not None]
    exact = ", ".join(name for name in cameras if name not in known)
    if not known or not exact:
        return ()
    return (f"The calibration states no covariance of {exact}: these cameras count as exact in the uncertainty of the lines.",)


def errors_by_calibration(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    points: Mapping[str, PosePoints],
    *,
    pose_sigma: tuple[float, float] | None = None,
    given: ImagePoses | None = None,
) -> CalibrationErrors | None:
    """Covariances from errors of the calibration alone, of each line (NaN where there is none) and pose; None where cameras were
    refined or the file does not state its errors.

    The tracks of `arcs` are rows of `lines`; rows of one `track` are stretches of one line. `points` are those that poses were
    found from, which move with the cameras unless lines refine them; `pose_sigma` (rad, m) is that of the prior, the poses
    `given`, where there is one.
    """
    if not states_errors(cameras) or "intrinsics" in options.refine or options.partition or not lines.known.any():
        return None
    held = "poses" not in options.refine
    calibration, frames = known_calibration(poses, cameras, options)
    rows = np.flatnonzero(lines.known)
    _, first, line = np.unique(track[rows], return_index=True, return_inverse=True)
    line_of_row = np.full(len(lines), -1)
    line_of_row[rows] = line
    of_arc = torch.as_tensor(line_of_row)[arcs.track]
    inner = replace(arcs, track=of_arc, tracks=len(first)).rows(of_arc >= 0)
    own = charts_of(lines, rows)
    start = own[torch.as_tensor(first)]
    loss = scaled_loss(options.loss, options.cost, inner, LinesAndPoses(poses.cam_from_world, start), options.adjustment)
    places = {poses.images.index(name): seen for name, seen in points.items() if held and name in poses.images}
    prior = None if given is None else pose_prior(known_calibration(given, cameras, options)[1], pose_sigma)
    followed = Followed(inner, start.lines(), frames, not held, options.cost, loss, places, prior)
    found = calibration_errors(followed, calibration, own, torch.as_tensor(line))
    of_lines = torch.full((len(lines), 4, 4), torch.nan, dtype=torch.float64)
    of_lines[torch.as_tensor(rows)] = found.lines
    return replace(found, lines=of_lines)


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
    rows = np.flatnonzero(lines.known)
    chart, ends, whole = charts_of(lines, rows), torch.as_tensor(lines.ends_m[rows]), lines.covariance + errors.lines.numpy()
    sigma, own = lines.sigma_m.copy(), np.full(len(lines), np.nan)
    sigma[rows] = end_sigma_m(chart, torch.as_tensor(whole[rows]), ends).numpy()
    own[rows] = end_sigma_m(chart, errors.lines[torch.as_tensor(rows)], ends).numpy()
    wider = replace(lines, covariance=whole, sigma_m=sigma, calibration_sigma_m=own)
    weak = too_uncertain(wider, weak_share)
    status = tuple("weak" if weak[k] and one == "ok" else one for k, one in enumerate(lines.status))
    return replace(wider, status=status)


def charts_of(lines: Lines, rows: Int[np.ndarray, " k"]) -> LineChart:
    """Of rows that have a line."""
    assert lines.chart_centre_m is not None and lines.chart_scale_m is not None
    ends, centre, scale = (torch.as_tensor(a[rows]) for a in (lines.ends_m, lines.chart_centre_m, lines.chart_scale_m))
    return LineChart.from_lines(PlueckerLines.from_points(ends[:, 0], ends[:, 1]), centre, scale)


def known_calibration(poses: ImagePoses, cameras: Calibration, options: SceneOptions) -> tuple[KnownCalibration, Pose]:
    """The calibration with its errors, and the poses that lines are adjusted with."""
    names, rigid = list(cameras), cameras.rig and "rig" not in options.refine
    mounted, frames = rig_of_photos(poses, names, cameras.rig, False, options.adjustment.most_turned_deg)
    camera = torch.tensor([names.index(name) for name in poses.cameras or (names[0],) * len(poses)])
    mounts = tuple(cameras.rig[name] for name in names) if rigid else ()
    estimates = tuple(cameras.estimates.get(name) for name in names)
    return KnownCalibration(tuple(cameras.values()), estimates, camera, mounted, mounts), frames
