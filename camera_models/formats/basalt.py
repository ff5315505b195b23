"""Basalt's calibration.json: `value0` with intrinsics, resolution and T_imu_cam, which takes points of the camera to the IMU.

    camera_type       intrinsics
    pinhole           fx fy cx cy
    pinhole-radtan8   fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 rpmax (of Basalt as Monado uses it)
    kb4               fx fy cx cy k1 k2 k3 k4
    ucm, eucm         fx fy cx cy alpha; and beta
    ds                fx fy cx cy xi alpha

Poses are px py pz (m) and qx qy qz qw. The frame of the IMU stands for that of the rig. Basalt reads no file in which a key is
absent: of the IMU, its own defaults are written. `rpmax`, the radius at z = 1 up to which the distortion is one-to-one, follows
from the coefficients and is not read. Pixels are OpenCV's.
"""

import math
from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.rig_poses import pose_of_quaternion, quaternion_of_pose, rig_of
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, number, required, text
from camera_models.pinhole import Pinhole
from camera_models.pose import Pose

_K = ("fx", "fy", "cx", "cy")
_ABOUT_IMU: dict[str, Any] = {
    "calib_accel_bias": [0.0] * 9,
    "calib_gyro_bias": [0.0] * 12,
    "imu_update_rate": 200.0,
    "accel_noise_std": [0.016] * 3,
    "gyro_noise_std": [0.000282] * 3,
    "accel_bias_std": [0.001] * 3,
    "gyro_bias_std": [0.0001] * 3,
    "cam_time_offset_ns": 0,
    "vignette": [],
}
_CAMERAS = ("intrinsics", "resolution", "T_imu_cam")
_POSE = ("qw", "qx", "qy", "qz", "px", "py", "pz")


class Basalt(CalibrationFormat):
    """calibration.json."""

    NAME = "basalt"
    TITLE = "Basalt"
    SUFFIXES = (".json",)
    RIGS = True
    NEEDS_RIG = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("pinhole", "pinhole", _K),
        Form("pinhole-radtan8", "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), options={"coefficients": 8}),
        Form("kb4", "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4")),
        Form("ucm", "extended-unified", (*_K, "alpha"), fixed={"beta": 1.0}),
        Form("eucm", "extended-unified", (*_K, "alpha", "beta")),
        Form("ds", "double-sphere", (*_K, "xi", "alpha")),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with the keys of Basalt."""
        return path.suffix.lower() in self.SUFFIXES and '"value0"' in head and ('"T_imu_cam"' in head or '"camera_type"' in head)

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every file says where its cameras stand."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(required(mapping(read_json(path), "the file"), "value0", "the file"), "value0")
        intrinsics = items(required(data, "intrinsics", "value0"), "intrinsics")
        sizes = items(required(data, "resolution", "value0"), "resolution")
        poses = items(data.get("T_imu_cam") or [], "T_imu_cam")
        if len(sizes) != len(intrinsics) or len(poses) not in (0, len(intrinsics)):
            raise InputError(
                f"intrinsics, resolution and T_imu_cam must be of as many cameras, found {len(intrinsics)}, {len(sizes)} and "
                f"{len(poses)}; correct the file."
            )
        cameras: dict[str, CameraModel] = {}
        for index, (value, size) in enumerate(zip(intrinsics, sizes, strict=True)):
            name = f"cam{index}"
            cameras[name] = self._camera(mapping(value, name), size_of(size, f"resolution of {name}"), name)
        rig = {f"cam{index}": _pose(value, f"T_imu_cam of cam{index}").inverse() for index, value in enumerate(poses)}
        beside = {"the file": [key for key in data if key not in _CAMERAS and _ABOUT_IMU.get(key) != data[key]]}
        return Content(Calibration(cameras, rig=rig_of(rig)), left_out(beside))

    def _camera(self, value: dict[str, Any], size: tuple[int, int], name: str) -> CameraModel:
        form = self.form_named(text(required(value, "camera_type", name), f"camera_type of {name}"), name)
        named = mapping(required(value, "intrinsics", name), f"intrinsics of {name}")
        return form.camera([number(required(named, key, name), f"{key} of {name}") for key in form.order or ()], size, name)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        intrinsics: list[dict[str, Any]] = []
        poses: list[dict[str, float]] = []
        for name, model in calibration.items():
            form = self.exact_form(model)
            named = dict(zip(form.order or (), form.values(model), strict=True))
            if form.name == "pinhole-radtan8" and isinstance(model, Pinhole):
                # Zero or less stands for no limit.
                named["rpmax"] = model.max_slope if model.max_angle < math.pi / 2 else 0.0
            intrinsics.append({"camera_type": form.name, "intrinsics": named})
            pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
            back = pose.inverse()
            poses.append(dict(zip(_POSE, [*quaternion_of_pose(back), *back.translation.tolist()], strict=True)))
        sizes = [list(model.image_size) for model in calibration.values()]
        value = {"T_imu_cam": poses, "intrinsics": intrinsics, "resolution": sizes, **_ABOUT_IMU}
        return {path: json_text({"value0": value})}


def _pose(value: Any, where: str) -> Pose:
    pose = mapping(value, where)
    w, x, y, z, px, py, pz = (number(required(pose, key, where), f"{key} of {where}") for key in _POSE)
    return pose_of_quaternion([w, x, y, z], [px, py, pz], where)
