"""OpenSfM's camera_models.json (camera_models_overrides.json, OpenDroneMap's cameras.json): cameras by name.

    projection_type    our model         keys
    simple_radial      pinhole           focal_x focal_y c_x c_y k1
    radial             pinhole           and k2
    brown              pinhole           focal_x focal_y c_x c_y k1 k2 p1 p2 k3
    perspective        pinhole           focal k1 k2, the centre in the middle (read)
    fisheye_opencv     opencv-fisheye    focal_x focal_y c_x c_y k1 k2 k3 k4
    fisheye            opencv-fisheye    focal k1 k2, the centre in the middle (read)
    spherical          equirectangular   none

Lengths are fractions of the longer side of the image, from its middle: u = c_x max(w, h) + (w - 1) / 2.
OpenSfM documentation, "Geometric models".
"""

import math
from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import HAS_POSES, CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import mapping, number, required, text

_K = ("fx", "fy", "cx", "cy")
_KEYS = {"fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y"}
_CENTRED = {"perspective": "pinhole", "fisheye": "opencv-fisheye"}
"""Types of one focal length whose centre is the middle of the image."""
_PANORAMAS = ("spherical", "equirectangular")
_COMMON = ("projection_type", "width", "height")


class OpenSfM(CalibrationFormat):
    """camera_models.json."""

    NAME = "opensfm"
    TITLE = "OpenSfM"
    SUFFIXES = (".json",)
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("simple_radial", "pinhole", (*_K, "k1")),
        Form("radial", "pinhole", (*_K, "k1", "k2")),
        Form("brown", "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3")),
        Form("fisheye_opencv", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4")),
        Form("spherical", "equirectangular", ()),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """JSON that names a type of projection."""
        return path.suffix.lower() in self.SUFFIXES and '"projection_type"' in head

    def names(self, calibration: Calibration) -> list[str]:
        """Their own."""
        return list(calibration)

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data, notes = _cameras_of(read_json(path))
        cameras: dict[str, CameraModel] = {}
        beside: dict[str, list[str]] = {}
        for name, value in data.items():
            keys = mapping(value, name)
            cameras[name], read = self._camera(keys, name)
            beside[name] = [key for key in keys if key not in (*read, *_COMMON)]
        return Content(Calibration(cameras), (*notes, *left_out(beside)))

    def _camera(self, keys: dict[str, Any], name: str) -> tuple[CameraModel, tuple[str, ...]]:
        """The camera, and the keys that it is made of."""
        kind = text(required(keys, "projection_type", name), f"projection_type of {name}")
        size = size_of([required(keys, key, name) for key in ("width", "height")], f"width and height of {name}")
        if kind in _PANORAMAS:
            return self.form_named("spherical", name).camera([], size, name), ()
        longer, middle = max(size), {"cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}
        if kind in _CENTRED:
            focal = number(required(keys, "focal", name), f"focal of {name}") * longer
            terms = {key: number(keys.get(key, 0.0), f"{key} of {name}") for key in ("k1", "k2")}
            form = next(form for form in self.FORMS if form.model == _CENTRED[kind] and {"k1", "k2"} <= set(form.order or ()))
            named = {"fx": focal, "fy": focal, **middle, **terms}
            return form.camera([named.get(key, 0.0) for key in form.order or ()], size, name), ("focal", "k1", "k2")
        form = self.form_named(kind, name)
        values = []
        for ours in form.order or ():
            key = _KEYS.get(ours, ours)
            given = number(required(keys, key, name) if ours in ("fx", "fy") else keys.get(key, 0.0), f"{key} of {name}")
            values.append(_pixels(given, longer, middle.get(ours, 0.0)) if ours in _KEYS else given)
        return form.camera(values, size, name), tuple(_KEYS.get(ours, ours) for ours in form.order or ())

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        data: dict[str, Any] = {}
        for name, model in calibration.items():
            form = self.exact_form(model)
            width, height = model.image_size
            keys: dict[str, Any] = {"projection_type": form.name, "width": width, "height": height}
            middle = {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
            for ours, value in zip(form.order or (), form.values(model), strict=True):
                keys[_KEYS.get(ours, ours)] = (value - middle.get(ours, 0.0)) / max(width, height) if ours in _KEYS else value
            data[name] = keys
        return {path: json_text(data)}


def _cameras_of(data: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The cameras of a file of cameras, or of the first reconstruction of a file of those; and what is left out of that."""
    if not isinstance(data, list):
        return mapping(data, "the file"), ()
    first = mapping(data[0] if data else None, "the first reconstruction")
    notes = left_out({"the file": [key for key in first if key not in ("cameras", "shots")]})
    poses = (HAS_POSES,) if first.get("shots") else ()
    return mapping(required(first, "cameras", "the first reconstruction"), "cameras"), (*notes, *poses)


def _pixels(fraction: float, longer: int, middle: float) -> float:
    """fraction * longer + middle, rounded so that it is written as the same fraction again where there is such a number."""
    pixels = fraction * longer + middle
    near = (pixels, math.nextafter(pixels, math.inf), math.nextafter(pixels, -math.inf))
    return next((value for value in near if (value - middle) / longer == fraction), pixels)
