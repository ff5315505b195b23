"""Cameras to look at scenes with: any registered model, mirrors too."""

import math

import numpy as np
import torch

from camera_models import CameraModel, Cylindrical, Equirectangular, InputError, Scaramuzza, model_class
from camera_models.views import views
from omnilines.synthetic.targets import example_camera

FISHEYE_FOV_DEG, NARROW_FOV_DEG, WHOLE_DEG = 190.0, 80.0, 360.0


def default_fov_deg(model_name: str) -> float:
    """The field of view of a lens where none is asked for, across the largest circle in the image."""
    return NARROW_FOV_DEG if model_class(model_name).LARGEST_ANGLE <= 0.5 * math.pi else FISHEYE_FOV_DEG


def scene_camera(
    model_name: str, image_size: tuple[int, int], seed: int, fov_deg: float | None = None, mirror: bool = False
) -> tuple[CameraModel, float]:
    """A realistic camera and half the angle (rad) across its image circle, beyond which its photos are black.

    Lenses and mirrors show the largest circle in the image, of `fov_deg` across (default 190); pinhole cameras fill the image
    (default 80 across that circle), panoramas show the whole sphere and cylinders `fov_deg` across (default 360), all of them
    without a circle: pi. A mirror looks along -z.
    Raises InputError for a field of view that the model cannot have and for a mirror that is not scaramuzza.
    """
    kind = model_class(model_name)
    if mirror and kind is not Scaramuzza:
        raise InputError(f"A mirror is of --model scaramuzza, found {model_name}; take that model or leave out --mirror.")
    if kind is Equirectangular:
        if fov_deg not in (None, WHOLE_DEG):
            raise InputError(f"An equirectangular panorama shows 360 degrees, found {fov_deg:g}; leave out --fov-deg.")
        return kind([], image_size), math.pi
    if kind is Cylindrical:
        return views("cylindrical", image_size, fov_deg)[0].camera, math.pi
    narrow = kind.LARGEST_ANGLE <= 0.5 * math.pi
    angle = default_fov_deg(model_name) if fov_deg is None else fov_deg
    camera = example_camera(model_name, angle, image_size, seed)
    if mirror:
        # The ray of a pixel (x, y, f) becomes (x, y, -f): reflected in a plane across the axis, as by a mirror.
        first = camera.PARAMETER_NAMES.index("a0")
        camera = camera.with_parameters(torch.cat([camera.parameters[:first], -camera.parameters[first:]]))
    return camera, math.pi if narrow else 0.5 * math.radians(angle)


def largest_angle(camera: CameraModel, circle_rad: float) -> float:
    """The largest angle (rad) from the bearing of the centre pixel that a photo shows."""
    width, height = camera.image_size
    corners = np.array([[u, v] for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5)])
    with torch.no_grad():
        bearings, valid = camera.unproject(corners)
        axis, _ = camera.unproject(camera.centre_px.detach().numpy())
    if camera.PERIODIC or not valid.all():
        return min(circle_rad, camera.max_angle)
    angle = np.arctan2(np.linalg.norm(np.cross(bearings, axis), axis=-1), bearings @ axis)
    return min(circle_rad, float(angle.max()))
