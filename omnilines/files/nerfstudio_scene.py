"""Nerfstudio's transforms.json of a scene: the camera and the pose of every photo.

`transform_matrix` takes points of the camera (x right, y up, z backwards) to the world. `camera_models.formats.nerfstudio` has
the cameras.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, InputError
from camera_models.formats.disk import write_atomically
from camera_models.formats.json_text import json_text
from camera_models.formats.nerfstudio import FRAMES, Nerfstudio
from camera_models.formats.rig_poses import matrix_of_pose
from camera_models.formats.transfer import transfer
from omnilines.files.scene_folder import SceneTables

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Our camera frame from that of OpenGL."""


def write_nerfstudio(path: Path, scene: SceneTables, photos: Path | None = None) -> tuple[str, ...]:
    """Write the photos with a pose, by their names in the folder `photos` as seen from the file; what is fitted or lost.

    Cameras that Nerfstudio does not have are fitted by the nearest that it has, and the error is stated. Raises InputError where
    none comes near, or no photo has a pose.
    """
    if not len(scene.poses):
        raise InputError(f"{path}: poses of photos were expected, found none; reconstruct the scene first.")
    known = {name: estimate for name, estimate in scene.cameras.estimates.items() if estimate.max_angle_deg is not None}
    writer = Nerfstudio()
    # A folder, for several cameras: each gets its own keys.
    fit = transfer(Calibration(dict(scene.cameras), known), writer, path.with_suffix(""))
    said = [
        f"camera {name} ({scene.cameras[name].NAME}) fitted by {fit.forms[name].name}: {error.rms_px:.3g} px RMS, "
        f"{error.max_px:.3g} px at most within {error.fov_deg:.0f} degrees"
        for name, error in fit.conversions.items()
    ]
    lenses = {name: writer.lens(model) for name, model in fit.calibration.items()}
    alone = next(iter(lenses.values())) if len(lenses) == 1 else {}
    names = scene.poses.cameras or (next(iter(lenses)),) * len(scene.poses)
    way = "" if photos is None else Path(os.path.relpath(os.path.abspath(photos), os.path.abspath(path.parent))).as_posix()
    before = f"{way}/" if way not in ("", ".") else ""
    frames: list[dict[str, Any]] = []
    for index, (image, camera) in enumerate(zip(scene.poses.images, names, strict=True)):
        if camera not in lenses:
            raise InputError(f"{path}: the camera of {image} was expected to be one of {', '.join(lenses)}, found '{camera}'.")
        world_from_camera = np.array(matrix_of_pose(scene.poses.cam_from_world[index].inverse())) @ _OPENGL
        own = {} if alone else lenses[camera]
        frames.append({"file_path": f"{before}{image}", **own, "transform_matrix": world_from_camera.tolist()})
    write_atomically(path, json_text({**alone, FRAMES: frames}))
    return (*said, "lines", "uncertainties")
