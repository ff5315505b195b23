"""Calibrate wide-angle cameras and rebuild straight lines in 3D without undistorting an image.

    import omnilines as ol

    corners = ol.detect("board/", "checkerboard:8x6:32.5mm")
    result = ol.calibrate(corners, model="auto")
    result.camera, result.sigma, result.report("report.html")

Verbs take and return objects; files are read and written where that is asked for. Nothing is printed: `progress` is told how
far the work is, and stops it by raising `Cancelled`. Errors that a user can mend are `OmnilinesError`s. Names are loaded on first
use.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_patterns.options import DetectionOptions
    from camera_models.errors import GeometryError, InputError, OmnilinesError
    from camera_models.formats.native import Calibration, load, save
    from camera_models.pose import Pose
    from omnilines.calibration.options import CalibrationOptions
    from omnilines.files import (
        read_corners,
        read_lines,
        read_poses,
        read_rig_corners,
        read_segments,
        write_corners,
        write_lines,
        write_poses,
        write_segments,
    )
    from omnilines.pipelines.calibrate import CalibrationResult, calibrate
    from omnilines.pipelines.calibrate_rig import RigResult, calibrate_rig
    from omnilines.pipelines.convert import ConversionResult, convert
    from omnilines.pipelines.detect import PhotoCorners, detect
    from omnilines.pipelines.detect_rig import RigCorners, detect_rig
    from omnilines.progress import Cancelled, ProgressCallback
    from omnilines.records import Corners, ImagePoses, Lines, Segments

_HOMES = {
    # Photos of a target -> cameras.
    "omnilines.pipelines.detect": ("detect", "PhotoCorners"),
    "calib_patterns.options": ("DetectionOptions",),
    "omnilines.pipelines.detect_rig": ("detect_rig", "RigCorners"),
    "omnilines.pipelines.calibrate": ("calibrate", "CalibrationResult"),
    "omnilines.pipelines.calibrate_rig": ("calibrate_rig", "RigResult"),
    "omnilines.calibration.options": ("CalibrationOptions",),
    "omnilines.pipelines.convert": ("convert", "ConversionResult"),
    # What is read, written and handed on.
    "camera_models.formats.native": ("load", "save", "Calibration"),
    "camera_models.pose": ("Pose",),
    "omnilines.files": (
        *("read_corners", "read_rig_corners", "read_poses", "read_segments", "read_lines"),
        *("write_corners", "write_poses", "write_segments", "write_lines"),
    ),
    "omnilines.records": ("Corners", "ImagePoses", "Segments", "Lines"),
    # What every verb may raise, and how it tells of its progress.
    "camera_models.errors": ("OmnilinesError", "InputError", "GeometryError"),
    "omnilines.progress": ("ProgressCallback", "Cancelled"),
}
"""The module of every public name, in the order of the data flow."""
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Calibration",
    "CalibrationOptions",
    "CalibrationResult",
    "Cancelled",
    "ConversionResult",
    "Corners",
    "DetectionOptions",
    "GeometryError",
    "ImagePoses",
    "InputError",
    "Lines",
    "OmnilinesError",
    "PhotoCorners",
    "Pose",
    "ProgressCallback",
    "RigCorners",
    "RigResult",
    "Segments",
    "calibrate",
    "calibrate_rig",
    "convert",
    "detect",
    "detect_rig",
    "load",
    "read_corners",
    "read_lines",
    "read_poses",
    "read_rig_corners",
    "read_segments",
    "save",
    "write_corners",
    "write_lines",
    "write_poses",
    "write_segments",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'omnilines' has no attribute '{name}'")
    globals()[name] = value = getattr(importlib.import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
