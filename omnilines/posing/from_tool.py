"""Poses of photos from the files of other tools (`posing/tools/`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from camera_models import Calibration, InputError
from omnilines.posing.from_trajectory import poses_from_trajectory
from omnilines.posing.options import GivenOptions
from omnilines.posing.photo_names import matched_names
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.tools import Keys, PoseFile, ToolPoses
from omnilines.records import ImagePoses


def poses_from_tool(
    path: Path,
    tool: PoseFile,
    photos: Sequence[str],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    *,
    stamps_ns: Mapping[str, int] = MappingProxyType({}),
    body: Path | None = None,
    options: GivenOptions = GivenOptions(),
) -> PhotoPoses:
    """`cam_from_world` of photos that a tool's file has, in its world and unit; its cameras are not used.

    Names are matched as `photo_names.py` does it, photos to the rows of a trajectory as `from_trajectory.py` does, by `stamps_ns`
    where these are known; there `body` may be a file that places the cameras on the body that moves. Raises InputError where the
    file is damaged or has none of the photos.
    """
    own = tool.read(path)
    if own.keys is not Keys.NAMES:
        return poses_from_trajectory(path, own, photos, cameras, camera_of, stamps_ns=stamps_ns, body=body, options=options)
    if body is not None:
        raise InputError(
            f"`body` was expected with a trajectory, found it beside {tool.TITLE}, which has poses of photos; leave it out."
        )
    return _by_names(path, tool.TITLE, own, photos, camera_of)


def _by_names(path: Path, title: str, own: ToolPoses, photos: Sequence[str], camera_of: Mapping[str, str]) -> PhotoPoses:
    every = {name: index for index, name in enumerate((*own.names, *own.lost))}
    found, lost = matched_names(photos, list(every), path.name)
    without = {photo: f"{photo} has no pose: {own.lost[name]}." for photo, name in found.items() if name in own.lost}
    posed = {photo: every[name] for photo, name in found.items() if photo not in without}
    if not posed:
        raise InputError(
            f"{path}: poses of the photos ({photos[0] if photos else 'none given'}, ...) were expected in {title}, found "
            f"those of {', '.join(own.names[:3])}; give the photos that it was run on."
        )
    table = ImagePoses(tuple(posed), own.cam_from_world[list(posed.values())], tuple(camera_of[photo] for photo in posed))
    return PhotoPoses(table, {**lost, **without}, own.notes, unit=own.unit, up=own.up)
