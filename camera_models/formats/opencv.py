"""OpenCV's files (YAML, XML or JSON of cv2.FileStorage): one camera, a pair, or a rig.

    one camera   image_width image_height camera_matrix distortion_coefficients (or K and D), as the sample camera_calibration
    two          M1 D1 M2 D2 R T (stereo_calib, its R and T also in extrinsics.yml beside), or camera_matrix_1 ... with rvec tvec
                 (omni_stereo_calibration); R, T and rvec, tvec take points of the first camera to the second
    more         as the app multiview_calibration, see `opencv_rig`

What tells the model: `xi` (xi_1, xi_2) is that of cv2.omnidir; `fisheye_model: 1`, as the sample writes, that of cv2.fisheye;
`fisheye_model: 0`, or any number of coefficients but four, is Brown-Conrady or rational. Four coefficients without a marker may
be either and are refused. The skew is read for cv2.omnidir only: the other functions of OpenCV take it for zero.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate
from camera_models.formats.contract import DEFAULT_NAME, CalibrationFormat, Content, Documents, is_folder
from camera_models.formats.forms import Form
from camera_models.formats.opencv_cameras import (
    FISHEYE,
    FORMS,
    OMNIDIR,
    PINHOLE,
    camera_of,
    kind_of,
    matrix_of,
    numbers_of,
    size_of,
    unread,
)
from camera_models.formats.opencv_rig import read_rig, rig_data
from camera_models.formats.opencv_storage import read_storage, storage_text
from camera_models.formats.rig_poses import pose_of_vectors, rig_of, rotation_of_matrix
from camera_models.pose import Pose

_MATRIX = ("camera_matrix", "K", "cameraMatrix", "M")
_DISTORTION = ("distortion_coefficients", "D", "distCoeffs", "dist_coeffs")
_MARKS = {"xi": ("xi",), "fisheye": ("fisheye_model",), "width": ("image_width",), "height": ("image_height",)}
_PAIR = {"R", "T", "rvec", "tvec"}
_RMS = "avg_reprojection_error"


class OpenCV(CalibrationFormat):
    """*.yml, *.xml."""

    NAME = "opencv"
    TITLE = "OpenCV"
    SUFFIXES = (".yml", ".yaml", ".xml", ".json")
    RIGS = True
    NEEDS_RIG = True
    KEEPS = frozenset({"rms_px_per_point"})
    FORMS: ClassVar[tuple[Form, ...]] = FORMS

    def recognises(self, path: Path, head: str) -> bool:
        """What cv2.FileStorage writes."""
        return path.suffix.lower() in self.SUFFIXES and ("opencv-matrix" in head or "<opencv_storage>" in head)

    def names(self, calibration: Calibration) -> list[str]:
        """`cam_ids` of more than two."""
        return list(calibration) if len(calibration) > 2 else super().names(calibration)

    def forms_at(self, path: Path, calibration: Calibration) -> tuple[Form, ...]:
        """Files of more than two cameras have no place for xi."""
        several = len(calibration) > 2 and not is_folder(path)
        return tuple(form for form in FORMS if form.name != OMNIDIR) if several else FORMS

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = read_storage(path)
        if "Ks" in data:
            return read_rig(data, image_size)
        numbered = _get(data, _MATRIX, "1") is not None
        suffixes = ("1", "2") if numbered else ("",)
        cameras: dict[str, CameraModel] = {}
        notes: list[str] = []
        for index, suffix in enumerate(suffixes):
            cameras[f"cam{index}"], note = _camera(data, suffix, image_size)
            notes += [note] if note else []
        rms = None if numbered else data.get(_RMS)
        estimates = {DEFAULT_NAME: CameraEstimate(rms_px_per_point=rms)} if isinstance(rms, float) else {}
        rig: dict[str, Pose] = {}
        if numbered:
            pose = _second_from_first(_with_extrinsics(path, data))
            rig = {} if pose is None else {DEFAULT_NAME: Pose.identity(), "cam1": pose}
        known = {key for suffix in suffixes for names in (_MATRIX, _DISTORTION, *_MARKS.values()) for key in _keys(names, suffix)}
        known |= {"fisheye_model", "image_width", "image_height", "image_size"} | (_PAIR if numbered else {_RMS})
        return Content(Calibration(cameras, estimates, rig_of(rig)), (*notes, *unread(data, known)))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        forms = [self.exact_form(model) for model in calibration.values()]
        if len(calibration) > 2:
            return {path: storage_text(rig_data(calibration, forms), path.suffix.lower())}
        data: dict[str, Any] = {}
        for index, (form, model) in enumerate(zip(forms, calibration.values(), strict=True)):
            data |= _camera_data(model, form, str(index + 1) if len(calibration) > 1 else "")
        if len(calibration) == 2:
            first, second = (calibration.rig[name].cam_from_rig for name in calibration)
            pose = second @ first.inverse()
            data |= {"R": pose.rotation.detach().numpy(), "T": pose.translation.detach().numpy()[:, None]}
        else:
            rms = calibration.estimates.get(next(iter(calibration)), CameraEstimate()).rms_px_per_point
            data |= {} if rms is None else {_RMS: rms}
        return {path: storage_text(data, path.suffix.lower())}


def _keys(names: tuple[str, ...], suffix: str) -> list[str]:
    return [f"{name}{mark}{suffix}" for name in names for mark in (("", "_") if suffix else ("",))]


def _get(data: Mapping[str, Any], names: tuple[str, ...], suffix: str) -> Any:
    return next((data[key] for key in _keys(names, suffix) if data.get(key) is not None), None)


def _camera(data: Mapping[str, Any], suffix: str, image_size: tuple[int, int] | None) -> tuple[CameraModel, str | None]:
    where = f"camera {suffix}" if suffix else "the camera"
    matrix = numbers_of(_get(data, _MATRIX, suffix), f"camera_matrix of {where}", 9)
    distortion = numbers_of(_get(data, _DISTORTION, suffix), f"distortion_coefficients of {where}")
    # Both cameras of a pair may share a marker and a size.
    xi, fisheye, width, height = (_get(data, names, suffix) or data.get(names[0]) for names in _MARKS.values())
    if _get(data, _MARKS["fisheye"], suffix) == 0:
        fisheye = 0
    if xi is not None:
        kind = OMNIDIR
    elif fisheye is not None:
        kind = kind_of(fisheye, f"fisheye_model of {where}")
    elif len(distortion) == 4:
        raise InputError(
            f"Four distortion coefficients were expected with a key that tells whether they are of a fisheye, found none for "
            f"{where}; add fisheye_model: 1 for cv2.fisheye or fisheye_model: 0 for Brown-Conrady."
        )
    else:
        kind = PINHOLE
    size = size_of(data.get("image_size") if width is None or height is None else [width, height], image_size)
    return camera_of(
        kind, matrix, distortion, None if xi is None else numbers_of(np.asarray(xi), f"xi of {where}", 1)[0], size, where=where
    )


def _with_extrinsics(path: Path, data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The file that says where the second camera stands: this one, or extrinsics.yml beside intrinsics.yml."""
    beside = path.with_name(path.name.replace("intrinsics", "extrinsics"))
    return data if _PAIR & data.keys() or beside == path or not beside.is_file() else read_storage(beside)


