"""Poses in Agisoft Metashape's XML of cameras (File, Export, Export Cameras): `transform` of cameras and of their component.

A camera's transform takes points of the camera (x right, y down, z forward) to its component (4 x 4 by rows); the component's, to
the world: X_world = s R X + t. Older files have one transform of the whole chunk. Without one the scale is open. With a chunk in
geographic coordinates the world is earth-centred (WGS84 as a rule). Metashape Python Reference, `Camera.transform` and
`ChunkTransform`.
"""

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from camera_models import InputError
from camera_models.formats.disk import read_text
from camera_models.formats.values import number, of_text
from camera_models.formats.xml_text import read_xml
from camera_models.pose import Pose
from omnilines.geometry.geodetic import near_surface, up_at
from omnilines.posing.tools.contract import PoseFile, ToolPoses, rigid
from omnilines.records import LengthUnit


class MetashapePoses(PoseFile):
    """An XML file with the root `document`."""

    TITLE = "Metashape's XML of cameras"

    def recognises(self, path: Path, head: str) -> bool:
        """XML with a chunk."""
        return path.suffix.lower() == ".xml" and "<document" in head and "<chunk" in head

    def _read(self, path: Path) -> ToolPoses:
        chunk = read_xml(read_text(path), path).find("chunk")
        if chunk is None:
            raise InputError("A chunk was expected directly in the document, found none; export the cameras in Metashape.")
        whole = _similarity(chunk.find("transform"), "the chunk")
        parts = {part.get("id"): _similarity(part.find("transform"), "a component") for part in chunk.iter("component")}
        names, matrices, of, lost = [], [], [], {}
        for camera in chunk.iter("camera"):
            if camera.get("label") is None:
                continue  # an entry of another table, which only names a camera
            name = str(camera.get("label")).replace("\\", "/")
            given = camera.find("transform")
            if given is None:
                alone = camera.get("master_id") is None
                lost[name] = "Metashape has not aligned it" if alone else "the file gives only the first camera of its rig a pose"
                continue
            names.append(name)
            matrices.append(_numbers(given, 16, f"transform of camera {name}").reshape(4, 4))
            of.append(camera.get("component_id"))
        largest = next((part for part, _ in Counter(of).most_common(1)), None)
        kept = [k for k, part in enumerate(of) if part == largest]
        elsewhere = f"it is of another of the {len(set(of))} components in the file, which has fewer photos"
        lost |= {name: elsewhere for name, part in zip(names, of, strict=True) if part != largest}
        names, matrices = [names[k] for k in kept], [matrices[k] for k in kept]
        poses = rigid([m[:3, :3] for m in matrices], [m[:3, 3] for m in matrices], names).inverse()
        world = parts.get(largest) or whole
        if world is None:
            return ToolPoses(tuple(names), poses, LengthUnit.OPEN, lost)
        poses = poses.after_similarity(*world)
        up, notes = _on_earth(poses)
        return ToolPoses(tuple(names), poses, LengthUnit.METRES, lost, notes, up)


def _similarity(element: ElementTree.Element | None, where: str) -> tuple[float, Pose] | None:
    """s and (R, t) of a transform that changes something; None where there is none."""
    if element is None:
        return None
    parts = {name: element.find(name) for name in ("scale", "rotation", "translation")}
    size, turn, shift = (
        np.array(otherwise) if part is None else _numbers(part, len(otherwise), f"{name} of {where}")
        for (name, part), otherwise in zip(parts.items(), ([1.0], np.eye(3).ravel().tolist(), [0.0] * 3), strict=True)
    )
    if not size[0] > 0:
        raise InputError(f"The scale of {where} must be above 0, found {size[0]:g}; export the cameras again.")
    if size[0] == 1.0 and np.array_equal(turn, np.eye(3).ravel()) and not shift.any():
        return None
    motion = rigid([turn.reshape(3, 3)], [shift], [where])[0]
    return float(size[0]), motion


def _numbers(element: ElementTree.Element, count: int, where: str) -> Float[np.ndarray, " n"]:
    cells = (element.text or "").split()
    if len(cells) != count:
        raise InputError(f"{where} must hold {count} numbers, found {len(cells)}; export the cameras again.")
    try:
        return np.array([number(of_text(cell), where) for cell in cells])
    except ValueError:
        raise InputError(
            f"{where} must hold {count} numbers, found '{' '.join(cells)[:80]}'; export the cameras again."
        ) from None


def _on_earth(poses: Pose) -> tuple[tuple[float, float, float] | None, tuple[str, ...]]:
    """What is up, and a note, where photos lie near the surface of an earth-centred world."""
    middle = poses.centre.mean(0).numpy()
    if not near_surface(middle):
        return None, ()
    x, y, z = up_at(middle).tolist()
    note = "The world is earth-centred, as in the file: Metashape's chunk is in geographic coordinates."
    return (x, y, z), (note,)
