"""Poses that a table gives to photos, and the unit that poses are in."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from camera_models import Calibration, InputError, load
from camera_models.errors import OmnilinesError
from camera_models.wording import listed
from omnilines.files import is_corners_table, read_corners, read_poses
from omnilines.files.scene_folder import UNIT_KEY, stated_up
from omnilines.posing.from_colmap import read_model
from omnilines.posing.from_corners import poses_from_corners
from omnilines.posing.from_rig import complete_from_rig
from omnilines.posing.instant_names import instants
from omnilines.posing.options import PosingOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.tools import Keys, pose_file_of
from omnilines.records import ImagePoses, LengthUnit

SAME_PLACE_M = 1e-9
"""Cameras of a rig that are no farther apart give no scale."""


def named_cameras(source: str) -> dict[str, str]:
    """The camera of every photo for which a poses.csv names one; none of another source. Raises as `read_poses`."""
    path = Path(source)
    if not path.is_file() or is_corners_table(path) or pose_file_of(path) is not None:
        return {}
    table = read_poses(path)
    return {image: name for image, name in zip(table.images, table.cameras or (), strict=False) if name}


def require_readable(path: Path) -> None:
    """Reads the file, or the folder of a model, that poses are to come from, whatever photos it is of. Raises as it is read."""
    if path.is_dir():
        read_model(path)
    elif (tool := pose_file_of(path)) is not None:
        tool.read(path)
    elif is_corners_table(path):
        read_corners(path)
    else:
        read_poses(path)


def from_table(
    path: Path, names: Sequence[str], cameras: Calibration, camera_of: Mapping[str, str], options: PosingOptions
) -> PhotoPoses:
    """The poses of photos from a file: a corners.csv of points of known place, or a poses.csv. Raises as those are read."""
    if is_corners_table(path):
        return poses_from_corners(read_corners(path), cameras, {name: camera_of[name] for name in names}, options)
    return given_poses(read_poses(path), names, cameras, camera_of, path=str(path), options=options)


def given_poses(
    table: ImagePoses,
    names: Sequence[str],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    *,
    path: str,
    options: PosingOptions = PosingOptions(),
) -> PhotoPoses:
    """The poses of photos that a table has, those of a rig completed; `path` is what messages call it.

    Raises InputError where it has none of them.
    """
    known = [k for k, name in enumerate(table.images) if name in camera_of]
    if not known:
        raise InputError(
            f"{path}: poses of the photos ({names[0]}, ...) were expected, found those of {', '.join(table.images[:3])}; names "
            "are paths relative to the photo folder."
        )
    images = tuple(table.images[k] for k in known)
    frames = None if table.frames is None else tuple(table.frames[k] for k in known)
    names_of = tuple(camera_of[image] for image in images)
    poses = replace(table, images=images, cam_from_world=table.cam_from_world[known], cameras=names_of, frames=frames)
    notes = _of_other_cameras(table, camera_of, Path(path).name)
    if cameras.rig and frames is not None:
        whole = {**instants(names, camera_of), **dict(zip(images, frames, strict=True))}
        return replace(complete_from_rig(cameras, poses, names, camera_of, whole, options=options.given), notes=notes)
    lost = {name: f"{name} has no pose: it is not in {Path(path).name}." for name in names if name not in images}
    return PhotoPoses(poses, lost, notes)


def _of_other_cameras(table: ImagePoses, camera_of: Mapping[str, str], path: str) -> tuple[str, ...]:
    """Where the table names another camera of a photo than that which the photo counts as of: its folder's, or the only one."""
    named = zip(table.images, table.cameras or ("",) * len(table), strict=True)
    others = {image: name for image, name in named if name and camera_of.get(image, name) != name}
    if not others:
        return ()
    told, taken = (listed(dict.fromkeys(names)) for names in (others.values(), (camera_of[image] for image in others)))
    return (
        f"The camera of {len(others)} photos ({listed(others)}) is {told} in {path}, and they count as photos of {taken}: check "
        "that the calibration is of these photos.",
    )


