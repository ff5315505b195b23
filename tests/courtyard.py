"""The courtyard of `lines/castle30`: its surveyed cameras at half size, and its photos beside our own files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import camera_models
from camera_models import Calibration, Pinhole
from camera_models.pose import Pose
from omnilines.files import write_poses
from omnilines.records import ImagePoses


def read_courtyard(data: Path) -> tuple[ImagePoses, Pinhole]:
    """Poses (metres) of all photos and their one camera; `.camera` files hold those of the photos of twice the size."""
    files = sorted((data / "cameras").glob("*.camera"))
    tables = [np.array(file.read_text().split(), dtype=np.float64) for file in files]
    k, size = tables[0][:9], tables[0][24:26]
    assert all((table[:9] == k).all() and len(table) == 26 for table in tables)
    half = {"fx": k[0] / 2, "fy": k[4] / 2, "cx": (k[2] + 0.5) / 2 - 0.5, "cy": (k[5] + 0.5) / 2 - 0.5}
    rotation = torch.as_tensor(np.stack([table[12:21].reshape(3, 3).T for table in tables]))
    centre = torch.as_tensor(np.stack([table[21:24] for table in tables]))
    names = tuple(file.name.removesuffix(".camera") for file in files)
    pose = Pose(rotation, -(rotation @ centre[..., None])[..., 0])
    return ImagePoses(names, pose, ("cam0",) * len(names)), Pinhole.from_mapping(half, (int(size[0]) // 2, int(size[1]) // 2))


def write_courtyard(folder: Path, data: Path, names: Sequence[str]) -> ImagePoses:
    """`calibration.yaml`, `poses.csv` and links to the photos of these names; returns their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    poses, camera = read_courtyard(data)
    chosen = ImagePoses(tuple(names), poses.cam_from_world[[poses.images.index(name) for name in names]], ("cam0",) * len(names))
    camera_models.save(folder / "calibration.yaml", Calibration({"cam0": camera}))
    write_poses(folder / "poses.csv", chosen)
    for name in names:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(data / "images" / name)
    return chosen
