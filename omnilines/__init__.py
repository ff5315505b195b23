"""Calibrate wide-angle cameras and rebuild straight lines in 3D without undistorting an image.

    import omnilines as ol

    result = ol.calibrate("board/", "checkerboard:8x6:32.5mm", model="auto")
    result.camera, result.sigma, result.report("report.html")

Verbs take and return objects; files are read and written where that is asked for. Nothing is printed: `progress` is told how
far the work is, and stops it by raising `Cancelled`. Errors that a user can mend are `OmnilinesError`s. Names are loaded on first
use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from omnilines.compiled_cache import provide_cache as _provide_cache

if TYPE_CHECKING:
    from calib_patterns.options import DetectionOptions
    from camera_models.errors import GeometryError, InputError, OmnilinesError
    from camera_models.formats.native import Calibration, load, save
    from camera_models.pose import Pose
    from omnilines.calibration.options import CalibrationOptions
    from omnilines.extraction import ExtractionOptions
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
    from omnilines.footage.options import FrameOptions
    from omnilines.matching.options import MatchingOptions
    from omnilines.pipelines.adjust import adjust, segments_of_arrays, triangulate
    from omnilines.pipelines.arcs import extract
    from omnilines.pipelines.calibrate import CalibrationResult
    from omnilines.pipelines.calibrate_lines import LineResult
    from omnilines.pipelines.calibrate_one import calibrate
    from omnilines.pipelines.calibrate_rig import RigResult, calibrate_rig
    from omnilines.pipelines.check import CheckResult, check
    from omnilines.pipelines.check_options import CheckOptions
    from omnilines.pipelines.chosen_frames import ChosenFrames
    from omnilines.pipelines.convert import ConversionResult, convert
    from omnilines.pipelines.detect import detect
    from omnilines.pipelines.detect_rig import detect_rig
    from omnilines.pipelines.directions import PhotoDirections, directions
    from omnilines.pipelines.export import SceneExport, export
    from omnilines.pipelines.frames import frames
    from omnilines.pipelines.given_arcs import given_arcs
    from omnilines.pipelines.line_options import LinesOptions
    from omnilines.pipelines.options import SceneOptions
    from omnilines.pipelines.photo_arcs import PhotoArcs
    from omnilines.pipelines.photo_corners import PhotoCorners
    from omnilines.pipelines.poses import estimate_poses
    from omnilines.pipelines.reconstruct import reconstruct
    from omnilines.pipelines.rectified import RectifiedViews
    from omnilines.pipelines.rectify import rectify
    from omnilines.pipelines.render import RenderOptions, render
    from omnilines.pipelines.rendered import RenderedScene, RenderedTargets
    from omnilines.pipelines.rig_corners import RigCorners
    from omnilines.pipelines.scene import Scene
    from omnilines.posing.options import PosingOptions
    from omnilines.posing.photo_poses import PhotoPoses
    from omnilines.progress import Cancelled, ProgressCallback
    from omnilines.records import Corners, ImagePoses, Lines, Segments
    from omnilines.structure.options import DirectionsOptions
    from omnilines.studies.scene_validation import SceneValidation
    from omnilines.studies.validate import validate
    from omnilines.studies.validation import Validation

# Before numba is imported, which reads it then.
_provide_cache()

_HOMES = {
    # Videos -> frames; photos of a target -> cameras.
    "omnilines.pipelines.frames": ("frames",),
    "omnilines.pipelines.chosen_frames": ("ChosenFrames",),
    "omnilines.footage.options": ("FrameOptions",),
    "omnilines.pipelines.detect": ("detect",),
    "omnilines.pipelines.photo_corners": ("PhotoCorners",),
    "calib_patterns.options": ("DetectionOptions",),
    "omnilines.pipelines.detect_rig": ("detect_rig",),
    "omnilines.pipelines.rig_corners": ("RigCorners",),
    "omnilines.pipelines.calibrate_one": ("calibrate",),
    "omnilines.pipelines.calibrate": ("CalibrationResult",),
    "omnilines.pipelines.calibrate_rig": ("calibrate_rig", "RigResult"),
    "omnilines.pipelines.calibrate_lines": ("LineResult",),
    "omnilines.pipelines.line_options": ("LinesOptions",),
    "omnilines.pipelines.check": ("check", "CheckResult"),
    "omnilines.pipelines.check_options": ("CheckOptions",),
    "omnilines.calibration.options": ("CalibrationOptions",),
    "omnilines.pipelines.convert": ("convert", "ConversionResult"),
    # Photos and cameras -> arcs, poses, lines.
    "omnilines.pipelines.arcs": ("extract",),
    "omnilines.pipelines.photo_arcs": ("PhotoArcs",),
    "omnilines.pipelines.given_arcs": ("given_arcs",),
    "omnilines.extraction": ("ExtractionOptions",),
    "omnilines.pipelines.directions": ("directions", "PhotoDirections"),
    "omnilines.structure.options": ("DirectionsOptions",),
    "omnilines.pipelines.poses": ("estimate_poses",),
    "omnilines.posing.photo_poses": ("PhotoPoses",),
    "omnilines.posing.options": ("PosingOptions",),
    "omnilines.pipelines.reconstruct": ("reconstruct",),
    "omnilines.pipelines.scene": ("Scene",),
    "omnilines.pipelines.options": ("SceneOptions",),
    "omnilines.matching.options": ("MatchingOptions",),
    "omnilines.pipelines.adjust": ("adjust", "triangulate", "segments_of_arrays"),
    "omnilines.pipelines.export": ("export", "SceneExport"),
    "omnilines.pipelines.rectify": ("rectify",),
    "omnilines.pipelines.rectified": ("RectifiedViews",),
    # A known truth -> photos, and what becomes of them.
    "omnilines.pipelines.render": ("render", "RenderOptions"),
    "omnilines.pipelines.rendered": ("RenderedTargets", "RenderedScene"),
    "omnilines.studies.validate": ("validate",),
    "omnilines.studies.validation": ("Validation",),
    "omnilines.studies.scene_validation": ("SceneValidation",),
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
    "CheckOptions",
    "CheckResult",
    "ChosenFrames",
    "ConversionResult",
    "Corners",
    "DetectionOptions",
    "DirectionsOptions",
    "ExtractionOptions",
    "FrameOptions",
    "GeometryError",
    "ImagePoses",
    "InputError",
    "LineResult",
    "Lines",
    "LinesOptions",
    "MatchingOptions",
    "OmnilinesError",
    "PhotoArcs",
    "PhotoCorners",
    "PhotoDirections",
    "PhotoPoses",
    "Pose",
    "PosingOptions",
    "ProgressCallback",
    "RectifiedViews",
    "RenderOptions",
    "RenderedScene",
    "RenderedTargets",
    "RigCorners",
    "RigResult",
    "Scene",
    "SceneExport",
    "SceneOptions",
    "SceneValidation",
    "Segments",
    "Validation",
    "adjust",
    "calibrate",
    "calibrate_rig",
    "check",
    "convert",
    "detect",
    "detect_rig",
    "directions",
    "estimate_poses",
    "export",
    "extract",
    "frames",
    "given_arcs",
    "load",
    "read_corners",
    "read_lines",
    "read_poses",
    "read_rig_corners",
    "read_segments",
    "reconstruct",
    "rectify",
    "render",
    "save",
    "segments_of_arrays",
    "triangulate",
    "validate",
    "write_corners",
    "write_lines",
    "write_poses",
    "write_segments",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("omnilines")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'omnilines' has no attribute '{name}'")
    globals()[name] = value = getattr(importlib.import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
