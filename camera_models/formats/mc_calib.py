"""MC-Calib's calibrated_cameras_data.yml: nb_camera, and camera_0, camera_1, ... as cv2.FileStorage writes them.

camera_matrix          K
distortion_vector      k1 k2 p1 p2 k3; of a fisheye k1 k2 k3 k4
distortion_type        0 for pinhole, 1 for fisheye
camera_pose_matrix     takes points of the camera to the reference, the first camera of its group
"""

from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import CalibrationFormat, Content, Documents, left_out
from camera_models.formats.forms import Form
from camera_models.formats.opencv_cameras import FISHEYE, PINHOLE, camera_of, kind_of, matrix_of, numbers_of, size_of
from camera_models.formats.opencv_storage import read_storage
from camera_models.formats.rig_poses import matrix_of_pose, pose_of_matrix, rig_of
from camera_models.formats.values import mapping, whole
from camera_models.pose import Pose

_K = ("fx", "fy", "cx", "cy")
_KEYS = ("camera_matrix", "distortion_vector", "distortion_type", "camera_group", "img_width", "img_height", "camera_pose_matrix")


class MCCalib(CalibrationFormat):
    """calibrated_cameras_data.yml."""

    NAME = "mc-calib"
    TITLE = "MC-Calib"
    SUFFIXES = (".yml",)
    RIGS = True
    NEEDS_RIG = True
    FORMS: ClassVar[tuple[Form, ...]] = (
        Form(PINHOLE, "pinhole", (*_K, "k1", "k2", "p1", "p2", "k3")),
        Form(FISHEYE, "opencv-fisheye", (*_K, "k1", "k2", "k3", "k4"), ends_deg=90.0),
    )

    def recognises(self, path: Path, head: str) -> bool:
        """The storage of OpenCV with the number of cameras at its top."""
        return path.suffix.lower() in self.SUFFIXES and "nb_camera:" in head

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """Every file says where its cameras stand."""
        return frozenset({"rig"})

    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        data = read_storage(path)
        count = whole(data.get("nb_camera"), "nb_camera")
        if sum(key.startswith("camera_") for key in data) != count:
            raise InputError(f"The file must hold nb_camera = {count} cameras, found others; restore it.")
        cameras: dict[str, CameraModel] = {}
        poses: dict[str, Pose] = {}
        groups = set()
        notes: list[str] = []
        beside: dict[str, list[str]] = {}
        for index in range(count):
            name = f"cam{index}"
            values = mapping(data.get(f"camera_{index}"), f"camera_{index}")
            kind = kind_of(values.get("distortion_type"), f"distortion_type of camera_{index}")
            matrix = numbers_of(values.get("camera_matrix"), f"camera_matrix of camera_{index}", 9)
            distortion = numbers_of(values.get("distortion_vector"), f"distortion_vector of camera_{index}")
            size = size_of([values.get("img_width"), values.get("img_height")], image_size)
            cameras[name], note = camera_of(kind, matrix, distortion, None, size, where=f"camera_{index}")
            notes += [note] if note else []
            numbers = numbers_of(values.get("camera_pose_matrix"), f"camera_pose_matrix of camera_{index}", 16)
            poses[name] = pose_of_matrix(np.reshape(numbers, (4, 4)).tolist(), f"camera_pose_matrix of camera_{index}").inverse()
            groups.add(values.get("camera_group"))
            beside[name] = [key for key in values if key not in _KEYS]
        if len(groups) > 1:
            notes.append("Not kept: the poses, which are of several groups of cameras; here a rig has every camera of the file.")
            poses = {}
        beside["the file"] = [key for key in data if key != "nb_camera" and not key.startswith("camera_")]
        return Content(Calibration(cameras, rig=rig_of(poses)), (*notes, *left_out(beside)))

    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        storage.write("nb_camera", len(calibration))
        for index, (name, model) in enumerate(calibration.items()):
            form = self.exact_form(model)
            fx, fy, cx, cy, *rest = form.values(model)
            pose = calibration.rig[name].cam_from_rig if calibration.rig else Pose.identity()
            values: dict[str, Any] = {
                "camera_matrix": matrix_of(fx, fy, cx, cy),
                "distortion_vector": np.array([rest]),
                "distortion_type": int(form.name == FISHEYE),
                "camera_group": 0,
                "img_width": model.image_size[0],
                "img_height": model.image_size[1],
                "camera_pose_matrix": np.array(matrix_of_pose(pose.inverse())),
            }
            storage.startWriteStruct(f"camera_{index}", cv2.FILE_NODE_MAP)
            for key, value in values.items():
                storage.write(key, value)
            storage.endWriteStruct()
        written: str = storage.releaseAndGetString()
        return {path: written}
