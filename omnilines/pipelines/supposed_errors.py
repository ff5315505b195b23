"""What errors of the calibration leave uncertain where its file states none: a figure beside uncertainties that lack them.

Cameras from COLMAP or OpenCV, or typed by hand, count as exact. Nobody's are: how many times as uncertain lines and photos are
with cameras that are off by SUPPOSED_PX is said, so that what is stated is not taken for all there is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int

from camera_models import Calibration
from camera_models.wording import rounded
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.by_calibration import CalibrationErrors
from omnilines.adjustment.prior import KnownPoses
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


@dataclass(frozen=True)
class SupposedErrors:
    """How many times as uncertain as stated lines and photos are with cameras that are off by SUPPOSED_PX, medians."""

    of_lines: float
    of_photos: float | None
    """Of their places; None where poses are held."""

    @property
    def told(self) -> str:
        """In one sentence."""
        photos = "" if self.of_photos is None else f" and places of photos {rounded(self.of_photos)} times"
        lines = f"lines are {rounded(self.of_lines)} times as uncertain as stated"
        return f"Where it is off by {SUPPOSED_PX} px (RMS), {lines}{photos} (median)."


def supposed_errors(
    lines: Lines,
    arcs: MatchedArcs,
    track: Int[np.ndarray, " n"],
    poses: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    points: Mapping[str, PosePoints],
    *,
    prior: KnownPoses | None = None,
) -> SupposedErrors | None:
    """What would be with cameras that are off by SUPPOSED_PX; None where some file states errors, or where they cannot be
    followed. Arguments as of `errors_by_calibration`."""
    if states_errors(cameras) or not lines.known.any():
        return None
    every = int(lines.known[arcs.track.numpy()].sum())
    lines, arcs, track = _some(lines, arcs, track, max(LINES, LINES_OF_PHOTO * len(poses)))
    supposed = with_assumed_errors(cameras, arcs, replace(options, calibration_error_px=SUPPOSED_PX))
    # Beside fewer arcs a prior would hold poses more than it did.
    prior = None if prior is None else prior.loosened(math.sqrt(every / len(arcs)))
    errors = errors_by_calibration(lines, arcs, track, poses, supposed, options, points, prior=prior, iterations=ITERATIONS)
    known = lines.known & (lines.sigma_m > 0)
    if errors is None or not known.any():
        return None
    times = np.hypot(lines.sigma_m, sigma_m(lines, errors.lines))[known] / lines.sigma_m[known]
    return SupposedErrors(float(np.median(times)), _of_places(poses, errors))


def _of_places(poses: ImagePoses, errors: CalibrationErrors) -> float | None:
    """How many times as uncertain the place of a photo is, the median; None where none is uncertain."""
    if poses.covariance is None:
        return None
    stated = np.trace(poses.covariance[:, 3:, 3:], axis1=1, axis2=2)
    more = np.trace(errors.poses.numpy()[:, 3:, 3:], axis1=1, axis2=2)
    known = stated > 0
    return float(np.median(np.sqrt(1.0 + more[known] / stated[known]))) if known.any() else None


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


def unfollowed_errors(cameras: Calibration, options: SceneOptions, supposed: SupposedErrors | None) -> tuple[str, ...]:
    """What is not in the uncertainty of lines: errors that the file of the calibration states, or states of no camera, with what
    these would make of it."""
    if "intrinsics" in options.refine:
        return ()
    if options.partition and states_errors(cameras):
        return (
            "Errors of the calibration are not in the uncertainty of lines and poses: in parts (`partition`) they are not "
            "followed.",
        )
    known = [name for name, one in cameras.estimates.items() if one.covariance is not None]
    exact = ", ".join(name for name, model in cameras.items() if name not in known and model.CALIBRATED)
    if not exact:
        return ()
    said = (
        f"Errors of {exact} are not in the uncertainty of lines and poses: the calibration states no covariance "
        "(`scene.calibration_error_px` takes how far pixels are off)."
    )
    return (said if supposed is None else f"{said} {supposed.told}",)