def unit_of_poses(source: str, cameras: Calibration, camera_of: Mapping[str, str]) -> LengthUnit:
    """What the poses of a source are in, before they are known.

    A rig gives metres where cameras that stand apart show one instant, and a board does; of a file and a COLMAP model as
    `unit_of_file`.
    """
    if source == "sfm":
        return LengthUnit.METRES if cameras.rig and _seen_from_apart(cameras, camera_of) else LengthUnit.OPEN
    path = Path(source)
    return unit_of_file(path) if path.exists() else LengthUnit.METRES


def has_open_scale(source: str, cameras: Calibration, camera_of: Mapping[str, str]) -> bool:
    """Whether a known distance scales the poses of a source: those whose unit is open, and trajectories, which do not say whether
    one camera alone made them, unless they are of a rig."""
    path = Path(source)
    tool = pose_file_of(path) if path.is_file() else None
    if tool is None:
        return unit_of_poses(source, cameras, camera_of) is LengthUnit.OPEN
    own = tool.read(path)
    return own.unit is LengthUnit.OPEN or (own.keys is not Keys.NAMES and not cameras.rig)


def _seen_from_apart(cameras: Calibration, camera_of: Mapping[str, str]) -> bool:
    """Whether cameras of a rig that stand apart show one instant."""
    centre = {name: cameras.rig[name].cam_from_rig.centre for name in set(camera_of.values())}
    first: dict[str, torch.Tensor] = {}
    for photo, instant in instants(list(camera_of), camera_of).items():
        own = centre[camera_of[photo]]
        if bool((own - first.setdefault(instant, own)).norm() > SAME_PLACE_M):
            return True
    return False


def unpaired_note(cameras: Calibration, camera_of: Mapping[str, str]) -> tuple[str, ...]:
    """Where several cameras of a rig took photos, and none of these are of one instant by their names."""
    of_instants = instants(list(camera_of), camera_of)
    if not cameras.rig or len(set(camera_of.values())) < 2 or len(set(of_instants.values())) < len(of_instants):
        return ()
    first = next(iter(camera_of))
    other = next(photo for photo, camera in camera_of.items() if camera != camera_of[first])
    return (
        f"No two cameras of the rig have a photo of one name, as {first} and {other} have not: they count as taken one after the "
        "other, and the rig tells nothing of where they were taken. Give those of one instant one name in the folders of their "
        "cameras.",
    )


def unit_of_file(poses: Path) -> LengthUnit:
    """What a poses.csv is in: metres, unless it lies in a scene folder whose calibration.yaml says that the unit is open. The
    folder of a COLMAP model does not say; files of other tools may."""
    if poses.is_dir():
        return LengthUnit.OPEN
    tool = pose_file_of(poses)
    if tool is not None:
        return tool.read(poses).unit
    return LengthUnit.OPEN if _said_beside(poses).get(UNIT_KEY) == LengthUnit.OPEN.sign else LengthUnit.METRES


def up_of_file(poses: Path) -> tuple[float, float, float] | None:
    """What is up in the world of a poses.csv, where it lies in a scene folder whose calibration.yaml says so, and in that of
    another tool's file that says it. Raises InputError where that is no direction."""
    if poses.is_dir():
        return None
    tool = pose_file_of(poses)
    return stated_up(_said_beside(poses), _beside(poses)) if tool is None else tool.read(poses).up


def _beside(poses: Path) -> Path:
    return poses.parent / "calibration.yaml"


def _said_beside(poses: Path) -> Mapping[str, Any]:
    """The provenance of the calibration beside a table of poses; nothing where there is none that can be read."""
    try:
        return load(_beside(poses)).provenance if _beside(poses).is_file() else {}
    except OmnilinesError:
        return {}
