"""CamOdoCal's camera YAML, which VINS-Mono, VINS-Fusion and their kin read, and KITTI-360's fisheyes have: one camera a file.

    model_type       our model          keys of the file
    PINHOLE          pinhole            k1 k2 p1 p2; fx fy cx cy
    PINHOLE_FULL     pinhole            k1 to k6, p1 p2; fx fy cx cy
    MEI              unified            xi; k1 k2 p1 p2; gamma1 gamma2 u0 v0
    KANNALA_BRANDT   opencv-fisheye     k2 k3 k4 k5 (those of theta^3 to theta^9); mu mv u0 v0

as cv2.FileStorage writes them. Which of mirror_parameters, distortion_parameters and projection_parameters a number stands in
differs between its users and does not matter here. Pixels are OpenCV's. L. Heng, B. Li, M. Pollefeys, CamOdoCal, IROS 2013.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import cv2

from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.opencv_storage import read_storage
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import mapping, number, required, text

MIRROR, DISTORTION, PROJECTION = "mirror_parameters", "distortion_parameters", "projection_parameters"
_RADTAN = {key: key for key in ("k1", "k2", "p1", "p2")}
_PINHOLE = {PROJECTION: {key: key for key in ("fx", "fy", "cx", "cy")}}
_MIDDLE = {"u0": "cx", "v0": "cy"}
_KEYS: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "PINHOLE": {DISTORTION: _RADTAN, **_PINHOLE},
    "PINHOLE_FULL": {DISTORTION: {**_RADTAN, **{key: key for key in ("k3", "k4", "k5", "k6")}}, **_PINHOLE},
    "MEI": {MIRROR: {"xi": "xi"}, DISTORTION: _RADTAN, PROJECTION: {"gamma1": "fx", "gamma2": "fy", **_MIDDLE}},
    "KANNALA_BRANDT": {
        PROJECTION: {**{f"k{k + 1}": f"k{k}" for k in range(1, 5)}, "mu": "fx", "mv": "fy", **_MIDDLE},
    },
}
"""model_type -> section -> key in the file -> our parameter."""
_SIZE = ("image_width", "image_height")
_READ = ("model_type", "camera_name", *_SIZE, MIRROR, DISTORTION, PROJECTION)


def _form(name: str, model: str, **options: int) -> Form:
    return Form(name, model, tuple(ours for section in _KEYS[name].values() for ours in section.values()), options=options)


class CamOdoCal(CalibrationFormat):
    """camera.yaml with a model_type."""

    NAME = "camodocal"
    TITLE = "CamOdoCal"
    SUFFIXES = (".yaml", ".yml")
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        _form("PINHOLE", "pinhole"),
        _form("PINHOLE_FULL", "pinhole", coefficients=8),
        _form("MEI", "unified"),
        _form("KANNALA_BRANDT", "opencv-fisheye"),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """The storage of OpenCV with a model_type and parameters, by CamOdoCal's names of these."""
        return path.suffix.lower() in self.SUFFIXES and "model_type:" in head and "_parameters:" in head

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = read_storage(path)
        form = self.form_named(text(required(data, "model_type", "the file"), "model_type"), "the file")
        given = _parameters(data)
        sections = _KEYS[form.name]
        values = [number(required(given, key, "the file"), key) for section in sections.values() for key in section]
        known = {key for section in sections.values() for key in section}
        beside = {"the file": [key for key in data if key not in _READ] + [key for key in given if key not in known]}
        sides = [data.get(key) for key in _SIZE]
        size = image_size if image_size is not None and None in sides else size_of(sides, " and ".join(_SIZE))
        return Content(Calibration({DEFAULT_NAME: form.camera(values, size, "the file")}), left_out(beside))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        (model,) = calibration.values()
        form, named = self.exact_form(model), model.named_parameters()
        storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write("model_type", form.name)
        storage.write("camera_name", "camera")
        for key, side in zip(_SIZE, model.image_size, strict=True):
            storage.write(key, int(side))
        for section, keys in _KEYS[form.name].items():
            storage.startWriteStruct(section, cv2.FILE_NODE_MAP)
            for key, ours in keys.items():
                storage.write(key, float(named[ours]))
            storage.endWriteStruct()
        return {path: storage.releaseAndGetString()}


def _parameters(data: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of all sections. Raises InputError where two hold one key."""
    found: dict[str, Any] = {}
    for section in (MIRROR, DISTORTION, PROJECTION):
        for key, value in mapping(data.get(section) or {}, section).items():
            if key in found:
                raise InputError(f"Each parameter was expected once, found {key} in two sections; remove one.")
            found[key] = value
    return found
