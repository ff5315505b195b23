"""Cameras as OpenCV's functions take them: K, D, for cv2.omnidir also xi."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.forms import Form
from camera_models.formats.values import LARGEST
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_BROWN = ("k1", "k2", "p1", "p2", "k3")
FISHEYE, OMNIDIR, PINHOLE = "fisheye", "omnidir", "rational"
FORMS = (
    Form("Brown-Conrady", "pinhole", (*_K, *_BROWN)),
    Form(PINHOLE, "pinhole", (*_K, *_BROWN, "k4", "k5", "k6"), options={"coefficients": 8}),
    Form(FISHEYE, "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
    Form(OMNIDIR, "unified", (*_K, "skew", "xi", "k1", "k2", "p1", "p2")),
)


def numbers_of(value: Any, where: str, count: int | None = None) -> list[float]:
    """The numbers of a matrix, row by row; raises InputError where it is none or has another number of them."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf" or (count is not None and value.size != count):
        expected = "a matrix" if count is None else f"a matrix of {count} numbers"
        shape = "none" if value is None else f"one of {value.size}" if isinstance(value, np.ndarray) else repr(value)
        raise InputError(f"{where} must be {expected}, found {shape}; correct it.")
    numbers: list[float] = value.astype(np.float64).ravel().tolist()
    if not (np.abs(numbers) <= LARGEST).all():
        raise InputError(f"{where} must hold finite numbers within reason, found {listed(numbers)}; correct it.")
    return numbers


def matrix_of(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """K."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def check_matrix(matrix: list[float], where: str) -> None:
    """Raises InputError where nine numbers are not those of K = [fx s cx; 0 fy cy; 0 0 1]."""
    if [matrix[3], *matrix[6:]] != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(
            f"The camera matrix of {where} must be fx s cx; 0 fy cy; 0 0 1, found {listed(f'{item:g}' for item in matrix)}; "
            "correct it."
        )


def kind_of(mark: Any, where: str) -> str:
    """Of fisheye_model, or one of models: 0 or 1."""
    if not isinstance(mark, int | float) or mark not in (0, 1):
        raise InputError(f"{where} must be 0 (Brown-Conrady) or 1 (cv2.fisheye), found {mark!r}; correct it.")
    return FISHEYE if mark else PINHOLE


def camera_of(
    kind: str, matrix: list[float], distortion: list[float], xi: float | None, size: tuple[int, int], *, where: str
) -> tuple[CameraModel, str | None]:
    """The camera of K and D, and a note; more coefficients than the model has must be zero, fewer are filled up with zeros."""
    form = next(form for form in FORMS if form.name == kind)
    check_matrix(matrix, where)
    fx, skew, cx, _, fy, cy = matrix[:6]
    count = 8 if kind == PINHOLE else 4
    if any(distortion[count:]):
        raise InputError(
            f"The distortion of {where} must have {count} coefficients, found {listed(distortion[count:])} beyond (thin-prism or "
            "tilt terms); calibrate without them."
        )
    full = (distortion + [0.0] * count)[:count]
    if kind == OMNIDIR:
        return form.camera([fx, fy, cx, cy, skew, xi or 0.0, *full], size, where), None
    note = f"The skew of {skew:g} px in the camera matrix of {where} is not kept: OpenCV takes it for zero." if skew else None
    return form.camera([fx, fy, cx, cy, *full], size, where), note


def size_of(sides: Any, given: tuple[int, int] | None) -> tuple[int, int]:
    """(width, height) of two numbers of a file, or what was given in its place where the file has none."""
    pair = [] if sides is None else np.ravel(np.asarray(sides, dtype=object)).tolist()
    if not pair or any(side is None for side in pair):
        if given is None:
            raise InputError("The file was expected to hold the size of the image, found none; give `image_size` WIDTHxHEIGHT.")
        return given
    whole = [side for side in pair if isinstance(side, int | float) and 1 <= side < 1e9 and side == int(side)]
    if len(pair) != 2 or len(whole) != 2:
        raise InputError(f"The size of the image must be two whole numbers of pixels, found {listed(pair)}; correct it.")
    return int(whole[0]), int(whole[1])


def unread(data: Mapping[str, Any], known: set[str]) -> tuple[str, ...]:
    """A note on the keys of a file that have no place here."""
    left = [key for key in data if key not in known]
    return (f"Not kept: {listed(left)}.",) if left else ()
