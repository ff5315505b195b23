"""Kalibr's camchain YAML: `cam0`, `cam1`, ... with T_cn_cnm1, which takes points of the camera before into this one.

    camera_model     intrinsics                  distortion_model  distortion_coeffs
    pinhole          fu fv pu pv                 radtan            k1 k2 p1 p2
    pinhole          fu fv pu pv                 equidistant       k1 k2 k3 k4
    omni             xi fu fv pu pv              radtan or none    k1 k2 p1 p2
    ds               xi alpha fu fv pu pv        none
    eucm             alpha beta fu fv pu pv      none

Kalibr wiki, "yaml formats" and "supported models". Pixels are OpenCV's, lengths metres.
"""

import itertools
from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.rig_poses import matrix_of_pose, pose_of_matrix, rig_of
from camera_models.formats.values import image_size, items, mapping, number, required, text
from camera_models.formats.yaml_text import read_yaml, yaml_text
from camera_models.pose import Pose
from camera_models.wording import listed

_K = ("fx", "fy", "cx", "cy")
_RADTAN = ("k1", "k2", "p1", "p2")
_KNOWN = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rostopic", "T_cn_cnm1")
_DISTORTION = {"radtan": "radtan", "equi": "equidistant", "none": "none"}


class Kalibr(CalibrationFormat):
    """camchain.yaml."""

    NAME = "kalibr"
    TITLE = "Kalibr"
    SUFFIXES = (".yaml", ".yml")
    RIGS = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        # Every tool that reads camchains knows pinhole-radtan, not every one pinhole-none: without distortion it has zeros.
        Form("pinhole-radtan", "pinhole", (*_K, *_RADTAN)),
        Form("pinhole-equi", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
        Form("omni-radtan", "unified", ("xi", *_K, *_RADTAN)),
        Form("eucm-none", "extended-unified", ("alpha", "beta", *_K)),
        Form("ds-none", "double-sphere", ("xi", "alpha", *_K)),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """A YAML file with the camera models of Kalibr."""
        return path.suffix.lower() in self.SUFFIXES and "cam0:" in head and "camera_model:" in head and "intrinsics:" in head

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        chain = mapping(read_yaml(path), "the file")
        names = [f"cam{index}" for index in range(sum(key.startswith("cam") for key in chain))]
        cameras: dict[str, CameraModel] = {}
        for name in names:
            cameras[name] = self._camera(mapping(required(chain, name, "the file"), name), name)
        if not cameras:
            raise InputError("The cameras must be called cam0, cam1, ..., found none; correct the names.")
        beside = {name: [key for key in chain[name] if key not in _KNOWN] for name in names}
        beside["the file"] = [key for key in chain if key not in names]
        return Content(Calibration(cameras, rig=rig_of(_poses(chain, names))), left_out(beside))

    def _camera(self, camera: dict[str, Any], name: str) -> CameraModel:
        kind = text(required(camera, "camera_model", name), f"camera_model of {name}")
        distortion = text(required(camera, "distortion_model", name), f"distortion_model of {name}")
        intrinsics = [
            number(item, f"intrinsics of {name}") for item in items(required(camera, "intrinsics", name), f"intrinsics of {name}")
        ]
        coefficients = items(camera.get("distortion_coeffs") or [], f"distortion_coeffs of {name}")
        values = [number(item, f"distortion_coeffs of {name}") for item in coefficients]
        size = image_size(required(camera, "resolution", name), f"resolution of {name}")
        short = {long: short for short, long in _DISTORTION.items()}.get(distortion, distortion)
        if short == "none" and kind in ("pinhole", "omni"):
            if any(values):
                raise InputError(
                    f"distortion_coeffs of {name} must be empty for the model none, found {listed(values)}; correct them."
                )
            short, values = "radtan", [0.0] * 4
        form = self.form_named(f"{kind}-{short}", name)
        if short == "none":
            values = []
        return form.camera([*intrinsics, *values], size, name)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        data: dict[str, Any] = {}
        before: Pose | None = None
        for index, (name, model) in enumerate(calibration.items()):
            form = self.exact_form(model)
            kind, short = form.name.split("-")
            values = form.values(model)
            split = len(values) if short == "none" else len(values) - 4
            camera: dict[str, Any] = {
                "camera_model": kind,
                "intrinsics": values[:split],
                "distortion_model": _DISTORTION[short],
                "distortion_coeffs": values[split:],
                "resolution": list(model.image_size),
                "rostopic": f"/cam{index}/image_raw",
            }
            if calibration.rig:
                pose = calibration.rig[name].cam_from_rig
                if before is not None:
                    camera["T_cn_cnm1"] = matrix_of_pose(pose @ before.inverse())
                before = pose
            data[f"cam{index}"] = camera
        return {path: yaml_text(data)}


def _poses(chain: dict[str, Any], names: list[str]) -> dict[str, Pose]:
    """cam_from_cam0 of every camera, along the chain or over the IMU; empty where neither says it."""
    if len(names) == 1:
        return {}
    if all("T_cn_cnm1" in chain[name] for name in names[1:]):
        poses = {names[0]: Pose.identity()}
        for before, name in itertools.pairwise(names):
            poses[name] = pose_of_matrix(chain[name]["T_cn_cnm1"], f"T_cn_cnm1 of {name}") @ poses[before]
        return poses
    if all("T_cam_imu" in chain[name] for name in names):
        from_imu = {name: pose_of_matrix(chain[name]["T_cam_imu"], f"T_cam_imu of {name}") for name in names}
        return {name: pose @ from_imu[names[0]].inverse() for name, pose in from_imu.items()}
    if any("T_cn_cnm1" in chain[name] for name in names[1:]):
        absent = next(name for name in names[1:] if "T_cn_cnm1" not in chain[name])
        raise InputError(f"The key T_cn_cnm1 is missing in {absent}, though other cameras have it; add it.")
    return {}
