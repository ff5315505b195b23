"""Cameras as commands are given them: a calibration file, or the name of a model that has no parameters but its image size."""

import re
from collections.abc import Sequence
from pathlib import Path

from camera_models import MODELS, Calibration, CameraModel, load, model_class
from camera_models.errors import InputError
from omnilines.files.photos import Photo

CAMERA = "cam0"
_SIZE = re.compile(r"([1-9][0-9]{0,5})x([1-9][0-9]{0,5})")
_WIDTH_OF_HEIGHT, _ROUNDED_PX = 2, 2
"""Of a panorama of the whole sphere with square pixels; how far a width that was rounded may be off."""


def read_cameras(given: str | Path, photos: Sequence[Photo] = ()) -> Calibration:
    """The cameras of a calibration file, or of `equirectangular:5376x2688`; of `equirectangular` alone the first photo has the
    size that is twice as wide as high.

    Raises InputError as `camera_models.load` does, where a size is malformed or missing, and where no photo is twice as
    wide as high, as panoramas of the whole sphere are.
    """
    name, _, size = str(given).partition(":")
    if name not in dict(MODELS) or Path(given).is_file():
        return load(given)
    model = model_class(name)
    if model.PARAMETER_NAMES:
        raise InputError(
            f"A calibration file was expected, found the camera model {name}, which has {len(model.PARAMETER_NAMES)} parameters; "
            f"give the calibration.yaml of the camera ('omnilines calibrate PHOTOS --model {name}' writes one)."
            if model.CALIBRATED
            else f"A calibration file was expected, found the camera model {name}, which has parameters "
            f"({', '.join(model.PARAMETER_NAMES)}); write them to a calibration.yaml (docs/formats.md)."
        )
    return Calibration({CAMERA: model.from_mapping({}, _asked(given, size) if size else _found(model, photos))})


def calibration_files(given: str | Path) -> list[Path]:
    """The file that `read_cameras` reads; none of a model by name."""
    return [Path(given)] if Path(given).is_file() else []


def _asked(given: str | Path, size: str) -> tuple[int, int]:
    found = _SIZE.fullmatch(size)
    if found is None:
        raise InputError(f"A panorama was expected as equirectangular:WIDTHxHEIGHT in pixels, found '{str(given)[:60]}'.")
    return int(found[1]), int(found[2])


def _found(model: type[CameraModel], photos: Sequence[Photo]) -> tuple[int, int]:
    """The size of the first photo that may be a panorama; others are for those who read them to skip."""
    refused: InputError | None = None
    for photo in photos:
        try:
            height, width = photo.read().shape[:2]
        except InputError as error:
            refused = refused or error
            continue
        if abs(width - _WIDTH_OF_HEIGHT * height) <= _ROUNDED_PX:
            return width, height
        refused = refused or InputError(
            f"Panoramas of the whole sphere, twice as wide as high, were expected of --calibration {model.NAME}, found "
            f"{photo.name} of {width}x{height} px; give the calibration of the camera, or, if it is such a panorama, "
            f"{model.NAME}:{width}x{height}."
        )
    raise refused or InputError(
        f"The size of the panoramas was expected beside {model.NAME}; give {model.NAME}:WIDTHxHEIGHT, such as "
        f"{model.NAME}:5376x2688."
    )
