"""Nerfstudio's transforms.json (also instant-ngp's): one camera at the top of the file, or the same one in every frame.

    OPENCV             pinhole           fl_x fl_y cx cy k1 k2 p1 p2 k3
    OPENCV_FISHEYE     opencv-fisheye    fl_x fl_y cx cy k1 k2 k3 k4
    FISHEYE624         fisheye624        fl_x fl_y cx cy and distortion_params: k0 ... k5 p0 p1 s0 s1 s2 s3
    EQUIRECTANGULAR    equirectangular   fl_x = w / 2, fl_y = h

The upper left corner of the image is (0, 0) there. Frames hold the poses of photos; a calibration has none.
Nerfstudio documentation, "Data conventions".
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.fisheye624 import Fisheye624
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import DEFAULT_NAME, HAS_POSES, CalibrationFormat, Content, Documents
from camera_models.formats.forms import Form
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, number, numbers, required, text
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_KEYS = {"fx": "fl_x", "fy": "fl_y"}
_PINHOLE, _FISHEYE, _FISHEYE624, _PANORAMA = "OPENCV", "OPENCV_FISHEYE", "FISHEYE624", "EQUIRECTANGULAR"
_OTHER_NAMES = {"PINHOLE": _PINHOLE, "SIMPLE_PINHOLE": _PINHOLE, "SIMPLE_RADIAL": _PINHOLE, "RADIAL": _PINHOLE}
_CENTRE = 0.5
"""Of the first pixel, in Nerfstudio."""
_LIST = "distortion_params"
_TERMS = Fisheye624.PARAMETER_NAMES[4:]
_NO_PLACE = {_PINHOLE: ("k4",), _FISHEYE: ("p1", "p2"), _FISHEYE624: ("k1", "k2", "k3", "k4", "p1", "p2"), _PANORAMA: ()}
"""Terms that our model of a camera has not: they have to be 0."""
_LENS = (
    *("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", _LIST),
    *("camera_angle_x", "is_fisheye"),
)
FRAMES = "frames"


class Nerfstudio(CalibrationFormat):
    """transforms.json."""

    NAME = "nerfstudio"
    TITLE = "Nerfstudio"
    SUFFIXES = (".json",)
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form(_PINHOLE, "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3")),
        Form(_FISHEYE, "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4")),
        Form(_FISHEYE624, "fisheye624", Fisheye624.PARAMETER_NAMES, on_request=True),
        Form(_PANORAMA, "equirectangular", ()),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with Nerfstudio's focal length, or the frames of instant-ngp."""
        return path.suffix.lower() in self.SUFFIXES and any(key in head for key in ('"fl_x"', '"camera_angle_x"'))

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(read_json(path), "the file")
        frames = items(data.get(FRAMES) or [], FRAMES)
        lenses = []
        for index, frame in enumerate(frames):
            lens = _lens_of(data) | _lens_of(mapping(frame, f"frame {index}"))
            if lens not in lenses:
                lenses.append(lens)
        if len(lenses) > 1:
            raise InputError(f"Frames of one camera were expected, found {len(lenses)} cameras; give the frames of one.")
        camera = self._camera(lenses[0] if lenses else _lens_of(data), image_size)
        beside = [key for key in data if key not in _LENS and key != FRAMES]
        notes = (f"Not kept: {listed(beside)}.",) if beside else ()
        return Content(Calibration({DEFAULT_NAME: camera}), (*notes, HAS_POSES) if frames else notes)

    def _camera(self, lens: Mapping[str, Any], image_size: tuple[int, int] | None) -> CameraModel:
        if "w" not in lens and "h" not in lens and image_size is not None:
            size = image_size
        else:
            # Some tools write whole numbers as floats.
            sides = [number(required(lens, key, "the file"), key) for key in ("w", "h")]
            size = size_of([int(side) if side == int(side) else side for side in sides], "w, h")
        given = text(lens.get("camera_model", _FISHEYE if lens.get("is_fisheye") is True else _PINHOLE), "camera_model")
        form = self.form_named(_OTHER_NAMES.get(given, given), "the file")
        beyond = [key for key in _NO_PLACE[form.name] if number(lens.get(key, 0.0), key) != 0]
        if beyond:
            raise InputError(
                f"A camera {form.name} was expected without {listed(beyond)}, for which the camera model {form.model} has no "
                "place; set these to 0 and process the photos again."
            )
        if form.name == _PANORAMA:
            return form.camera([], size, "the file")
        named = {key: number(lens.get(key, 0.0), key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
        if form.name == _FISHEYE624:
            given_terms = numbers(required(lens, _LIST, "the file"), (len(_TERMS),), _LIST).tolist()
            named = dict(zip(_TERMS, given_terms, strict=True))
        elif _LIST in lens:
            raise InputError(f"{_LIST} were expected of a camera {_FISHEYE624}, found those of {form.name}; give k1 and so on.")
        if "fl_x" not in lens and "camera_angle_x" in lens:
            across = number(lens["camera_angle_x"], "camera_angle_x")
            if not 0 < across < math.pi:
                raise InputError(f"camera_angle_x must be an angle above 0 and below pi, found {across:g}; correct it.")
            named["fx"] = 0.5 * size[0] / math.tan(0.5 * across)
        else:
            named["fx"] = number(required(lens, "fl_x", "the file"), "fl_x")
        named["fy"] = number(lens.get("fl_y", named["fx"]), "fl_y")
        for key, side in zip(("cx", "cy"), size, strict=True):
            named[key] = number(lens.get(key, side / 2), key) - _CENTRE
        return form.camera([named[key] for key in form.order or ()], size, "the file")

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((_, model),) = calibration.items()
        return {path: json_text(self.lens(model) | {FRAMES: []})}

    def lens(self, model: CameraModel) -> dict[str, Any]:
        """The keys of a camera; raises InputError where the format does not hold it."""
        form = self.exact_form(model)
        width, height = model.image_size
        keys: dict[str, Any] = {"camera_model": form.name, "w": width, "h": height}
        if form.name == _PANORAMA:
            return keys | {"fl_x": width / 2, "fl_y": float(height), "cx": width / 2, "cy": height / 2}
        values = dict(zip(form.order or (), form.values(model), strict=True))
        terms = [values.pop(term) for term in _TERMS] if form.name == _FISHEYE624 else []
        keys |= {_KEYS.get(ours, ours): value + (_CENTRE if ours in ("cx", "cy") else 0.0) for ours, value in values.items()}
        return keys | ({_LIST: terms} if terms else {})


def _lens_of(keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in keys.items() if key in _LENS and value is not None}
