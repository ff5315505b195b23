"""Project Aria's device calibration as JSON: `CameraCalibrations`, each with its projection and T_Device_Camera.

    Linear                    pinhole           fx fy cx cy
    FisheyeRadTanThinPrism    fisheye624        f cx cy k0 ... k5 p0 p1 s0 s1 s2 s3
    KannalaBrandtK3           opencv-fisheye    fx fy cx cy k0 k1 k2 k3

The radial polynomial of both is theta + k0 theta^3 + k1 theta^5 + ...; the centre of the first pixel is (0, 0). T_Device_Camera
takes points of the camera to the device, its quaternion is [w, [x, y, z]]. Sizes are `ImageSizes`, as the online calibrations of
Aria's machine perception services have them. Project Aria documentation, "Camera intrinsic models" and "2D image coordinate
system conventions".
"""

from pathlib import Path
from typing import Any, ClassVar

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.fisheye624 import Fisheye624
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.json_text import json_text, read_json
from camera_models.formats.rig_poses import pose_of_quaternion, quaternion_of_pose, rig_of
from camera_models.formats.values import image_size as size_of
from camera_models.formats.values import items, mapping, numbers, required, text
from camera_models.pose import Pose
from camera_models.wording import listed

_CAMERAS, _SIZES, _POSE = "CameraCalibrations", "ImageSizes", "T_Device_Camera"
_KEYS = ("Label", "Projection", _POSE, "Calibrated")


class Aria(CalibrationFormat):
    """A device calibration."""

    NAME = "aria"
    TITLE = "Project Aria"
    SUFFIXES = (".json",)
    RIGS = True
    NEEDS_RIG = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form("Linear", "pinhole", ("fx", "fy", "cx", "cy"), options={"coefficients": 0}),
        Form("FisheyeRadTanThinPrism", "fisheye624", ("f", "cx", "cy", *Fisheye624.PARAMETER_NAMES[4:])),
        Form("KannalaBrandtK3", "opencv-fisheye", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with the cameras of a device."""
        return path.suffix.lower() in self.SUFFIXES and f'"{_CAMERAS}"' in head

    def names(self, calibration: Calibration) -> list[str]:
        """Their labels."""
        return list(calibration)

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every file says where its cameras stand."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = mapping(read_json(path), "the file")
        entries = items(required(data, _CAMERAS, "the file"), _CAMERAS)
        sizes = items(data.get(_SIZES) or [image_size and list(image_size)] * len(entries), _SIZES)
        if len(sizes) != len(entries):
            raise InputError(f"{_SIZES} must be of {len(entries)} cameras, found {len(sizes)}; correct the file.")
        cameras: dict[str, CameraModel] = {}
        poses: dict[str, Pose] = {}
        beside = {"the file": [key for key in data if key not in (_CAMERAS, _SIZES)]}
        for index, (entry, size) in enumerate(zip(entries, sizes, strict=True)):
            table = mapping(entry, f"camera {index}")
            name = text(required(table, "Label", f"camera {index}"), f"Label of camera {index}")
            if name in cameras:
                raise InputError(f"Each camera must be there once, found {name} twice; rename one.")
            if size is None:
                raise InputError(f"{_SIZES} is missing in the file, which does not say how large images are; give `image_size`.")
            projection = mapping(required(table, "Projection", name), name)
            cameras[name] = self._camera(projection, size_of(size, f"{_SIZES} of {name}"), name)
            if table.get(_POSE) is not None:
                poses[name] = _cam_from_device(mapping(table[_POSE], f"{_POSE} of {name}"), name)
            beside[name] = [key for key in table if key not in _KEYS]
        if len(poses) not in (0, len(cameras)):
            raise InputError(f"{_POSE} must be there of all cameras or of none, found that of {listed(poses)}; correct the file.")
        return Content(Calibration(cameras, rig=rig_of(poses)), left_out(beside))

    def _camera(self, projection: dict[str, Any], size: tuple[int, int], name: str) -> CameraModel:
        form = self.form_named(text(required(projection, "Name", name), f"Name of {name}"), name)
        count = len(form.order or ())
        return form.camera(numbers(required(projection, "Params", name), (count,), f"Params of {name}").tolist(), size, name)

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        entries: list[dict[str, Any]] = []
        for name, model in calibration.items():
            form = self.exact_form(model)
            pose = (calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()).inverse()
            w, *xyz = quaternion_of_pose(pose)
            entries.append({
                "Calibrated": True, "Label": name, "Projection": {"Name": form.name, "Params": form.values(model)},
                _POSE: {"Translation": (pose.translation + 0.0).tolist(), "UnitQuaternion": [w, xyz]},
            })  # fmt: skip
        sizes = [list(model.image_size) for model in calibration.values()]
        return {path: json_text({_CAMERAS: entries, _SIZES: sizes})}


def _cam_from_device(pose: dict[str, Any], name: str) -> Pose:
    quaternion = items(required(pose, "UnitQuaternion", name), f"UnitQuaternion of {name}")
    if len(quaternion) != 2:
        raise InputError(f"UnitQuaternion of {name} must be [w, [x, y, z]], found {len(quaternion)} entries; correct it.")
    w = numbers([quaternion[0]], (1,), f"UnitQuaternion of {name}").tolist()
    xyz = numbers(quaternion[1], (3,), f"UnitQuaternion of {name}").tolist()
    centre = numbers(required(pose, "Translation", name), (3,), f"Translation of {name}").tolist()
    return pose_of_quaternion([*w, *xyz], centre, f"{_POSE} of {name}").inverse()
