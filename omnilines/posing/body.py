"""Where cameras sit on the body whose trajectory is known: Kalibr's T_cam_imu, EuRoC's T_BS, VINS's body_T_cam0, KITTI-360's
calib_cam_to_pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, InputError
from camera_models.formats.disk import read_text
from camera_models.formats.opencv_storage import read_storage
from camera_models.formats.rig_poses import pose_of_matrix
from camera_models.formats.values import mapping, number, numbers, required
from camera_models.formats.yaml_text import read_yaml
from camera_models.pose import Pose
from camera_models.wording import listed
from omnilines.posing.tools.contract import rigid
from omnilines.posing.tools.rows import numbers_in, rows

FILES = (
    "Kalibr's camchain (T_cam_imu), EuRoC's sensor.yaml (T_BS), VINS-Fusion's settings (body_T_cam0) or KITTI-360's "
    "calib_cam_to_pose.txt"
)
KALIBR, SHIFT, EUROC, VINS, VINS_SHIFT = "T_cam_imu", "timeshift_cam_imu", "T_BS", "body_T_", "td"
OF_OPENCV = "!!opencv-matrix"
"""In what cv2.FileStorage writes, which is no YAML."""


@dataclass(frozen=True)
class Mount:
    """A camera on a body."""

    cam_from_body: Pose
    later_s: float = 0.0
    """What a time of the camera needs to be one of the body."""


def mounts(path: Path | None, cameras: Calibration) -> Mapping[str, Mount]:
    """How every camera sits on the body; without a file the body is the camera, of a rig the rig frame.

    Cameras are found by their names, an only one by being alone. With a rig the first that is found places all others. Raises
    InputError where the file is none of those or does not name the cameras.
    """
    in_rig = {name: one.cam_from_rig for name, one in cameras.rig.items()}
    if path is None:
        return {name: Mount(in_rig.get(name, Pose.identity())) for name in cameras}
    said = _read(path)
    if len(said) == len(cameras) == 1:
        said = dict(zip(cameras, said.values(), strict=True))
    known = [name for name in cameras if name in said]
    if not known or (len(known) < len(cameras) and not in_rig):
        raise InputError(
            f"{path}: the places of {listed(cameras)} on the body were expected, found those of {listed(said)}; name them alike."
        )
    if not in_rig:
        return {name: said[name] for name in cameras}
    first = known[0]
    rig_from_body = in_rig[first].inverse() @ said[first].cam_from_body
    return {name: Mount(in_rig[name] @ rig_from_body, said.get(name, said[first]).later_s) for name in cameras}


def _read(path: Path) -> dict[str, Mount]:
    if path.suffix.lower() not in (".yaml", ".yml"):
        return _kitti(path)
    try:
        if OF_OPENCV in read_text(path):
            return _vins(read_storage(path))
        data = mapping(read_yaml(path), "the file")
        if EUROC in data:
            return {"camera": Mount(_euroc(mapping(data[EUROC], EUROC)).inverse())}
        of_cameras = {name: value for name, value in data.items() if isinstance(value, dict) and KALIBR in value}
        if of_cameras:
            return {name: _kalibr(value, name) for name, value in of_cameras.items()}
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
    raise InputError(f"{path}: {FILES} was expected, found none of these; give the file that says where the cameras sit.")


def _vins(data: Mapping[str, Any]) -> dict[str, Mount]:
    """p_body = body_T_cam0 p_cam0, and t_imu = t_cam + td."""
    given = {name.removeprefix(VINS): value for name, value in data.items() if name.startswith(VINS)}
    if not given:
        raise InputError(f"{FILES} was expected, found none of these; give the file that says where the cameras sit.")
    shift = number(data.get(VINS_SHIFT, 0.0), VINS_SHIFT)
    return {
        name: Mount(pose_of_matrix(numbers(np.asarray(value).tolist(), (4, 4), f"{VINS}{name}").tolist(), name).inverse(), shift)
        for name, value in given.items()
    }


def _kalibr(camera: Mapping[str, Any], name: str) -> Mount:
    """p_cam = T_cam_imu p_imu and t_imu = t_cam + timeshift_cam_imu (Kalibr wiki, "yaml formats")."""
    shift = number(camera.get(SHIFT, 0.0), f"{SHIFT} of {name}")
    return Mount(pose_of_matrix(camera[KALIBR], f"{KALIBR} of {name}"), shift)


def _euroc(matrix: Mapping[str, Any]) -> Pose:
    """p_body = T_BS p_sensor, its 16 numbers by rows."""
    flat = numbers(required(matrix, "data", EUROC), (16,), f"data of {EUROC}")
    return pose_of_matrix(flat.reshape(4, 4).tolist(), EUROC)


def _kitti(path: Path) -> dict[str, Mount]:
    """p_body = (3 x 4) p_camera, a row for every camera."""
    found = {}
    try:
        for where, (name, *cells) in rows(read_text(path)):
            if len(cells) != 12 or not name.endswith(":"):
                raise InputError(f"{FILES} was expected, found another {where}; give the file that says where the cameras sit.")
            matrix = numbers_in(cells, where).reshape(3, 4)
            found[name.rstrip(":")] = Mount(rigid([matrix[:, :3]], [matrix[:, 3]], [name])[0].inverse())
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
    if not found:
        raise InputError(f"{path}: {FILES} was expected, found an empty file; give the file that says where the cameras sit.")
    return found
