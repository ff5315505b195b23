"""Cameras to resample photos into: perspective, cylindrical and panoramic views, and the six faces of a cube.

A view looks along the optical axis of its photo, with its y axis downwards as the photo has it.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from camera_models._model import CameraModel
from camera_models.cylindrical import Cylindrical
from camera_models.equirectangular import Equirectangular
from camera_models.errors import InputError
from camera_models.pinhole import Pinhole

VIEWS = ("perspective", "cylindrical", "panorama", "cube")
CUBE_FACES: tuple[tuple[str, float, float], ...] = (
    ("front", 0.0, 0.0),
    ("right", 90.0, 0.0),
    ("back", 180.0, 0.0),
    ("left", -90.0, 0.0),
    ("up", 0.0, 90.0),
    ("down", 0.0, -90.0),
)
"""Name, yaw to the right and pitch upwards (degrees) of each face."""
USUAL_PERSPECTIVE_DEG, WIDEST_PERSPECTIVE_DEG = 90.0, 170.0


@dataclass(frozen=True)
class View:
    """One camera to resample photos into."""

    name: str
    """Of a face of a cube; else empty."""
    camera: CameraModel
    view_from_axis: Float[np.ndarray, "3 3"]
    """Rotation from the frame that looks along the optical axis of the photo."""


def views(
    kind: str,
    size: tuple[int, int] | None = None,
    fov_deg: float | int | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
) -> tuple[View, ...]:
    """The cameras of a kind of view: one, or six of a cube.

    `size` is (width, height), by default 960x960 for perspective views, 2048x1024 for panoramas, 2048x768 for cylinders and
    768x768 for faces; `fov_deg` is the angle across perspective views (90) and cylinders (360), fixed for the others.
    `yaw_deg` and `pitch_deg` turn the view to the right and upwards from the optical axis.

    Raises InputError for an unknown kind or a size or a field of view that it cannot have.
    """
    if kind not in VIEWS:
        raise InputError(f"A view is one of {', '.join(VIEWS)}, found '{kind}'; choose one of these.")
    width, height = size or _SIZES[kind]
    aim = looking(yaw_deg, pitch_deg)
    if kind == "perspective":
        return (View("", _perspective(width, height, _angle(fov_deg, USUAL_PERSPECTIVE_DEG, WIDEST_PERSPECTIVE_DEG)), aim),)
    if kind == "cylindrical":
        across = _angle(fov_deg, 360.0, 360.0)
        focal = width / math.radians(across)
        camera = Cylindrical([focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)], (width, height))
        return (View("", camera, aim),)
    fixed = 360.0 if kind == "panorama" else 90.0
    if fov_deg not in (None, fixed):
        raise InputError(f"A {kind} view is {fixed:g} degrees across, found {fov_deg:g}; leave the field of view out.")
    if kind == "panorama":
        return (View("", Equirectangular([], (width, height)), aim),)
    if width != height:
        raise InputError(f"The faces of a cube are square, found {width}x{height} px; give a size like 768x768.")
    face = _perspective(width, height, 90.0)
    return tuple(View(name, face, looking(yaw, pitch) @ aim) for name, yaw, pitch in CUBE_FACES)


_SIZES = {"perspective": (960, 960), "cylindrical": (2048, 768), "panorama": (2048, 1024), "cube": (768, 768)}


def _angle(fov_deg: float | int | None, usual: float, widest: float) -> float:
    angle = usual if fov_deg is None else float(fov_deg)
    if not 1.0 <= angle <= widest:
        raise InputError(f"A field of view of 1 to {widest:g} degrees was expected, found {angle:g}; give one in this range.")
    return angle


def _perspective(width: int, height: int, fov_deg: float) -> Pinhole:
    focal = 0.5 * width / math.tan(0.5 * math.radians(fov_deg))
    named = {"fx": focal, "fy": focal, "cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
    return Pinhole.from_mapping(named, (width, height))


def looking(yaw_deg: float, pitch_deg: float) -> Float[np.ndarray, "3 3"]:
    """Rotation into the frame of a camera turned to the right by the yaw and then upwards by the pitch."""
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ turn


def axis_from_camera(camera: CameraModel) -> Float[np.ndarray, "3 3"]:
    """Rotation into the frame that looks along the optical axis: none, or half a turn about y for mirrors, which look back."""
    with torch.no_grad():
        bearing, _ = camera.unproject(camera.centre_px.detach())
    return np.eye(3) if float(bearing[2]) > 0 else np.diag([-1.0, 1.0, -1.0])
