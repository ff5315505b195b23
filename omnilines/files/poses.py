"""`poses.csv`: `cam_from_world` of photos, one row each."""

from pathlib import Path

import numpy as np
import torch

from camera_models.formats.quaternions import quaternion_for_file, rotation_from_file
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.files.tables import name_cells, number_cells, read_table, write_table
from omnilines.records import LARGEST_M, ImagePoses

COLUMNS = ("image", "camera", "qw", "qx", "qy", "qz", "tx", "ty", "tz")
OPTIONAL = ("frame",)
LONGEST = 10.0
"""Of a quaternion, and the inverse of the shortest: tools round them, and some do not normalise."""


@typed
def read_poses(path: str | Path) -> ImagePoses:
    """Poses in the order of the file: X_cam = R(q) X_world + t, t in metres, q = (w, x, y, z), normalised when read.

    `camera` may be empty in every row; the optional column `frame` names the instants of a rig. Raises InputError naming file,
    line and column where a value is missing or not a finite number, a quaternion is far from length 1, or a photo stands twice.
    """
    table = read_table(path, COLUMNS, OPTIONAL)
    image, images = table.images()
    _, first = np.unique(image, return_index=True)
    once = np.zeros(len(table), dtype=bool)
    once[first] = True
    table.require(once, "image", "each image once", "remove one of its rows")
    cameras = table.name_of_each("camera", image, images, "image") if table.has("camera") else None
    frames = table.name_of_each("frame", image, images, "image") if table.has("frame") else None
    quaternions = table.within(LARGEST_M, "qw", "qx", "qy", "qz")
    length = np.linalg.norm(quaternions, axis=1)
    table.require((length > 1 / LONGEST) & (length < LONGEST), "qw", "a quaternion qw,qx,qy,qz of about length 1")
    rotation = rotation_from_file(torch.from_numpy(quaternions))
    return ImagePoses(images, Pose(rotation, torch.from_numpy(table.within(LARGEST_M, "tx", "ty", "tz"))), cameras, None, frames)


@typed
def write_poses(path: str | Path, poses: ImagePoses) -> None:
    """Write poses in one step, `camera` empty where none is named; raises InputError on NaN or an unwritable path.

    Rotations come back within 3e-14 rad, and to the bit once they have been through a file.
    """
    numbers = torch.cat([quaternion_for_file(poses.cam_from_world.rotation), poses.cam_from_world.translation], -1)
    columns = {
        "image": name_cells(poses.images, None, path, "image"),
        "camera": [""] * len(poses) if poses.cameras is None else name_cells(poses.cameras, None, path, "camera"),
    }
    for name, values in zip(COLUMNS[2:], numbers.detach().cpu().numpy().T, strict=True):
        columns[name] = number_cells(values, path, name)
    if poses.frames is not None:
        columns["frame"] = name_cells(poses.frames, None, path, "frame")
    write_table(path, columns)
