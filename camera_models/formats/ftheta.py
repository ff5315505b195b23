"""NVIDIA's FTheta camera as JSON, as NCore, 3DGRUT and gsplat take it: a polynomial of the angle, with an affine matrix.

    p = A delta(theta) (x, y) / hypot(x, y) + principal_point,   A = [[c, d], [e, 1]],   theta = atan2(hypot(x, y), z)
    reference_poly ANGLE_TO_PIXELDIST    delta(theta) = a_0 + a_1 theta + ... + a_5 theta^5   (angle_to_pixeldist_poly)
    reference_poly PIXELDIST_TO_ANGLE    theta(delta) = b_0 + b_1 delta + ... + b_5 delta^5   (pixeldist_to_angle_poly)

The centre of the first pixel is (0, 0); x is right, y down, z forward. The polynomial that is not the reference is where tools
begin to invert the other, by steps of Newton: it is fitted when writing, and a note states its error. An odd a(theta) with d = e
= 0 is opencv-fisheye with k1 and k2; any other curve is read as the scaramuzza polynomial nearest to it, and a note states the
error. NCore documentation, "Sensor Models"; `FThetaCameraModel` of gsplat, which itself ends at 90 degrees off axis.
"""

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyval

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents, Nearly, left_out
from camera_models.formats.forms import Form
from camera_models.formats.inverse_polynomial import HARMLESS_PX, Inverse
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.nearest import nearest_polynomial
from camera_models.formats.transfer import seen_deg
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import mapping, number, numbers, required, text, written_as
from camera_models.opencv_fisheye import OpenCVFisheye
from camera_models.scaramuzza import Scaramuzza

FORWARD, BACKWARD = "ANGLE_TO_PIXELDIST", "PIXELDIST_TO_ANGLE"
POLYNOMIALS = {FORWARD: "angle_to_pixeldist_poly", BACKWARD: "pixeldist_to_angle_poly"}
_WRAPPED = ("camera_model_parameters", "parameters", "ftheta_param")
"""Keys under which files of NVIDIA's tools hold these parameters."""
_KEYS = ("resolution", "shutter_type", "external_distortion_parameters", "principal_point", "reference_poly",
         *POLYNOMIALS.values(), "max_angle", "linear_cde")  # fmt: skip
TERMS = 6
SAMPLES = 1000
SAME_ANGLE_RAD = 1e-9


