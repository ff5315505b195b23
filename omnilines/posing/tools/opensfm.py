"""Poses in OpenSfM's reconstruction.json (also OpenDroneMap's): `rotation` and `translation` of shots.

X_camera = R X_world + t, R by its rotation vector; cameras have x right, y down, z forward. Where the photos had GPS the world is
that of metres east, north and up at `reference_lla`; without GPS that is all zeros and the scale is open. Of several
reconstructions the one with most shots counts. OpenSfM documentation, "Reconstruction file format".
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from camera_models.formats.json_text import read_json
from camera_models.formats.values import items, mapping, numbers, required
from camera_models.pose import rotation_from_vector
from omnilines.posing.tools.contract import PoseFile, ToolPoses, rigid
from omnilines.records import LengthUnit


class OpenSfMPoses(PoseFile):
    """reconstruction.json."""

    TITLE = "OpenSfM's reconstruction.json"

    def recognises(self, path: Path, head: str) -> bool:
        """JSON, a list, that names a type of projection."""
        return path.suffix.lower() == ".json" and head.lstrip("ï»¿ \t\r\n").startswith("[") and '"projection_type"' in head

    def _read(self, path: Path) -> ToolPoses:
        parts = [mapping(part, f"reconstruction {k}") for k, part in enumerate(items(read_json(path), "the file"))]
        shots = [mapping(part.get("shots") or {}, f"shots of reconstruction {k}") for k, part in enumerate(parts)]
        largest = max(range(len(parts)), key=lambda k: len(shots[k]), default=None)
        if largest is None:
            return ToolPoses((), rigid([], [], []), LengthUnit.OPEN)
        names, rotations, translations = [], [], []
        for name, value in shots[largest].items():
            keys, where = mapping(value, f"shot {name}"), f"of shot {name}"
            vector = numbers(required(keys, "rotation", f"shot {name}"), (3,), f"rotation {where}")
            rotations.append(rotation_from_vector(torch.from_numpy(vector)).numpy())
            translations.append(numbers(required(keys, "translation", f"shot {name}"), (3,), f"translation {where}"))
            names.append(name)
        elsewhere = f"it is of another of the {len(parts)} reconstructions in the file, which has fewer photos"
        lost = {name: elsewhere for k, those in enumerate(shots) if k != largest for name in those if name not in shots[largest]}
        unit, up = (LengthUnit.METRES, (0.0, 0.0, 1.0)) if _by_gps(parts[largest]) else (LengthUnit.OPEN, None)
        return ToolPoses(tuple(names), rigid(rotations, translations, names), unit, lost, up=up)


def _by_gps(part: dict[str, Any]) -> bool:
    """Whether the world stands somewhere on the earth."""
    keys = ("latitude", "longitude", "altitude")
    place = mapping(part.get("reference_lla") or {}, "reference_lla")
    return bool(np.any([numbers([place.get(key, 0.0)], (1,), f"{key} of reference_lla") for key in keys]))
