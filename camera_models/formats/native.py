"""`calibration.yaml`, the project's own format of calibrations, version 1.

    calibration = load("calibration.yaml")        # mapping of camera name to model; .estimates .rig .views .provenance
    save("calibration.yaml", calibration)

Required of a camera are `model`, `image_size` and `parameters`; all else is optional. Keys that are not of the format are
ignored. Parameters and all other numbers come back to the bit; rotations do once they have been through a file.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float

import camera_models
from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate, RigCamera, ViewRecord
from camera_models.formats.camera_check import check_cameras
from camera_models.formats.contract import CalibrationFormat, Content, Documents
from camera_models.formats.disk import write_atomically
from camera_models.formats.forms import Form
from camera_models.formats.quaternions import quaternion_for_file, rotation_from_file
from camera_models.formats.values import (
    default,
    image_name,
    image_size,
    items,
    mapping,
    number,
    numbers,
    optional_number,
    required,
    text,
    whole,
)
from camera_models.formats.yaml_text import read_yaml, yaml_text
from camera_models.pose import Pose
from camera_models.typed import typed

FORMAT = "omnilines-calibration"
VERSION = 1

__all__ = ["FORMAT", "VERSION", "Calibration", "CameraEstimate", "RigCamera", "ViewRecord", "calibration_text", "load", "save"]


def load(path: str | Path) -> Calibration:
    """The calibration in a file; raises InputError with the file, the key and what was expected there."""
    if not isinstance(path, str | Path):
        raise InputError(f"The path of a calibration file was expected, found {type(path).__name__}; give a path.")
    data = read_yaml(path)
    try:
        calibration = _calibration(data)
        check_cameras(calibration)
        return calibration
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@typed
def save(path: str | Path, calibration: Mapping[str, CameraModel]) -> None:
    """Write a calibration, or a plain mapping of camera name to model; the file is replaced in one step.

    Raises InputError where a number is NaN or infinite (an unknown one is None), a camera is none that `load` takes, an image's
    name is none inside a folder, or the file cannot be written; the file that was there is then untouched.
    """
    entire = calibration if isinstance(calibration, Calibration) else Calibration(dict(calibration))
    check_cameras(entire)
    write_atomically(path, calibration_text(entire))


def calibration_text(calibration: Mapping[str, CameraModel]) -> str:
    """What `save` writes."""
    entire = calibration if isinstance(calibration, Calibration) else Calibration(dict(calibration))
    data: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "cameras": {name: _camera_data(model, entire.estimates.get(name)) for name, model in entire.items()},
    }
    if entire.rig:
        data["rig"] = {
            name: {"cam_from_rig": _pose_data(item.cam_from_rig) | _present({"sigma": item.sigma, "covariance": item.covariance})}
            for name, item in entire.rig.items()
        }
    if entire.views:
        data["views"] = [_view_data(view) for view in entire.views]
    if entire.provenance:
        data["provenance"] = entire.provenance
    return yaml_text(data)


def _present(data: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in data.items() if value is not None}


def _camera_data(model: CameraModel, estimate: CameraEstimate | None) -> dict[str, Any]:
    data: dict[str, Any] = {
        "model": model.NAME,
        "image_size": list(model.image_size),
        "parameters": model.named_parameters(),
    }
    if estimate is None:
        return data
    sigma = estimate.sigma
    ordered = None if sigma is None else {name: sigma[name] for name in model.PARAMETER_NAMES if name in sigma}
    return data | _present(
        {
            "sign_source": estimate.sign_source,
            "sigma": ordered,
            "covariance": estimate.covariance,
            "min_angle_deg": estimate.min_angle_deg or None,
            "max_angle_deg": estimate.max_angle_deg,
            "rms_px_per_axis": estimate.rms_px_per_axis,
            "rms_px_per_point": estimate.rms_px_per_point,
        }
    )


def _pose_data(pose: Pose) -> dict[str, Any]:
    return {
        "rotation_wxyz": quaternion_for_file(pose.rotation.detach()).tolist(),
        "translation_m": pose.translation.tolist(),
    }


def _view_data(view: ViewRecord) -> dict[str, Any]:
    return {
        "image": image_name(view.image, "The image of a view"),
        **_present({"view": view.view}),
        "camera": view.camera,
        **_present({"frame": view.frame}),
        "used": view.used,
        "reason": view.reason,
        "corners_used": view.corners_used,
        "corners_rejected": view.corners_rejected,
        "rms_px_per_point": view.rms_px_per_point,
        "cam_from_board": None if view.cam_from_board is None else _pose_data(view.cam_from_board),
    }


# Reading: each function takes a value as YAML gives it and the place where it stands, for the message.


def _calibration(data: Any) -> Calibration:
    top = mapping(data, "the file")
    if top.get("format") != FORMAT:
        found = f"'{top['format']}'" if "format" in top else "none"
        raise InputError(
            f"The key format must be {FORMAT}, found {found}; give a calibration.yaml of omnilines, or make one of a file of "
            "another format with omnilines convert FILE calibration.yaml (omnilines.convert)."
        )
    version = whole(required(top, "version", "the file"), "version")
    if version > VERSION:
        raise InputError(f"The file is of version {version} and this omnilines reads up to {VERSION}; install a newer omnilines.")
    if version < 1:
        raise InputError(f"The version must be 1 to {VERSION}, found {version}; correct it.")
    cameras: dict[str, CameraModel] = {}
    estimates: dict[str, CameraEstimate] = {}
    for name, value in mapping(required(top, "cameras", "the file"), "cameras").items():
        where = f"camera {name}"
        camera = mapping(value, where)
        cameras[name] = _model(camera, where)
        estimates[name] = _estimate(camera, cameras[name], where)
    views = items(default(top.get("views"), []), "views")
    return Calibration(
        cameras,
        estimates,
        {name: _rig_camera(value, f"rig camera {name}") for name, value in mapping(default(top.get("rig"), {}), "rig").items()},
        tuple(_view(view, f"view {index + 1}", next(iter(cameras), "")) for index, view in enumerate(views)),
        mapping(default(top.get("provenance"), {}), "provenance"),
    )


def _model(camera: Mapping[str, Any], where: str) -> CameraModel:
    name = text(required(camera, "model", where), f"model of {where}")
    size = image_size(required(camera, "image_size", where), f"image_size of {where}")
    parameters = {
        key: number(value, f"parameter {key} of {where}")
        for key, value in mapping(required(camera, "parameters", where), f"parameters of {where}").items()
    }
    try:
        return camera_models.model_class(name).from_mapping(parameters, size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _estimate(camera: Mapping[str, Any], model: CameraModel, where: str) -> CameraEstimate:
    sigma = camera.get("sigma")
    covariance = camera.get("covariance")
    sign = camera.get("sign_source")
    min_angle = optional_number(camera, "min_angle_deg", where)
    try:
        return CameraEstimate(
            sigma={key: number(value, f"sigma {key} of {where}") for key, value in mapping(sigma, f"sigma of {where}").items()}
            if sigma is not None
            else None,
            covariance=_covariance(covariance, list(camera["parameters"]), model, where) if covariance is not None else None,
            max_angle_deg=optional_number(camera, "max_angle_deg", where),
            min_angle_deg=0.0 if min_angle is None else min_angle,
            rms_px_per_axis=optional_number(camera, "rms_px_per_axis", where),
            rms_px_per_point=optional_number(camera, "rms_px_per_point", where),
            sign_source=text(sign, f"sign_source of {where}") if sign is not None else None,
        )
    except InputError as error:
        raise InputError(str(error) if where in str(error) else f"{where}: {error}") from None


def _covariance(value: Any, names: list[str], model: CameraModel, where: str) -> Float[np.ndarray, "p p"]:
    given = numbers(value, (len(names), len(names)), f"covariance of {where}")
    # Rows stand in the order of the parameters in the file, which may leave out those that were held.
    index = [model.PARAMETER_NAMES.index(name) for name in names]
    covariance = np.zeros((len(model.PARAMETER_NAMES),) * 2)
    covariance[np.ix_(index, index)] = given
    return covariance


def _rig_camera(value: Any, where: str) -> RigCamera:
    pose = mapping(required(mapping(value, where), "cam_from_rig", where), f"cam_from_rig of {where}")
    known = {name: pose.get(name) for name in ("sigma", "covariance")}
    shapes = {"sigma": (6,), "covariance": (6, 6)}
    given = {name: numbers(value, shapes[name], f"{name} of {where}") for name, value in known.items() if value is not None}
    return RigCamera(_pose(pose, where), **given)


def _view(value: Any, where: str, first_camera: str) -> ViewRecord:
    view = mapping(value, where)
    image = image_name(required(view, "image", where), f"image of {where}")
    where = f"{where} ({image})"
    used = default(view.get("used"), True)
    if not isinstance(used, bool):
        raise InputError(f"used of {where} must be true or false, found {used!r}; correct it.")
    pose = view.get("cam_from_board")
    texts = {key: text(view[key], f"{key} of {where}") for key in ("reason", "frame", "view") if view.get(key) is not None}
    return ViewRecord(
        image=image,
        camera=text(default(view.get("camera"), first_camera), f"camera of {where}"),
        used=used,
        corners_used=whole(default(view.get("corners_used"), 0), f"corners_used of {where}"),
        corners_rejected=whole(default(view.get("corners_rejected"), 0), f"corners_rejected of {where}"),
        rms_px_per_point=optional_number(view, "rms_px_per_point", where),
        cam_from_board=_pose(mapping(pose, f"cam_from_board of {where}"), where) if pose is not None else None,
        **texts,
    )


def _pose(value: Mapping[str, Any], where: str) -> Pose:
    q = numbers(required(value, "rotation_wxyz", where), (4,), f"rotation_wxyz of {where}")
    t = numbers(required(value, "translation_m", where), (3,), f"translation_m of {where}")
    if not np.linalg.norm(q) > 1e-12:
        raise InputError(f"rotation_wxyz of {where} must be a unit quaternion, found one of length zero; correct it.")
    return Pose(rotation_from_file(torch.from_numpy(q)), torch.from_numpy(t))


class Native(CalibrationFormat):
    """calibration.yaml among the formats that are converted: it holds everything."""

    NAME = "omnilines"
    TITLE = "omnilines"
    SUFFIXES = (".yaml", ".yml")
    RIGS = True
    REFERRED = False
    FORMS: ClassVar[tuple[Form, ...]] = tuple(Form(name, name) for name, _ in camera_models.MODELS)

    def recognises(self, path: Path, head: str) -> bool:
        """The key `format`."""
        return f"format: {FORMAT}" in head

    def names(self, calibration: Calibration) -> list[str]:
        """Those that they have."""
        return list(calibration)

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Everything, and what is known of the poses of a rig."""
        parts = (CameraEstimate, RigCamera, Calibration)
        return frozenset({"rig", *(item.name for part in parts for item in fields(part))})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        return Content(load(path))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        return {path: calibration_text(calibration)}
