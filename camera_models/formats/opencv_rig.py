"""The rig that OpenCV's app multiview_calibration writes (cv2.calibrateMultiview), of pinhole and fisheye cameras.

Ks           n matrices                  models       0 for pinhole, 1 for fisheye
distortions  all coefficients in a row   Rs, Ts       first camera to this one; Rs as matrices or rotation vectors
cam_ids      names                       image_sizes  width height
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration
from camera_models.formats.contract import Content
from camera_models.formats.forms import Form
from camera_models.formats.opencv_cameras import (
    FISHEYE,
    OMNIDIR,
    PINHOLE,
    camera_of,
    kind_of,
    matrix_of,
    numbers_of,
    size_of,
    unread,
)
from camera_models.formats.rig_poses import pose_of_vectors, rig_of, rotation_of_matrix
from camera_models.pose import Pose

_KEYS = {"Ks", "distortions", "Rs", "Ts", "models", "image_sizes", "cam_ids"}
_PINHOLE_COEFFICIENTS = 14
"""Written for each pinhole camera: the longest vector that OpenCV takes, and so the one that it gives."""


def read_rig(data: Mapping[str, Any], image_size: tuple[int, int] | None) -> Content:
    """The cameras and the rig; raises InputError where the lengths do not agree."""
    matrices = numbers_of(data["Ks"], "Ks")
    count = len(matrices) // 9
    kinds = [kind_of(mark, "Each of models") for mark in numbers_of(data.get("models"), "models", count)]
    names = _names(data.get("cam_ids"), count)
    sizes = (
        [None] * count
        if "image_sizes" not in data
        else np.reshape(numbers_of(data["image_sizes"], "image_sizes", 2 * count), (-1, 2))
    )
    distortions = _split(numbers_of(data.get("distortions"), "distortions"), kinds)
    translations = np.reshape(numbers_of(data.get("Ts"), "Ts", 3 * count), (-1, 3))
    rotations = numbers_of(data.get("Rs"), "Rs", None if np.size(data.get("Rs", 0)) == 9 * count else 3 * count)
    cameras: dict[str, CameraModel] = {}
    poses: dict[str, Pose] = {}
    notes: list[str] = []
    for index, name in enumerate(names):
        size = size_of(sizes[index], image_size)
        matrix = matrices[9 * index : 9 * index + 9]
        cameras[name], note = camera_of(kinds[index], matrix, distortions[index], None, size, where=f"camera {name}")
        notes += [note] if note else []
        if len(rotations) == 9 * count:
            turn = np.reshape(rotations[9 * index : 9 * index + 9], (3, 3))
            poses[name] = Pose.of(rotation_of_matrix(turn, f"camera {name}"), translations[index])
        else:
            poses[name] = pose_of_vectors(rotations[3 * index : 3 * index + 3], translations[index].tolist())
    return Content(Calibration(cameras, rig=rig_of(poses)), (*notes, *unread(data, _KEYS)))


def rig_data(calibration: Calibration, forms: list[Form]) -> dict[str, Any]:
    """What is written of a rig; raises InputError for a camera of cv2.omnidir."""
    matrices: list[Float[np.ndarray, "3 3"]] = []
    distortions: list[float] = []
    for form, (name, model) in zip(forms, calibration.items(), strict=True):
        if form.name == OMNIDIR:
            raise InputError(
                f"OpenCV's files of more than two cameras hold pinhole and fisheye cameras, found {name} of the model unified; "
                "give a folder, which gets a file for each camera, or `model`."
            )
        fx, fy, cx, cy, *rest = form.values(model)
        matrices.append(matrix_of(fx, fy, cx, cy))
        distortions += rest if form.name == FISHEYE else (rest + [0.0] * _PINHOLE_COEFFICIENTS)[:_PINHOLE_COEFFICIENTS]
    first = next(iter(calibration.rig.values())).cam_from_rig.inverse()
    poses = [calibration.rig[name].cam_from_rig @ first for name in calibration]
    return {
        "Rs": np.stack([pose.rotation.detach().numpy() for pose in poses]),
        "distortions": np.array(distortions)[:, None],
        "Ks": np.stack(matrices),
        "Ts": np.stack([pose.translation.detach().numpy() for pose in poses]),
        "models": np.array([[int(form.name == FISHEYE)] for form in forms], dtype=np.int32),
        "image_sizes": np.array([model.image_size for model in calibration.values()], dtype=np.int32),
        "cam_ids": list(calibration),
    }


def _names(value: Any, count: int) -> list[str]:
    given = [] if value is None else value.tolist() if isinstance(value, np.ndarray) else list(value)
    if None in given:
        raise InputError(f"Each of cam_ids must be a name, found none of camera {given.index(None)}; write it in quotes.")
    names = [f"{name:g}" if isinstance(name, float) else str(name) for name in given] or [f"cam{index}" for index in range(count)]
    if len(names) != count or len(set(names)) != count:
        raise InputError(f"cam_ids must be {count} different names, found {len(set(names))}; correct them.")
    return names


def _split(numbers: list[float], kinds: list[str]) -> list[list[float]]:
    """The coefficients of each camera: four of a fisheye, as many as are left for each of the others."""
    others = kinds.count(PINHOLE)
    left = len(numbers) - 4 * kinds.count(FISHEYE)
    each = left // others if others else 0
    if left < 0 or each * others != left:
        raise InputError(f"distortions must hold as many coefficients for each pinhole camera, found {len(numbers)}; correct it.")
    ends = np.cumsum([4 if kind == FISHEYE else each for kind in kinds]).tolist()
    return [numbers[start:end] for start, end in zip([0, *ends], ends, strict=False)]
