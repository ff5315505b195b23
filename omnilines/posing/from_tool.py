"""Poses of photos from the files of other tools (`posing/tools/`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from camera_models import InputError
from omnilines.posing.photo_names import matched_names
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.tools import PoseFile
from omnilines.records import ImagePoses


def poses_from_tool(path: Path, tool: PoseFile, photos: Sequence[str], camera_of: Mapping[str, str]) -> PhotoPoses:
    """`cam_from_world` of photos that a tool's file has, in its world and unit; its cameras are not used.

    Names are matched as `photo_names.py` does it. Raises InputError where the file is damaged or has none of the photos.
    """
    own = tool.read(path)
    every = {name: index for index, name in enumerate((*own.names, *own.lost))}
    found, lost = matched_names(photos, list(every), path.name)
    without = {photo: f"{photo} has no pose: {own.lost[name]}." for photo, name in found.items() if name in own.lost}
    posed = {photo: every[name] for photo, name in found.items() if photo not in without}
    if not posed:
        raise InputError(
            f"{path}: poses of the photos ({photos[0] if photos else 'none given'}, ...) were expected in {tool.TITLE}, found "
            f"those of {', '.join(own.names[:3])}; give the photos that it was run on."
        )
    table = ImagePoses(tuple(posed), own.cam_from_world[list(posed.values())], tuple(camera_of[photo] for photo in posed))
    return PhotoPoses(table, {**lost, **without}, own.notes, unit=own.unit, up=own.up)
