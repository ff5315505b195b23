"""Where the poses of photos come from: a table, a COLMAP model, a rig, a board in the photos, or the photos themselves."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, InputError
from omnilines.commands._common import ProgressCallback
from omnilines.files import PhotoRef, read_photo, read_poses
from omnilines.posing.from_boards import poses_from_boards
from omnilines.posing.from_colmap import poses_from_colmap
from omnilines.posing.from_rig import complete_from_rig, poses_from_rig
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.sfm import sfm_poses

SOURCES = ("sfm", "rig", "boards")


LEAST_PHOTOS = 3
"""For structure from motion."""


def check_source(
    source: str, photos: Sequence[PhotoRef], cameras: Calibration, camera_of: Mapping[str, str], pattern: str | None
) -> None:
    """Refuse what `photo_poses` cannot work from, before any photo is looked at: tables, models and patterns are read.

    Raises InputError where the source is none of those below or does not fit the photos.
    """
    if (pattern is not None) != (source == "boards"):
        raise InputError(
            f"--pattern was expected with --poses boards and only there, found --poses {source}; correct the options."
        )
    if source == "boards":
        parse_pattern(pattern or "")
    elif source == "sfm":
        if len(photos) < LEAST_PHOTOS:
            raise InputError(f"--poses sfm was expected with {LEAST_PHOTOS} photos or more, found {len(photos)}; give more.")
    else:
        _without_photos(source, [photo.name for photo in photos], cameras, camera_of)


def photo_poses(
    source: str,
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    work: Path,
    *,
    pattern: str | None = None,
    seed: int = 0,
    progress: ProgressCallback,
) -> PhotoPoses:
    """Poses from `source`: `sfm`, `rig`, `boards` (with a pattern), a poses.csv or a folder with a COLMAP model.

    Of a rig, a frame is the photos of one file name; poses of a table that names some of its cameras are completed. Raises
    InputError where the source does not fit the photos (`check_source` has looked at all but the photos themselves).
    """
    names = [photo.name for photo in photos]
    path_of = {photo.name: photo.path for photo in photos}

    def read(name: str) -> np.ndarray:
        return read_photo(path_of[name])

    if source == "sfm":
        frames = instants(names) if cameras.rig else None
        return sfm_poses(names, read, cameras, camera_of, work, frame_of=frames, progress=progress, seed=seed)
    if source == "boards":
        return poses_from_boards(names, read, cameras, camera_of, parse_pattern(pattern or ""), progress)
    return _without_photos(source, names, cameras, camera_of)


def _without_photos(source: str, names: Sequence[str], cameras: Calibration, camera_of: Mapping[str, str]) -> PhotoPoses:
    """Poses from a source that does not look into the photos."""
    frame_of = instants(names)
    if source == "rig":
        return poses_from_rig(cameras, names, camera_of, frame_of)
    if Path(source).is_dir():
        return poses_from_colmap(source, names, camera_of)
    if not Path(source).is_file():
        raise InputError(
            f"--poses was expected to be a poses.csv, a COLMAP model's folder, or one of {', '.join(SOURCES)}, found '{source}'."
        )
    return _from_table(Path(source), names, cameras, camera_of, frame_of)


def instants(names: Sequence[str]) -> dict[str, str]:
    """The instant of each photo of a rig: photos of one file name are of one."""
    return {name: PurePosixPath(name).stem for name in names}


def _from_table(
    path: Path, names: Sequence[str], cameras: Calibration, camera_of: Mapping[str, str], frame_of: Mapping[str, str]
) -> PhotoPoses:
    table = read_poses(path)
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
    if cameras.rig and frames is not None:
        instants = {**frame_of, **dict(zip(images, frames, strict=True))}
        return complete_from_rig(cameras, poses, names, camera_of, instants)
    lost = {name: f"{name} has no pose: it is not in {path.name}." for name in names if name not in images}
    return PhotoPoses(poses, lost)
