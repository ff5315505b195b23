"""ROS camera_info YAML: one camera a file, as `camera_calibration` writes it and as a dumped sensor_msgs/CameraInfo message.

    distortion_model                 distortion_coefficients
    plumb_bob                        k1 k2 p1 p2 k3
    rational_polynomial              k1 k2 p1 p2 k3 k4 k5 k6
    equidistant (melodic: fisheye)   k1 k2 k3 k4

Pixels are OpenCV's. R and P rectify an image; they say nothing of the camera, and are written as the identity and [K 0].
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents
from camera_models.formats.forms import Form
from camera_models.formats.opencv_cameras import check_matrix
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, number, required, text
from camera_models.formats.yaml_text import read_yaml, yaml_text
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_PLUMB_BOB = ("k1", "k2", "p1", "p2", "k3")
_ALIASES = {"fisheye": "equidistant"}
_MESSAGE = ("height", "width", "distortion_model", "binning_x", "binning_y", "roi", "header")
_FILE = (
    "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "camera_model", "distortion_coefficients",
    "rectification_matrix", "projection_matrix", *_MESSAGE, *"dkrpDKRP",
)  # fmt: skip


class RosCameraInfo(CalibrationFormat):
    """ost.yaml, camera_info.yaml."""

    NAME = "ros"
    TITLE = "ROS camera_info"
    SUFFIXES = (".yaml", ".yml")
    TOGETHER = False
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("plumb_bob", "pinhole", (*_K, *_PLUMB_BOB)),
        Form("rational_polynomial", "pinhole", (*_K, *_PLUMB_BOB, "k4", "k5", "k6"), options={"coefficients": 8}),
        Form("equidistant", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """A YAML file with the matrices of CameraInfo, not typed as OpenCV types them."""
        if path.suffix.lower() not in self.SUFFIXES or "opencv-matrix" in head:
            return False
        written = "camera_matrix:" in head and any(
            f"{key}:" in head for key in ("projection_matrix", "rectification_matrix", "distortion_model")
        )
        lines = {line.split(":")[0] for line in head.splitlines()}
        return written or ("distortion_model" in lines and ({"K", "P"} <= lines or {"k", "p"} <= lines))

    def names(self, calibration: Calibration) -> list[str]:
        """`camera_name`."""
        return list(calibration)

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(read_yaml(path), "the file")
        matrix = _matrix(data, "camera_matrix", "k", 9)
        if matrix is None:
            raise InputError(
                f"A ROS file has a camera_matrix (a message K), found none among {listed(data)}; read the file as what it is."
            )
        check_matrix(matrix, "the file")
        fx, skew, cx, _, fy, cy = matrix[:6]
        if not fx:
            raise InputError("The camera matrix must be that of a calibrated camera, found fx = 0; calibrate the camera first.")
        if min(fx, fy) <= 0:
            raise InputError(f"The camera matrix must have fx and fy above 0, found {fx:g} and {fy:g}; correct it.")
        name = text(data.get("distortion_model") or data.get("camera_model") or "plumb_bob", "distortion_model")
        form = self.form_named(_ALIASES.get(name, name), "the file")
        count = len(form.order or ()) - 4
        given = _matrix(data, "distortion_coefficients", "d", None) or []
        if any(given[count:]):
            raise InputError(
                f"{name} must have {count} coefficients, found more that are not zero ({listed(given)}); refit the camera."
            )
        # Trailing zeros are written by some tools and left out by others.
        values = [fx, fy, cx, cy, *(given + [0.0] * count)[:count]]
        camera = form.camera(values, _size(data, image_size), "the file")
        own = data.get("camera_name")
        called = DEFAULT_NAME if own in (None, "") else text(own, "camera_name")
        return Content(Calibration({called: camera}), tuple(_notes(data, matrix, skew)))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        ((name, model),) = calibration.items()
        form = self.exact_form(model)
        fx, fy, cx, cy, *coefficients = form.values(model)
        width, height = model.image_size
        data = {
            "image_width": width,
            "image_height": height,
            "camera_name": name,
            "camera_matrix": {"rows": 3, "cols": 3, "data": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]},
            "distortion_model": form.name,
            "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": coefficients},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]},
            "projection_matrix": {"rows": 3, "cols": 4, "data": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]},
        }
        return {path: yaml_text(data)}


def _matrix(data: Mapping[str, Any], key: str, letter: str, count: int | None) -> list[float] | None:
    """The numbers of a matrix, as a file (rows, cols, data) or a message (k or K) has it; None where it is absent."""
    value = data.get(key)
    if value is not None:
        value = required(mapping(value, key), "data", key)
    else:
        value = data.get(letter, data.get(letter.upper()))
    if value is None:
        return None
    numbers = [number(item, key) for item in items(value, key)]
    if count is not None and len(numbers) != count:
        raise InputError(f"{key} must hold {count} numbers, found {len(numbers)}; correct it.")
    return numbers


def _size(data: Mapping[str, Any], given: tuple[int, int] | None) -> tuple[int, int]:
    sides = [data.get("image_width", data.get("width")), data.get("image_height", data.get("height"))]
    if given is not None and not all(sides):
        return given
    return size_of(sides, "image_width and image_height")


def _notes(data: Mapping[str, Any], matrix: list[float], skew: float) -> list[str]:
    notes = []
    if skew:
        notes.append(f"The skew of {skew:g} px in the camera matrix is not kept: ROS and OpenCV do not use it.")
    rectification = _matrix(data, "rectification_matrix", "r", 9)
    projection = _matrix(data, "projection_matrix", "p", 12)
    identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    plain = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    if rectification not in (None, identity) or projection not in (None, plain):
        notes.append("Not kept: the rectification (rectification_matrix, projection_matrix).")
    if projection is not None and projection[3] and projection[0]:
        notes.append(f"Not kept: the baseline in the projection matrix, {-projection[3] / projection[0]:.6g} m.")
    roi = data.get("roi")
    cut = isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset", "width", "height"))
    if any(data.get(key, 0) not in (0, 1) for key in ("binning_x", "binning_y")) or cut:
        notes.append("Not kept: binning and region of interest; the camera is that of the full image.")
    beside = [key for key in data if key not in _FILE]
    if beside:
        notes.append(f"Not kept: {listed(beside)}.")
    return notes
