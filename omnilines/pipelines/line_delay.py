"""The rolling shutter of one camera: recognised where its frames follow one another closely, estimated where that is asked."""

from dataclasses import replace

import numpy as np

from camera_models import GeometryError, InputError
from omnilines.calibration.options import CalibrationOptions
from omnilines.calibration.result import CameraCalibration
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.calibrate import calibrate_rig
from omnilines.calibration.rig.one_camera import one_camera
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.rolling import follow_closely, not_closely
from omnilines.calibration.thresholds import ClockThresholds
from omnilines.files.frames import times_of
from omnilines.least_squares import Progress
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.progress import ProgressCallback
from omnilines.records import Corners

CAMERA = "cam0"
"""The name of one camera."""


def require_times(corners: Corners) -> None:
    """Raises InputError where it is not known when views were taken."""
    if corners.times_s is None:
        raise InputError(
            "`rolling_shutter` tells how rows are read by how the board moves from frame to frame, found no times: of stills "
            "there is nothing to estimate; give a video, or a table with a column time_s."
        )


def require_close(corners: Corners, limits: ClockThresholds) -> None:
    """Raises InputError where the frames of one camera do not tell how its rows are read."""
    require_times(corners)
    if not follow_closely(_named(corners), limits):
        raise InputError(not_closely(limits))


def _named(corners: Corners) -> Corners:
    return replace(corners, cameras=(CAMERA,) * len(corners.view_names))


def timed(found: PhotoCorners) -> PhotoCorners:
    """With the times of photos that are frames in memory or lie beside their `frames.csv`, where all of them are known."""
    if found.corners.times_s is not None or not found.photos:
        return found
    times_s, names = times_of(found.photos, found.photo_folder), found.corners.view_names
    if not times_s.keys() >= set(names):
        return found
    return replace(found, corners=replace(found.corners, times_s=np.array([times_s[name] for name in names])))


def with_line_delay(
    found: PhotoCorners, result: CameraCalibration, options: CalibrationOptions, progress: ProgressCallback
) -> CameraCalibration:
    """The calibration with the line delay estimated, where options say so; else as it is, with a note where a rolling shutter is
    recognised. Raises InputError and GeometryError where it is asked for and frames do not tell."""
    named = _named(found.corners)
    if not options.rolling_shutter and not follow_closely(named, options.clocks):
        return result
    try:
        rig = _as_rig(named, found.image_size, result, options, progress)
    except (InputError, GeometryError):
        if options.rolling_shutter:
            raise
        return result
    if not options.rolling_shutter:
        delay = next(iter(rig.line_delays), None)
        return (
            result
            if delay is None
            else replace(result, line_delay=delay, notes=(*result.notes, _said(delay.note(found.image_size))))
        )
    single, _ = one_camera(rig, rig.members[0])
    notes = tuple(_said(note.removeprefix(f"Camera {CAMERA}: ")) for note in rig.notes)
    return replace(single, notes=notes, board=rig.board, board_sigma=rig.board_sigma)


def _as_rig(
    corners: Corners,
    image_size: tuple[int, int],
    result: CameraCalibration,
    options: CalibrationOptions,
    progress: ProgressCallback,
) -> RigCalibration:
    """A rig of this camera, from its calibration on."""

    def tell(stage: str, step: Progress) -> None:
        progress("following the board", step.iteration, 0)

    return calibrate_rig(
        corners,
        {CAMERA: CameraSetup(image_size, result.model.NAME, start=result.model)},
        loss=options.loss,
        refine_board=options.refine_board,
        rolling_shutter=options.rolling_shutter,
        thresholds=options,
        callback=tell,
    )


def _said(note: str) -> str:
    return f"{note[0].upper()}{note[1:]}"
