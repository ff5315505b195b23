"""GLB (binary glTF 2.0), for Blender, three.js and viewers in browsers: lines coloured by status, camera centres as points.

glTF has single precision and y up: the scene stands relative to its middle, which is the place of the root node, and is turned
so that what is up in it points up.
"""

from pathlib import Path

import numpy as np
import trimesh

from camera_models.formats.disk import write_atomically
from omnilines.files.ply import CAMERA_COLOUR, STATUS_COLOURS
from omnilines.files.scene_folder import Z_UP, SceneTables

_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def write_glb(path: Path, scene: SceneTables) -> tuple[str, ...]:
    """Write the lines that are known and the centres; what the file has no place for."""
    lines = scene.lines
    centres = scene.poses.cam_from_world.centre.detach().numpy()
    points = np.concatenate([lines.ends_m[lines.known].reshape(-1, 3), centres])
    middle = points.mean(0) if len(points) else np.zeros(3)
    # Only where it is needed: a turn that leaves z where it is may turn about z.
    upright = trimesh.geometry.align_vectors(scene.up, Z_UP) if scene.up != Z_UP else np.eye(4)
    placed = _Y_UP @ upright @ trimesh.transformations.translation_matrix(middle)
    whole = trimesh.Scene()
    for status, colour in STATUS_COLOURS.items():
        ends = lines.ends_m[np.array([one == status for one in lines.status], dtype=bool)] - middle
        if len(ends):
            drawn = trimesh.load_path(ends)
            drawn.colors = np.tile([*colour, 255], (len(drawn.entities), 1)).astype(np.uint8)
            whole.add_geometry(drawn, f"lines {status}", transform=placed)
    if len(centres):
        colours = np.tile([*CAMERA_COLOUR, 255], (len(centres), 1)).astype(np.uint8)
        whole.add_geometry(trimesh.PointCloud(centres - middle, colours), "camera centres", transform=placed)
    content: bytes = whole.export(file_type="glb")
    write_atomically(path, content)
    return ("the orientations of photos", "the names of tracks", "uncertainties")
