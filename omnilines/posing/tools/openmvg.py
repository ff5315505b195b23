"""Poses in OpenMVG's sfm_data.json: `extrinsics` hold `rotation` R and `center` C of a pose, and `views` say which photo has it.

X_camera = R (X_world - C); cameras have x right, y down, z forward. The file does not say what its unit is.
OpenMVG's sources, `sfm/sfm_view_io.hpp` and `geometry/pose3_io.hpp`.
"""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from camera_models.formats.json_text import read_json
from camera_models.formats.values import items, mapping, numbers, required, text, whole
from omnilines.posing.tools.contract import PoseFile, ToolPoses, rigid
from omnilines.records import LengthUnit


class OpenMVGPoses(PoseFile):
    """sfm_data.json."""

    TITLE = "OpenMVG's sfm_data.json"

    def recognises(self, path: Path, head: str) -> bool:
        """JSON with its version."""
        return path.suffix.lower() == ".json" and '"sfm_data_version"' in head

    def _read(self, path: Path) -> ToolPoses:
        data = mapping(read_json(path), "the file")
        known = {key: (value, where) for key, value, where in _entries(data, "extrinsics")}
        names, rotations, translations, lost = [], [], [], {}
        for _, value, where in _entries(data, "views"):
            wrapper = mapping(required(value, "ptr_wrapper", where), where)
            view = mapping(required(wrapper, "data", where), where)
            file = text(required(view, "filename", where), f"filename of {where}").replace("\\", "/")
            name = str(PurePosixPath(text(view.get("local_path", ""), f"local_path of {where}").strip("/")) / file)
            pose = whole(required(view, "id_pose", where), f"id_pose of {where}")
            if pose not in known:
                lost[name] = "OpenMVG found none"
                continue
            keys, of = known[pose]
            rotation = numbers(required(keys, "rotation", of), (3, 3), f"rotation of {of}")
            names.append(name)
            rotations.append(rotation)
            translations.append(-rotation @ numbers(required(keys, "center", of), (3,), f"center of {of}"))
        return ToolPoses(tuple(names), rigid(rotations, translations, names), LengthUnit.OPEN, lost)


def _entries(data: dict[str, Any], key: str) -> Iterator[tuple[int, dict[str, Any], str]]:
    """Number, value and name of every entry of a table that cereal wrote."""
    for index, entry in enumerate(items(data.get(key) or [], key)):
        where = f"entry {index} of {key}"
        keys = mapping(entry, where)
        yield whole(required(keys, "key", where), f"key of {where}"), mapping(required(keys, "value", where), where), where
