"""Frames of one video in which the target moves, and the rolling shutter that they show."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_patterns import Detection, Pattern
from camera_models import GeometryError, InputError
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.single import calibrate_camera
from omnilines.footage.options import FrameOptions
from omnilines.footage.stillness import Instant
from omnilines.pipelines.line_delay import with_line_delay
from omnilines.pipelines.photo_corners import PhotoCorners, corner_table
from omnilines.progress import silent


def moving_runs(still: Sequence[Instant], instants: Sequence[Instant], options: FrameOptions) -> list[Instant]:
    """The frames around those of the `still` instants of a camera that move most, by which a target is followed; none where they
    are too far apart for that."""
    if len(instants) < options.frames_of_run or len(instants[0].index) > 1:
        return []
    gap_s = float(np.median(np.diff([instant.time_s[0] for instant in instants])))
    if gap_s > CalibrationOptions().clocks.longest_gap_of_rows_s:
        return []
    place = {instant.index: k for k, instant in enumerate(instants)}
    fastest = sorted(still, key=lambda instant: -instant.motion_px)[: options.max_moving_runs]
    half, chosen = options.frames_of_run // 2, set[int]()
    for instant in fastest:
        low = max(0, min(place[instant.index] - half, len(instants) - options.frames_of_run))
        chosen |= {*range(low, min(low + options.frames_of_run, len(instants)))}
    return [instants[k] for k in sorted(chosen)]


def rolling_note(seen: Sequence[tuple[str, Detection, float]], target: Pattern, image_size: tuple[int, int]) -> tuple[str, ...]:
    """What frames, their corners and times tell of a rolling shutter: a sentence where that is beyond chance."""
    found = [one for one in seen if len(one[1])]
    options = CalibrationOptions()
    if not found:
        return ()
    corners = corner_table([(name, detection) for name, detection, _ in found], target)
    timed = PhotoCorners.of_table(replace(corners, times_s=np.array([time_s for _, _, time_s in found])), image_size)
    try:
        plain = calibrate_camera(timed.corners, image_size, options.model, thresholds=options)
    except (InputError, GeometryError):
        # The few frames that move most need not tell a camera.
        return ()
    rolled = with_line_delay(timed, plain, options, silent)
    return () if rolled.line_delay is None else rolled.notes[-1:]
