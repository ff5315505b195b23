"""lensfun's database of lenses as XML; the equations of a lens are in `lensfun_lens`.

    rectilinear, with poly5 or acm    pinhole           one focal length; k1 k2, or with acm k1 k2 p1 p2 k3
    fisheye, with poly5 or acm        opencv-fisheye    one focal length; k1 k2, or with acm k1 k2 k3

Any other projection and polynomial is read as the scaramuzza polynomial nearest to it, and a note states the error. A file has no
place for the size of the image: ours stands in a comment, and all others need `image_size`. Nor is there one for a sensor without
its size in mm: focal lengths are written as those of crop factor 1. acm, which lensfun 0.3 does not know, is not fitted.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar
from xml.sax.saxutils import escape

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents, left_out
from camera_models.formats.disk import read_text
from camera_models.formats.forms import Form
from camera_models.formats.lensfun_lens import FISHEYE, RECTILINEAR, TERMS, Sensor, cameras_of_lens
from camera_models.formats.nearest import Fit
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import of_text
from camera_models.formats.xml_text import read_xml
from camera_models.wording import listed

_SIZE = re.compile(r"<!-- images of (\S+) x (\S+) px")
_CURVE = ("distortion", "real-focal-length")
_ACM = "acm"


class Lensfun(CalibrationFormat):
    """A file with a <lensdatabase>."""

    NAME = "lensfun"
    TITLE = "lensfun"
    SUFFIXES = (".xml",)
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form(RECTILINEAR, "pinhole", ("f", "cx", "cy")),
        Form(f"{RECTILINEAR} poly5", "pinhole", ("f", "cx", "cy", "k1", "k2")),
        Form(f"{RECTILINEAR} {_ACM}", "pinhole", ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
        Form(FISHEYE, "opencv-fisheye", ("f", "cx", "cy")),
        Form(f"{FISHEYE} poly5", "opencv-fisheye", ("f", "cx", "cy", "k1", "k2")),
        Form(f"{FISHEYE} {_ACM}", "opencv-fisheye", ("f", "cx", "cy", "k1", "k2", "k3")),
    )

    def forms_at(self, path: Path, calibration: Calibration) -> tuple[Form, ...]:
        """acm only where nothing else holds a camera exactly: lensfun 0.3 does not know it, so none is fitted by it."""
        exact = [self.form_of(model) for model in calibration.values()]
        return tuple(form for form in self.FORMS if not form.name.endswith(_ACM) or form in exact)

    def recognises(self, path: Path, head: str) -> bool:
        """XML with the root of the database."""
        return path.suffix.lower() in self.SUFFIXES and "<lensdatabase" in head

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        content = read_text(path)
        root = read_xml(content, path)
        if root.tag != "lensdatabase":
            raise InputError(f"A <lensdatabase> was expected, found <{root.tag}>; give a file of lensfun's database.")
        said = _SIZE.search(content)
        size = _size(said.groups()) if said else image_size
        if size is None:
            raise InputError("lensfun's files do not say how large images are, and none was given; give `image_size`.")
        cameras: dict[str, CameraModel] = {}
        fits: dict[str, Fit] = {}
        refused: dict[str, str] = {}
        for lens in root.iter("lens"):
            name = next((child.text or "" for child in lens.findall("model") if not child.get("lang")), "").strip() or "a lens"
            try:
                found = cameras_of_lens(lens, size)
            except InputError as error:
                refused.setdefault(name, str(error))
                continue
            for focal, (camera, fit) in found.items():
                called = _free(f"{name} at {focal:g} mm", cameras)
                cameras[called] = camera
                fits |= {called: fit} if fit else {}
        if not cameras:
            _, reason = next(iter(refused.items()), ("", "A <lens> was expected, found none; give a file with lenses."))
            raise InputError(reason)
        if len(cameras) == 1:
            cameras = {DEFAULT_NAME: next(iter(cameras.values()))}
            fits = dict.fromkeys([DEFAULT_NAME] * len(fits), next(iter(fits.values()), Fit(0.0, 0.0)))
        beside = dict.fromkeys(part.tag for lens in root.iter("calibration") for part in lens if part.tag not in _CURVE)
        estimates = {name: CameraEstimate(max_angle_deg=fit.upto_deg) for name, fit in fits.items()}
        return Content(Calibration(cameras, estimates), (*_notes(fits, refused), *left_out({"the lenses": beside})))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((name, model),) = calibration.items()
        form = self.exact_form(model)
        values = dict(zip(form.order or (), form.values(model), strict=True))
        w, h = model.image_size
        short, long = sorted(max(side - 1, 1) for side in (w, h))
        sensor = Sensor(1.0, long / short, (w, h))
        projection, _, kind = form.name.partition(" ")
        focal = values["f"] / sensor.px_per_mm
        square = (sensor.unit_px / values["f"]) ** 2
        # As the reader has them, so that what was read is written again.
        scale = {"k1": square, "k2": square * square} if kind == "poly5" else {}
        ours = ("k1", "k2") if kind == "poly5" else ("k1", "k2", "k3", "p1", "p2")
        terms = {key: values.get(own, 0.0) * scale.get(own, 1.0) for key, own in zip(TERMS[kind or "none"], ours, strict=False)}
        centre = {key: sensor.off_centre(values[f"c{key}"], (side - 1) / 2) for key, side in (("x", w), ("y", h))}
        label = f"<maker>omnilines</maker><model>{escape(name)}</model><mount>omnilines</mount><cropfactor>1</cropfactor>"
        curve = f"    <calibration><distortion{_said({'model': kind, 'focal': focal} | terms)}/></calibration>"
        lines = [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f"<!-- images of {w} x {h} px; focal lengths are those of crop factor 1 (36 x 24 mm, by the diagonal) -->",
            f"<lensdatabase{_said({'version': 2 if kind == _ACM else 1})}>",
            f"  <camera>{label}</camera>",
            f"  <lens>{label}",
            f"    <focal{_said({'value': focal})}/><type>{projection}</type><aspect-ratio>{sensor.aspect}</aspect-ratio>",
            f"    <center{_said(centre)}/>",
            *([curve] if kind else []),
            "  </lens>",
            "</lensdatabase>",
            "",
        ]
        return {path: "\n".join(lines)}


def _size(sides: Sequence[str]) -> tuple[int, int]:
    try:
        return size_of([of_text(side, int) for side in sides], "images of")
    except ValueError:
        raise InputError(f"Whole numbers were expected in the comment `images of`, found {listed(sides)}; correct it.") from None


def _said(attributes: Mapping[str, object]) -> str:
    return "".join(f' {key}="{value}"' for key, value in attributes.items())


def _notes(fits: Mapping[str, Fit], refused: Mapping[str, str]) -> list[str]:
    notes = []
    if fits:
        widest = max(fit.upto_deg for fit in fits.values())
        notes.append(
            f"The curve of {listed(fits)} is read as the scaramuzza polynomial nearest to it, up to {widest:.1f} degrees off "
            f"axis and within {max(fit.off_px for fit in fits.values()):.2g} px."
        )
    if refused:
        notes.append(f"Left out: {listed(refused)}; of the first: {next(iter(refused.values()))}")
    return notes


def _free(name: str, taken: Mapping[str, CameraModel]) -> str:
    """A name that no camera has yet."""
    return next(other for other in (name, *(f"{name} ({index})" for index in range(2, len(taken) + 3))) if other not in taken)
