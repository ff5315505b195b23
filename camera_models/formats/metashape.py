"""Agisoft Metashape's camera calibration (Tools, Camera Calibration, Save): one camera in XML. Read are those of the sensors
in its XML of cameras (File, Export, Export Cameras) too, the adjusted ones.

    frame        pinhole           x = X / Z, y = Y / Z
    fisheye      opencv-fisheye    (x, y) = theta (cos phi, sin phi), the angles of the bearing off and about the axis
    spherical    equirectangular

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y,   y' likewise with p1 and p2 exchanged
    u = w / 2 + cx + f x' + b1 x' + b2 y',   v = h / 2 + cy + f y'

The upper left corner of the image is (0, 0) there. p1 and p2 are OpenCV's p2 and p1. Metashape User Manual, appendix
"Camera models".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import DEFAULT_NAME, HAS_POSES, CalibrationFormat, Content, Documents
from camera_models.formats.disk import read_text
from camera_models.formats.forms import Form
from camera_models.formats.metashape_lens import nearest_metashape
from camera_models.formats.nearest import Nearest, told
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import number, of_text
from camera_models.formats.xml_text import read_xml
from camera_models.wording import listed

_FRAME, _FISHEYE, _SPHERICAL = "frame", "fisheye", "spherical"
_CENTRE = 0.5
"""Of the first pixel, in Metashape."""
_TERMS = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_NO_PLACE = {_FRAME: ("k4", "p3", "p4"), _FISHEYE: ("b2", "p1", "p2", "p3", "p4"), _SPHERICAL: _TERMS}
"""Terms that our model of a projection has not: with these, the nearest camera is read."""
_SIZE = ("width", "height")


class Metashape(CalibrationFormat):
    """An XML file with the root `calibration`, or `document`."""

    NAME = "metashape"
    TITLE = "Metashape"
    SUFFIXES = (".xml",)
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form(_FRAME, "pinhole", ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3")),
        Form(_FISHEYE, "opencv-fisheye", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
        Form(_SPHERICAL, "equirectangular", ()),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """XML with Metashape's keys."""
        own = "<projection>" in head or ("<document" in head and "<sensor" in head)
        return path.suffix.lower() in self.SUFFIXES and "<calibration" in head and own

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        root = read_xml(read_text(path), path)
        if root.tag == "document":
            return self._of_sensors(root)
        if root.tag != "calibration":
            raise InputError(
                f"{path} was expected to hold a <calibration>, found <{root.tag}>; save the calibration in Metashape."
            )
        keys = _texts(root)
        if "projection" not in keys:
            raise InputError("The key projection is missing in the file; add it.")
        beside = [key for key in keys if key not in ("projection", "f", "date", *_SIZE, *_TERMS)]
        return _content({DEFAULT_NAME: self._camera(keys)}, (f"Not kept: {listed(beside)}.",) if beside else ())

    def _of_sensors(self, root: ElementTree.Element) -> Content:
        cameras: dict[str, CameraModel | Nearest] = {}
        labels: dict[str, str] = {}
        for sensor in root.iter("sensor"):
            found = sensor.findall("calibration")
            best = next((one for one in found if one.get("class") == "adjusted"), found[0] if found else None)
            if best is None:
                continue
            size = best.find("resolution") if best.find("resolution") is not None else sensor.find("resolution")
            sides = {} if size is None else {key: size.get(key, "") for key in _SIZE}
            kind = best.get("type") or sensor.get("type") or _FRAME
            name = f"cam{len(cameras)}"
            cameras[name] = self._camera({"projection": kind, **sides} | _texts(best))
            labels[name] = sensor.get("label") or sensor.get("id") or ""
        if not cameras:
            raise InputError("Sensors with a calibration were expected, found none; align the photos in Metashape first.")
        told = listed(f"{name} is {label}" for name, label in labels.items())
        return _content(cameras, (f"Sensors in the file: {told}.", HAS_POSES) if len(cameras) > 1 else (HAS_POSES,))

    def _camera(self, keys: Mapping[str, str]) -> CameraModel | Nearest:
        form = self.form_named(keys["projection"], "the file")
        numbers = {key: _number(keys, key) for key in (*_SIZE, "f", *_TERMS)}
        sides = [int(side) if side == int(side) else side for side in (numbers[key] for key in _SIZE)]
        size = size_of(sides, "width and height")
        beyond = [key for key in _NO_PLACE[form.name] if numbers[key] != 0]
        if form.name == _SPHERICAL and beyond:
            raise InputError(f"A spherical camera was expected without {listed(beyond)}; hold these at 0 in Metashape.")
        named = {} if form.name == _SPHERICAL else _pixels(numbers, size)
        if beyond:
            if not numbers["f"] > 0:
                raise InputError(f"f must be above 0, found {numbers['f']:g}; correct it.")
            return nearest_metashape(numbers, (named["cx"], named["cy"]), size, form.name == _FISHEYE)
        return form.camera([named[key] for key in form.order or ()], size, "the file")

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((_, model),) = calibration.items()
        form = self.exact_form(model)
        width, height = model.image_size
        keys: dict[str, Any] = {"projection": form.name, "width": width, "height": height}
        if form.name != _SPHERICAL:
            keys |= _terms(model)
        lines = [f"  <{key}>{value}</{key}>" for key, value in keys.items()]
        return {path: "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', "<calibration>", *lines, "</calibration>", ""])}


def _content(found: Mapping[str, CameraModel | Nearest], notes: tuple[str, ...]) -> Content:
    cameras, estimates, near = told(found)
    return Content(Calibration(cameras, estimates), (*near, *notes))


def _texts(calibration: ElementTree.Element) -> dict[str, str]:
    """The text of each element of a calibration; a resolution has none."""
    return {leaf.tag: leaf.text.strip() for leaf in calibration if leaf.text and leaf.text.strip()}


def _number(keys: Mapping[str, str], key: str) -> float:
    if key not in keys and key in _TERMS:
        return 0.0
    if key == "f" and keys["projection"] == _SPHERICAL:
        return 0.0
    if key not in keys:
        raise InputError(f"The key {key} is missing in the file; add it.")
    try:
        return number(of_text(keys[key]), key)
    except ValueError:
        raise InputError(f"{key} must be a number, found '{keys[key][:80]}'; correct it.") from None


def _pixels(terms: Mapping[str, float], size: tuple[int, int]) -> dict[str, float]:
    """Our parameters of Metashape's."""
    f, b1 = terms["f"], terms["b1"]
    named = {key: terms[key] for key in ("k1", "k2", "k3", "k4")}
    named |= {"fx": f + b1, "fy": f, "skew": terms["b2"], "p1": terms["p2"], "p2": terms["p1"]}
    return named | {key: terms[key] + side / 2 - _CENTRE for key, side in zip(("cx", "cy"), size, strict=True)}


def _terms(model: CameraModel) -> dict[str, float]:
    """Metashape's parameters of ours; those that are 0 are left out, as Metashape does."""
    ours = model.named_parameters()
    fx, fy = ours["fx"], ours["fy"]
    named = {"f": fy} | {key: ours[key] - side / 2 + _CENTRE for key, side in zip(("cx", "cy"), model.image_size, strict=True)}
    named |= {"b1": fx - fy, "b2": ours.get("skew", 0.0)}
    named |= {key: ours.get(key, 0.0) for key in ("k1", "k2", "k3")}
    if model.NAME == "opencv-fisheye":
        named["k4"] = ours["k4"]
    named |= {"p1": ours.get("p2", 0.0), "p2": ours.get("p1", 0.0)}
    return {key: value for key, value in named.items() if value != 0 or key == "f"}
