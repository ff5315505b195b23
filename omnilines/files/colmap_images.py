"""A COLMAP text model of photos with known cameras and poses and no points: cameras.txt, images.txt, points3D.txt.

COLMAP's reconstruction from known poses begins with such a model. The centre of the first pixel is (0.5, 0.5) there.
"""

from collections.abc import Mapping
from pathlib import Path

import torch

from camera_models import CameraModel, InputError
from camera_models.formats.disk import write_atomically
from camera_models.formats.quaternions import quaternion_for_file
from camera_models.pinhole import Pinhole
from omnilines.records import ImagePoses

_CENTRE = 0.5


def write_colmap_images(folder: Path, cameras: Mapping[str, CameraModel], poses: ImagePoses) -> tuple[Path, ...]:
    """Write the three files into an existing folder; the photos' cameras are named in `poses`.

    Raises InputError where a camera is no pinhole without skew and distortion, or a name holds a blank, which would end it.
    """
    number = {name: k for k, name in enumerate(cameras, 1)}
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for name, camera in cameras.items():
        fx, fy, cx, cy, *others = camera.parameters.detach().tolist()
        if not isinstance(camera, Pinhole) or any(others):
            raise InputError(f"A pinhole camera without distortion was expected for COLMAP, found {name}; convert it first.")
        size = " ".join(map(str, camera.image_size))
        lines.append(f"{number[name]} PINHOLE {size} {fx!r} {fy!r} {cx + _CENTRE!r} {cy + _CENTRE!r}")
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[], none here"]
    names = poses.cameras or (next(iter(cameras)),) * len(poses)
    numbers = torch.cat([quaternion_for_file(poses.cam_from_world.rotation), poses.cam_from_world.translation], -1)
    for k, (image, camera_name, values) in enumerate(zip(poses.images, names, numbers.tolist(), strict=True), 1):
        if len(image.split()) != 1:
            raise InputError(f"COLMAP's text files take names without blanks, found '{image}'; rename the photo.")
        images += [f"{k} {' '.join(map(repr, values))} {number[camera_name]} {image}", ""]
    texts = {"cameras.txt": lines, "images.txt": images, "points3D.txt": ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]}
    for name, rows in texts.items():
        write_atomically(folder / name, "\n".join(rows) + "\n")
    return tuple(folder / name for name in texts)
