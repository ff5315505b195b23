"""One lens of lensfun's database: for each focal length a projection and a polynomial of the radius.

    rectilinear g = tan t    fisheye g = t    stereographic g = 2 tan(t / 2)    equisolid g = 2 sin(t / 2)
    orthographic g = sin t   fisheye_thoby g = 1.47 sin(0.713 t)                t: the angle off axis
    R = F g / q0,    r = R (q0 + q1 R + q2 R^2 + q3 R^3 + q4 R^4)
    poly3   q0 = 1 - k1, q2 = k1        ptlens   q0 = 1 - a - b - c, q1 = c, q2 = b, q3 = a
    poly5   q0 = 1, q2 = k1, q4 = k2    acm      Brown-Conrady in units of F: k1, k2, k3, and k4, k5 = p1, p2 of OpenCV

r and R have the unit H, half the shorter side of the sensor on which the lens was measured. F, the focal length in the middle of
the image, is `real-focal`, else the nominal one times q0. Crop factor and aspect ratio say what H is in mm, and the size of the
image what it is in pixels: the diagonal of a sensor is 43.27 mm / crop factor, and reaches from the middle of the first pixel to
that of the last, as in lensfun 0.3 (its later versions count to their outer edges, a difference of 1 / width in scale). lensfun
manual, "Lens calibration data format", "lfDistortionModel"; its sources, `modifier.cpp` and `mod-coord.cpp`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.nearest import Fit, nearest_lens
from camera_models.formats.values import number, of_text, written_as
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.pinhole import Pinhole
from camera_models.wording import listed

RECTILINEAR, FISHEYE = "rectilinear", "fisheye"
_FULL_FRAME_MM = math.hypot(36.0, 24.0)
_ASPECT = 1.5
"""Of a sensor whose aspect ratio the file leaves out."""
_PROJECTIONS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
    RECTILINEAR: (np.tan, math.pi / 2),
    FISHEYE: (lambda t: t, math.pi),
    "stereographic": (lambda t: 2 * np.tan(t / 2), math.pi),
    "equisolid": (lambda t: 2 * np.sin(t / 2), math.pi),
    "orthographic": (np.sin, math.pi / 2),
    "fisheye_thoby": (lambda t: 1.47 * np.sin(0.713 * t), math.pi / 2 / 0.713),
}
"""Radius over focal length of an angle off axis (rad), and where it ends."""
TERMS = {"none": (), "poly3": ("k1",), "poly5": ("k1", "k2"), "ptlens": ("a", "b", "c"), "acm": ("k1", "k2", "k3", "k4", "k5")}
_FOCAL_MM = (0.001, 1e6)
_LARGEST_PX = 10**9
_LEAST_SLOPE = 1e-3
"""Of a curve in the middle of the image."""
_SAMPLES = 500
_FEWEST = 12
"""Points of a curve that tell a polynomial."""


@dataclass(frozen=True)
class Sensor:
    """Where a lens was measured, and what that is in the pixels of an image."""

    crop: float
    aspect: float
    size: tuple[int, int]
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def px_per_mm(self) -> float:
        return self._diagonal_px * self.crop / _FULL_FRAME_MM

    @property
    def unit_px(self) -> float:
        """H."""
        return self._diagonal_px / math.hypot(self.aspect, 1.0) / 2

    @property
    def centre_px(self) -> tuple[float, float]:
        (x, half_w), (y, half_h) = zip(self.centre, ((min(side, _LARGEST_PX) - 1) / 2 for side in self.size), strict=True)
        cx = written_as(x, lambda px: self.off_centre(px, half_w), half_w + x * self.unit_px)
        return cx, written_as(y, lambda px: self.off_centre(px, half_h), half_h + y * self.unit_px)

    def off_centre(self, px: float, half: float) -> float:
        """`<center>` of a coordinate of the principal point."""
        return (px - half) / self.unit_px

    @property
    def _diagonal_px(self) -> float:
        # A comment may hold an integer of any length; what no image has is refused with the cameras.
        return max(math.hypot(*(min(side, _LARGEST_PX) - 1 for side in self.size)), 1.0)


def cameras_of_lens(lens: Element, size: tuple[int, int]) -> dict[float, tuple[CameraModel, Fit | None]]:
    """Focal length (mm) -> the camera, and how near it is where it was fitted."""
    kind = (lens.findtext("type") or RECTILINEAR).strip()
    if kind not in _PROJECTIONS:
        raise InputError(f"The type of a lens must be one of {listed(_PROJECTIONS)}, found {kind}; no model here has it.")
    found: dict[float, tuple[CameraModel, Fit | None]] = {}
    for calibration in lens.findall("calibration"):
        real = {_number(part, "focal"): _number(part, "real-focal") for part in calibration.findall("real-focal-length")}
        for part in calibration.findall("distortion"):
            focal = _number(part, "focal")
            model = part.get("model", "none")
            if model not in TERMS:
                raise InputError(f"The model of a distortion must be one of {listed(TERMS)}, found {model}; correct it.")
            terms = [_number(part, key) if part.get(key) is not None else 0.0 for key in TERMS[model]]
            stated = _number(part, "real-focal") if part.get("real-focal") is not None else real.get(focal)
            found[focal] = _camera(kind, model, terms, focal, stated, _sensor(lens, calibration, size))
    fixed = lens.find("focal")
    if not found and fixed is not None and fixed.get("value"):
        focal = _number(fixed, "value")
        found[focal] = _camera(kind, "none", [], focal, None, _sensor(lens, lens, size))
    if not found:
        raise InputError("A <distortion> or a fixed <focal> of the lens was expected, found neither; add one.")
    return found


def _sensor(lens: Element, calibration: Element, size: tuple[int, int]) -> Sensor:
    # Newer files say it with each calibration.
    crop = calibration.get("cropfactor") or lens.findtext("cropfactor") or ""
    wide, _, high = (calibration.get("aspect-ratio") or lens.findtext("aspect-ratio") or str(_ASPECT)).partition(":")
    divisor = _value(high, "aspect-ratio") if high else 1.0
    aspect = _value(wide, "aspect-ratio") / divisor if divisor else 0.0
    factor = _value(crop, "cropfactor")
    if not (0.01 <= factor <= 100 and 1 <= aspect <= 100):
        raise InputError(
            f"A cropfactor of 0.01 to 100 and an aspect-ratio of 1 to 100 were expected, found {factor:g} and {aspect:g}; "
            "correct them."
        )
    middle = lens.find("center")
    centre = (0.0, 0.0) if middle is None else (_number(middle, "x"), _number(middle, "y"))
    return Sensor(factor, aspect, size, centre)


def _camera(
    kind: str, model: str, terms: Sequence[float], nominal: float, real: float | None, sensor: Sensor
) -> tuple[CameraModel, Fit | None]:
    """The camera of a nominal and, where it is known, a real focal length (mm); how near it is where it was fitted."""
    q = _polynomial(model, terms)
    focal = q[0] * nominal if real is None else real
    if not (q[0] > _LEAST_SLOPE and _FOCAL_MM[0] <= focal <= _FOCAL_MM[1]):
        raise InputError(
            f"A lens must have a focal length of {_FOCAL_MM[0]:g} to {_FOCAL_MM[1]:g} mm and a curve that grows in the middle, "
            f"found {focal:g} mm and a slope of {q[0]:g}; correct its terms."
        )
    f = written_as(focal, lambda px: px / sensor.px_per_mm, focal * sensor.px_per_mm)
    cx, cy = sensor.centre_px
    named = {"fx": f, "fy": f, "cx": cx, "cy": cy}
    targets: dict[str, type[Pinhole] | type[OpenCVFisheye]] = {RECTILINEAR: Pinhole, FISHEYE: OpenCVFisheye}
    target = targets.get(kind)
    if model == "acm":
        if target is None or (target is OpenCVFisheye and any(terms[3:])):
            raise InputError(f"The model acm was expected with a {RECTILINEAR} lens, found {kind}; no model here has it.")
        ours = dict(zip(("k1", "k2", "k3", "p1", "p2"), terms, strict=True))
        named |= ours if target is Pinhole else {key: ours[key] for key in ("k1", "k2", "k3")}
    elif target is None or q[1] or q[3]:
        return _fitted(kind, q, f, sensor)
    else:
        # r = (F / H) g (1 + k1 g^2 + k2 g^4)
        square = (sensor.unit_px * q[0] / f) ** 2
        second, fourth = square * q[0], square * square * q[0]
        named["k1"] = written_as(q[2], lambda k: k * second, q[2] / second)
        named["k2"] = written_as(q[4], lambda k: k * fourth, q[4] / fourth)
    return target.from_mapping(named, sensor.size), None


def _polynomial(model: str, terms: Sequence[float]) -> list[float]:
    """q0 to q4; 1 for acm, whose terms are not of this polynomial."""
    if model == "poly3":
        return [1.0 - terms[0], 0.0, terms[0], 0.0, 0.0]
    if model == "poly5":
        return [1.0, 0.0, terms[0], 0.0, terms[1]]
    if model == "ptlens":
        a, b, c = terms
        return [1.0 - a - b - c, c, b, a, 0.0]
    return [1.0, 0.0, 0.0, 0.0, 0.0]


def _fitted(kind: str, q: list[float], f: float, sensor: Sensor) -> tuple[CameraModel, Fit]:
    """The scaramuzza polynomial nearest to the curve of a lens, as far as the image reaches and the curve grows."""
    projection, end = _PROJECTIONS[kind]
    centre = np.array(sensor.centre_px)
    w, h = sensor.size
    corners = np.array([[0.0, 0.0], [w - 1.0, 0.0], [0.0, h - 1.0], [w - 1.0, h - 1.0]]) - centre
    reach_px = float(np.hypot(*corners.T).max())

    def grows(to: float) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Radii in pixels and the angles up to `to`, as far as the image reaches and radii grow."""
        theta = np.linspace(0.0, to, _SAMPLES + 2)[1:-1]
        radius = f / sensor.unit_px / q[0] * projection(theta)
        rho = sensor.unit_px * radius * polyval(radius, q)
        inside = (rho <= reach_px) & (np.diff(rho, prepend=0.0) > 0)
        stop = _SAMPLES if inside.all() else int(np.argmin(inside))
        if stop < _FEWEST:
            raise InputError("A curve that grows with the angle was expected, found one that does not; correct its terms.")
        return rho[:stop], theta[:stop]

    # A long lens fills few of the angles at first.
    rho, theta = grows(min(end, 2 * float(grows(end)[1][-1])))
    return nearest_lens(rho, theta, centre, sensor.size)


def _number(element: Element, key: str) -> float:
    return _value(element.get(key) or "", key)


def _value(text: str, key: str) -> float:
    try:
        return number(of_text(text), key)
    except ValueError:
        raise InputError(f"{key} must be a number, found '{text[:80]}'; correct it.") from None