class FTheta(CalibrationFormat):
    """FThetaCameraModelParameters as JSON."""

    NAME = "ftheta"
    TITLE = "FTheta"
    SUFFIXES = (".json",)
    TOGETHER = False
    KEEPS = frozenset({"max_angle_deg"})
    FORMS: ClassVar[tuple[Form, ...]] = (Form(FORWARD, "opencv-fisheye", ("fx", "fy", "cx", "cy", "k1", "k2")),)

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with one of the polynomials."""
        return path.suffix.lower() in self.SUFFIXES and any(f'"{key}"' in head for key in POLYNOMIALS.values())

    def nearly(self, calibration: Calibration) -> dict[str, Nearly]:
        """The second polynomial, where it is off."""
        inverses = {name: _inverse_of(calibration, name) for name in calibration}
        return {
            name: Nearly(f"second polynomial ({POLYNOMIALS[BACKWARD]})", inverse.off_px, inverse.angles_deg, begins=True)
            for name, inverse in inverses.items()
            if inverse.off_px > HARMLESS_PX
        }

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(read_json(path), "the file")
        outer = next((key for key in _WRAPPED if isinstance(data.get(key), dict)), None)
        keys = data if outer is None else mapping(data[outer], outer)
        if keys.get("external_distortion_parameters") is not None:
            raise InputError(
                "A camera without external distortion was expected, found one behind a windshield; no model here has it."
            )
        size = size_of(required(keys, "resolution", "the file"), "resolution")
        reference = text(keys.get("reference_poly", FORWARD), "reference_poly")
        if reference not in POLYNOMIALS:
            raise InputError(f"reference_poly must be one of {', '.join(POLYNOMIALS)}, found {reference}; correct it.")
        key = POLYNOMIALS[reference]
        given = required(keys, key, "the file")
        terms = len(given) if isinstance(given, list) and 2 <= len(given) <= TERMS else TERMS
        poly = np.pad(numbers(given, (terms,), key), (0, TERMS - terms))
        if not (poly[0] == 0 and poly[1] > 0):
            raise InputError(f"{key} must begin with 0 and a number above 0, found {poly[0]:g} and {poly[1]:g}; correct it.")
        centre = numbers(required(keys, "principal_point", "the file"), (2,), "principal_point")
        affine = numbers(keys.get("linear_cde", [1.0, 0.0, 0.0]), (3,), "linear_cde")
        if not affine[0] > 0 or abs(affine[0] - affine[1] * affine[2]) < 1e-6:
            raise InputError(f"linear_cde must have c above 0 and c - d e other than 0, found {affine.tolist()}; correct it.")
        end = number(keys.get("max_angle", math.pi), "max_angle")
        if not 0 < end <= math.pi:
            raise InputError(f"max_angle must be an angle above 0 and up to pi, found {end:g}; correct it.")
        odd = reference == FORWARD and not (poly[2] or poly[4] or affine[1] or affine[2])
        camera, notes = (
            (_fisheye(poly, affine[0], centre, size), ()) if odd else _nearest(reference, poly, affine, centre, size, end)
        )
        known = "max_angle" not in keys or abs(end - _max_angle(camera)) < SAME_ANGLE_RAD
        estimates = {} if known else {DEFAULT_NAME: CameraEstimate(max_angle_deg=math.degrees(end))}
        beside = [key for key in keys if key not in _KEYS] + [key for key in data if outer is not None and key != outer]
        if keys.get("shutter_type", "GLOBAL") != "GLOBAL":
            beside.append("shutter_type")
        return Content(Calibration({DEFAULT_NAME: camera}, estimates), (*notes, *left_out({"the file": beside})))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((name, model),) = calibration.items()
        self.exact_form(model)
        fx, fy, cx, cy = (model.named_parameters()[key] for key in ("fx", "fy", "cx", "cy"))
        keys: dict[str, Any] = {
            "resolution": list(model.image_size), "shutter_type": "GLOBAL", "external_distortion_parameters": None,
            "principal_point": [cx, cy], "reference_poly": FORWARD,
            POLYNOMIALS[BACKWARD]: _inverse_of(calibration, name).coefficients, POLYNOMIALS[FORWARD]: _forward(model),
            "max_angle": _end(calibration, name), "linear_cde": [fx / fy, 0.0, 0.0],
        }  # fmt: skip
        return {path: json_text(keys)}


def _forward(model: CameraModel) -> list[float]:
    """a_0 ... a_5 of an opencv-fisheye without k3 and k4."""
    fy, k1, k2 = (model.named_parameters()[key] for key in ("fy", "k1", "k2"))
    return [0.0, fy, 0.0, fy * k1, 0.0, fy * k2]


def _end(calibration: Calibration, name: str) -> float:
    """The angle off axis (rad) up to which a camera is used."""
    reach_deg = calibration.estimates.get(name, CameraEstimate()).max_angle_deg
    return _max_angle(calibration[name]) if reach_deg is None else math.radians(reach_deg)


def _inverse_of(calibration: Calibration, name: str) -> Inverse:
    """b_0 ... b_5, as near to the inverse of a_0 ... a_5 as their number allows, and how far from it (px)."""
    model = calibration[name]
    forward, end = _forward(model), min(_end(calibration, name), model.max_angle)
    theta = np.linspace(0.0, end, SAMPLES)[1:]
    delta = polyval(theta, forward)
    scale = float(delta.max())
    # theta / delta by a polynomial of the fourth degree: theta(0) = 0 exactly.
    fitted = Polynomial.fit(delta / scale, theta / delta, TERMS - 2, domain=[0.0, 1.0], window=[0.0, 1.0]).coef
    backward = [0.0, *(float(value) / scale**power for power, value in enumerate(fitted))]
    off_px = float(np.abs(polyval(polyval(delta, backward), forward) - delta).max())
    return Inverse(backward, off_px, (0.0, math.degrees(end)))


def _max_angle(model: CameraModel) -> float:
    """The angle off axis (rad) up to which a camera is used where nothing else is known: that of the farthest corner."""
    return min(math.radians(seen_deg(model)), model.max_angle)


def _fisheye(poly: Float[np.ndarray, "6"], c: float, centre: Float[np.ndarray, "2"], size: tuple[int, int]) -> OpenCVFisheye:
    fy = float(poly[1])
    fx = written_as(float(c), lambda value: value / fy, float(c) * fy)
    k1, k2 = (written_as(float(value), lambda k: k * fy, float(value) / fy) for value in (poly[3], poly[5]))
    return OpenCVFisheye([fx, fy, *centre.tolist(), k1, k2, 0.0, 0.0], size)


def _nearest(
    reference: str, poly: Float[np.ndarray, "6"], affine: Float[np.ndarray, "3"], centre: Float[np.ndarray, "2"],
    size: tuple[int, int], end: float,
) -> tuple[Scaramuzza, tuple[str, ...]]:  # fmt: skip
    """The scaramuzza polynomial of the same affine matrix nearest to a curve, and the error."""
    c, d, e = affine.tolist()
    inverse = np.linalg.inv([[c, d], [e, 1.0]])
    w, h = size
    corners = np.array([[0.0, 0.0], [w - 1.0, 0.0], [0.0, h - 1.0], [w - 1.0, h - 1.0]]) - centre
    delta, theta = _curve(reference, poly, float(np.linalg.norm(corners @ inverse.T, axis=1).max()), end)
    best, least = nearest_polynomial(delta, theta, affine, centre, size)
    return best, (
        f"The polynomial of the angle is read as the scaramuzza polynomial of degree {best.degree} nearest to it, up to "
        f"{math.degrees(theta[-1]):.1f} degrees off axis and within {least:.2g} px.",
    )


def _curve(
    reference: str, poly: Float[np.ndarray, "6"], reach_px: float, end: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """delta (px) and theta (rad) of rays, as far as the image reaches, the camera is used and both grow."""
    if reference == BACKWARD:
        delta = np.linspace(0.0, reach_px, SAMPLES + 1)[1:]
        theta = polyval(delta, poly)
    else:
        theta = np.linspace(0.0, end, SAMPLES + 1)[1:]
        delta = polyval(theta, poly)
    inside = (delta <= reach_px) & (theta <= end) & (np.diff(delta, prepend=0.0) > 0) & (np.diff(theta, prepend=0.0) > 0)
    stop = SAMPLES if inside.all() else int(np.argmin(inside))
    if stop < TERMS:
        raise InputError(
            "A polynomial that grows with the angle over the image was expected, found one that does not; correct it."
        )
    return delta[:stop], theta[:stop]