def _second_from_first(data: Mapping[str, Any]) -> Pose | None:
    translation, rotation = data.get("T", data.get("tvec")), data.get("R", data.get("rvec"))
    if translation is None and rotation is None:
        return None
    if translation is None or rotation is None:
        found = "T without R" if rotation is None else "R without T"
        raise InputError(
            f"Where the second camera stands was expected as R and T, found {found}; add the other or leave both out."
        )
    t = numbers_of(translation, "T", 3)
    if np.size(rotation) == 3:
        return pose_of_vectors(numbers_of(rotation, "rvec"), t)
    return Pose.of(rotation_of_matrix(np.reshape(numbers_of(rotation, "R", 9), (3, 3)), "R"), np.array(t))


def _camera_data(model: CameraModel, form: Form, suffix: str) -> dict[str, Any]:
    fx, fy, cx, cy, *rest = form.values(model)
    mark = f"_{suffix}" if suffix else ""
    width, height = model.image_size
    data: dict[str, Any] = {f"image_width{mark}": width, f"image_height{mark}": height}
    skew = 0.0
    if form.name == OMNIDIR:
        skew, data[f"xi{mark}"], *rest = rest
    else:
        data[f"fisheye_model{mark}"] = int(form.name == FISHEYE)
    data[f"M{suffix}" if suffix else "camera_matrix"] = matrix_of(fx, fy, cx, cy, skew)
    # cv2.omnidir takes a row; cv2.fisheye takes, and cv2.calibrateCamera gives, a column.
    column = np.array(rest)[:, None]
    data[f"D{suffix}" if suffix else "distortion_coefficients"] = column.T if form.name == OMNIDIR else column
    return data
