"""Central camera models: pixel -> unit bearing on the Gaussian sphere and back.

    model = camera_models.load("calibration.yaml")["cam0"]
    bearings, valid = model.unproject(pixels)
    pixels, valid = model.project(points)

Names are listed without importing torch; everything else is loaded on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from camera_models.errors import GeometryError, InputError, OmnilinesError

if TYPE_CHECKING:
    from camera_models._model import CameraModel
    from camera_models.cylindrical import Cylindrical
    from camera_models.double_sphere import DoubleSphere
    from camera_models.equirectangular import Equirectangular
    from camera_models.extended_unified import ExtendedUnified
    from camera_models.fisheye624 import Fisheye624
    from camera_models.fitting import Conversion, convert
    from camera_models.formats.native import Calibration, CameraEstimate, load, save
    from camera_models.opencv_fisheye import OpenCVFisheye
    from camera_models.pinhole import Pinhole
    from camera_models.pose import Pose
    from camera_models.scaramuzza import Scaramuzza
    from camera_models.unified import Unified

# Narrow lenses first, then the richest curve before those of fewer parameters, last what is not calibrated.
MODELS: tuple[tuple[str, str], ...] = (
    ("pinhole", "camera_models.pinhole:Pinhole"),
    ("opencv-fisheye", "camera_models.opencv_fisheye:OpenCVFisheye"),
    ("fisheye624", "camera_models.fisheye624:Fisheye624"),
    ("scaramuzza", "camera_models.scaramuzza:Scaramuzza"),
    ("unified", "camera_models.unified:Unified"),
    ("extended-unified", "camera_models.extended_unified:ExtendedUnified"),
    ("double-sphere", "camera_models.double_sphere:DoubleSphere"),
    ("equirectangular", "camera_models.equirectangular:Equirectangular"),
    ("cylindrical", "camera_models.cylindrical:Cylindrical"),
)

_LAZY = {
    "CameraModel": "camera_models._model",
    "Calibration": "camera_models.formats.native",
    "CameraEstimate": "camera_models.formats.native",
    "Conversion": "camera_models.fitting",
    "Cylindrical": "camera_models.cylindrical",
    "DoubleSphere": "camera_models.double_sphere",
    "Equirectangular": "camera_models.equirectangular",
    "ExtendedUnified": "camera_models.extended_unified",
    "Fisheye624": "camera_models.fisheye624",
    "convert": "camera_models.fitting",
    "load": "camera_models.formats.native",
    "save": "camera_models.formats.native",
    "OpenCVFisheye": "camera_models.opencv_fisheye",
    "Pinhole": "camera_models.pinhole",
    "Pose": "camera_models.pose",
    "Scaramuzza": "camera_models.scaramuzza",
    "Unified": "camera_models.unified",
}

__all__ = [
    "MODELS",
    "Calibration",
    "CameraEstimate",
    "CameraModel",
    "Conversion",
    "Cylindrical",
    "DoubleSphere",
    "Equirectangular",
    "ExtendedUnified",
    "Fisheye624",
    "GeometryError",
    "InputError",
    "OmnilinesError",
    "OpenCVFisheye",
    "Pinhole",
    "Pose",
    "Scaramuzza",
    "Unified",
    "convert",
    "load",
    "model_class",
    "save",
]


def model_class(name: str) -> "type[CameraModel]":
    """The class of a camera model by the name used in files and on the command line; raises InputError on an unknown one."""
    known = dict(MODELS)
    if name not in known:
        raise InputError(f"A camera model is one of {', '.join(known)}, found '{name}'; choose one of these.")
    module, _, attribute = known[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'camera_models' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
