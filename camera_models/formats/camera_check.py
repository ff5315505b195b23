"""Whether a camera found in a file can be one: numbers within reason, and an image of which it sees something."""

import torch

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.values import LARGEST_SIDE_PX

LARGEST_PARAMETER = 1e30
LARGEST_FOCAL_PX = 1e8
LEAST_FOCAL = 1e-4
"""Of the longer side of the image: a pinhole camera of 179.98 degrees."""
FARTHEST_CENTRE = 20.0
"""Image sides by which the centre may lie outside: crops of larger images have it there."""
LEAST_AFFINE, LARGEST_AFFINE = 1e-3, 10.0
"""Determinant and entries of the affine matrix of a chip."""
FARTHEST_M = 1e9
_ACROSS = 21
_LEAST_SEEN = 0.01
"""Share of the pixels of a grid that have a bearing."""
_ROUND_TRIP_PX = 0.1


def check_cameras(calibration: Calibration) -> None:
    """Raises InputError, naming the camera, where a model sees nothing of its image or a pose is beyond reason."""
    for name, model in calibration.items():
        _check_numbers(name, model)
        if model.CALIBRATED:
            _check_sight(name, model)
    for name, item in calibration.rig.items():
        for what, value in (("translation", item.cam_from_rig.translation), ("rotation", item.cam_from_rig.rotation)):
            if not bool((value.abs() <= FARTHEST_M).all()):
                raise InputError(
                    f"The {what} of camera {name} in the rig was expected to be below {FARTHEST_M:g}, found "
                    f"{float(value.abs().max()):g}; correct it."
                )


def _check_numbers(name: str, model: CameraModel) -> None:
    if not name.strip() or not name.isprintable():
        raise InputError(f"The name of a camera was expected to be text, found {name!r}; rename it.")
    width, height = model.image_size
    if not 1 <= min(width, height) <= max(width, height) <= LARGEST_SIDE_PX:
        raise InputError(
            f"The image of camera {name} was expected to have sides of 1 to {LARGEST_SIDE_PX} px, found {width} x {height}; "
            "correct it."
        )
    values = model.named_parameters()
    for key, value in values.items():
        if not abs(value) <= LARGEST_PARAMETER:
            raise InputError(
                f"The parameter {key} of camera {name} must be a finite number, at most {LARGEST_PARAMETER:g}, found {value:g}; "
                "calibrate it again."
            )
    for key in ("fx", "fy"):
        least = LEAST_FOCAL * max(width, height)
        if key in values and not least <= values[key] <= LARGEST_FOCAL_PX:
            raise InputError(
                f"The focal length {key} of camera {name} was expected in pixels, {least:g} to {LARGEST_FOCAL_PX:g} for an image "
                f"of {width} x {height}, found {values[key]:g}; correct it."
            )
    if "a0" in values and not 0.0 < abs(values["a0"]) <= LARGEST_FOCAL_PX:
        raise InputError(
            f"The parameter a0 of camera {name} was expected to be a focal length (below 0 for a mirror) of up to "
            f"{LARGEST_FOCAL_PX:g} px, found {values['a0']:g}; correct it."
        )
    affine = [values.get(key, 0.0) for key in ("c", "d", "e")]
    if "a0" in values and not (abs(affine[0] - affine[1] * affine[2]) > LEAST_AFFINE and max(map(abs, affine)) <= LARGEST_AFFINE):
        raise InputError(
            f"The affine matrix [1 e; d c] of camera {name} was expected to be near the identity, found c = {values['c']:g}, "
            f"d = {values['d']:g}, e = {values['e']:g}; correct it."
        )
    for key, side in (("cx", width), ("cy", height)):
        if key in values and not -FARTHEST_CENTRE * side <= values[key] <= (1 + FARTHEST_CENTRE) * side:
            raise InputError(
                f"The centre {key} of camera {name} was expected near its image of {width} x {height} px, found {values[key]:g}; "
                "correct it."
            )


def seen_share(model: CameraModel) -> float:
    """Share of the pixels of an image, on a grid, that have a bearing which is seen at that pixel."""
    width, height = model.image_size
    u, v = torch.linspace(0, width - 1, _ACROSS, dtype=torch.float64), torch.linspace(0, height - 1, _ACROSS, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)
    with torch.no_grad():
        bearings, seen = model.unproject(pixels)
        again, valid = model.project(bearings)
    near = valid & ((again - pixels).norm(dim=-1) < _ROUND_TRIP_PX)
    return float((seen & near & bearings.isfinite().all(-1)).double().mean())


def _check_sight(name: str, model: CameraModel) -> None:
    """Pixels of the image have bearings, and these are seen at those pixels."""
    share = seen_share(model)
    if share < _LEAST_SEEN:
        values = " ".join(f"{key}={value:g}" for key, value in model.named_parameters().items())
        raise InputError(
            f"Camera {name} ({model.NAME}) was expected to see what is in its image, found that it sees {100 * share:.0f} "
            f"percent of it with {values}; calibrate it again."
        )
