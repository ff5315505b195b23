"""Poses in Nerfstudio's transforms.json (also of instant-ngp and Polycam): `file_path` and `transform_matrix` of frames.

The matrix takes points of a camera with x right, y up and z backwards to the world. What unit that has depends on the tool that
wrote the file, which it does not say. Nerfstudio documentation, "Data conventions".
"""

from pathlib import Path, PurePosixPath

import numpy as np

from camera_models import InputError
from camera_models.formats.json_text import read_json
from camera_models.formats.nerfstudio import FRAMES
from camera_models.formats.values import items, mapping, numbers, required, text
from camera_models.pose import Pose
from omnilines.posing.readings import AXES
from omnilines.posing.tools.contract import PoseFile, ToolPoses, rigid
from omnilines.records import LengthUnit

MATRIX = "transform_matrix"


class NerfstudioPoses(PoseFile):
    """transforms.json."""

    TITLE = "Nerfstudio's transforms.json"

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with a matrix of a frame."""
        return path.suffix.lower() == ".json" and f'"{MATRIX}"' in head

    def _read(self, path: Path) -> ToolPoses:
        data = mapping(read_json(path), "the file")
        names, rotations, centres = [], [], []
        for index, entry in enumerate(items(required(data, FRAMES, "the file"), FRAMES)):
            where = f"frame {index}"
            frame = mapping(entry, where)
            name = PurePosixPath(text(required(frame, "file_path", where), f"file_path of {where}").replace("\\", "/"))
            given = items(required(frame, MATRIX, where), f"{MATRIX} of {where}")
            matrix = numbers(given, (3 if len(given) == 3 else 4, 4), f"{MATRIX} of {where}")
            if len(matrix) == 4 and not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
                raise InputError(
                    f"The last row of {MATRIX} of {where} must be 0, 0, 0, 1, found {matrix[3].tolist()}; correct it."
                )
            names.append(str(name))
            rotations.append(matrix[:3, :3])
            centres.append(matrix[:3, 3])
        theirs = rigid(rotations, centres, names).inverse()
        return ToolPoses(tuple(names), Pose(AXES @ theirs.rotation, theirs.translation @ AXES.mT), LengthUnit.OPEN)
