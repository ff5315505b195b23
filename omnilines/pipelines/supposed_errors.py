"""What errors of the calibration leave uncertain where its file states none: a figure beside uncertainties that lack them.

Cameras from COLMAP or OpenCV, or typed by hand, count as exact. Nobody's are: how many times as uncertain lines and photos are
with cameras that are off by SUPPOSED_PX is said, so that what is stated is not taken for all there is.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from camera_models import Calibration
from camera_models.wording import rounded
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.pipelines.assumed_errors import with_assumed_errors
from omnilines.pipelines.calibration_errors import errors_by_calibration, sigma_m, states_errors
from omnilines.pipelines.options import SceneOptions
from omnilines.records import ImagePoses, Lines, PosePoints

SUPPOSED_PX = 0.5
"""About what separates two calibrations of one lens from good photos of a board, in RMS over the image."""
ITERATIONS = 3
"""For a figure that is rounded: most lines and poses have come to rest then."""
LINES, LINES_OF_PHOTO = 200, 15
"""That are followed, spread over all: what cameras have wrong moves all alike."""


def supposed_errors(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    points: Mapping[str, PosePoints],
) -> str:
    """What would be with cameras that are off by SUPPOSED_PX, one sentence; nothing where some file states errors, or where they
    cannot be followed. Arguments as of `errors_by_calibration`."""
    if states_errors(cameras) or not lines.known.any():
        return ""
    lines, arcs, track = _some(lines, arcs, track, max(LINES, LINES_OF_PHOTO * len(poses)))
    supposed = with_assumed_errors(cameras, arcs, replace(options, calibration_error_px=SUPPOSED_PX))
    errors = errors_by_calibration(lines, arcs, track, poses, supposed, options, points, iterations=ITERATIONS)
    if errors is None:
        return ""
    known = lines.known & (lines.sigma_m > 0)
    times = np.hypot(lines.sigma_m, sigma_m(lines, errors.lines))[known] / lines.sigma_m[known]
    said = [f"lines are {rounded(float(np.median(times)))} times as uncertain as stated"] if len(times) else []
    if poses.covariance is not None:
        stated = np.trace(poses.covariance[:, 3:, 3:], axis1=1, axis2=2)
        more = np.trace(errors.poses.numpy()[:, 3:, 3:], axis1=1, axis2=2)
        of_poses = np.sqrt(1.0 + more[stated > 0] / stated[stated > 0])
        said += [f"places of photos {rounded(float(np.median(of_poses)))} times"] if len(of_poses) else []
    return f"Where it is off by {SUPPOSED_PX} px (RMS), {' and '.join(said)} (median)." if said else ""


def _some(
    lines: Lines, arcs: MatchedArcs, track: Int[np.ndarray, " n"], count: int
) -> tuple[Lines, MatchedArcs, Int[np.ndarray, " m"]]:
    """About so many of the lines with all their stretches, and their arcs."""
    known = np.unique(track[lines.known])
    rows = np.flatnonzero(lines.known & np.isin(track, known[:: 1 + len(known) // count]))
    place = torch.full((len(lines),), -1)
    place[torch.as_tensor(rows)] = torch.arange(len(rows))
    of_arc = place[arcs.track]
    return lines.rows(rows), replace(arcs, track=of_arc, tracks=len(rows)).rows(of_arc >= 0), track[rows]
