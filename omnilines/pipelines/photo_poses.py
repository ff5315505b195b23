"""Where the poses of photos come from: a table, a COLMAP model, a rig, a board, a sheet, or the photos themselves."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, InputError
from omnilines.files import PhotoRef, is_corners_table, read_corners, read_photo, read_poses
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.posing.find_rectangle import PhotoArcs
from omnilines.posing.from_boards import poses_from_boards
from omnilines.posing.from_colmap import poses_from_colmap
from omnilines.posing.from_corners import poses_from_corners
from omnilines.posing.from_rectangles import poses_from_rectangles
from omnilines.posing.from_rig import complete_from_rig, poses_from_rig
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.rectangle import PREFIX, parse_rectangle
from omnilines.posing.sfm import sfm_poses
from omnilines.progress import ProgressCallback

SOURCES = ("sfm", "rig", "boards")
SHEET = f"{PREFIX}WIDTHxHEIGHT"


LEAST_PHOTOS = 3
"""For structure from motion."""


def from_photos(source: str) -> bool:
    """Whether poses come from the photos and the calibration, not from a table or a model."""
    return source in SOURCES or source.startswith(PREFIX)


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
    elif source.startswith(PREFIX):
        parse_rectangle(source)
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
    arcs: Sequence[FoundArcs] = (),
    seed: int = 0,
    progress: ProgressCallback,
) -> PhotoPoses:
    """Poses from `source`: `sfm`, `rig`, `boards` (with a pattern), `rectangle:WIDTHxHEIGHT` (with the arcs of the photos), a
    poses.csv, a corners.csv of points of known place, or a folder with a COLMAP model.

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
        return poses_from_boards(names, read, cameras, camera_of, parse_pattern(pattern or ""), progress=progress)
    if source.startswith(PREFIX):
        arcs_of = {found.photo.name: found for found in arcs}
        return poses_from_rectangles(
            names, read, lambda name: sides_of(arcs_of[name], cameras), cameras, camera_of, estimates=cameras.estimates,
            rectangle=parse_rectangle(source), seed=seed, progress=progress,
        )  # fmt: skip
    return _without_photos(source, names, cameras, camera_of)


def sides_of(found: FoundArcs, cameras: Calibration) -> PhotoArcs:
    """Arcs with the noise of their end bearings."""
    camera, ends = cameras[found.camera], torch.as_tensor(found.endpoints_px)
    with torch.no_grad():
        bearings, _ = camera.unproject(ends)
        by_pixel = camera.unproject_jacobian(ends)
    noise = by_pixel @ torch.as_tensor(found.covariance_px2) @ by_pixel.mT
    return PhotoArcs(bearings.numpy(), noise.numpy(), found.colours)


def _without_photos(source: str, names: Sequence[str], cameras: Calibration, camera_of: Mapping[str, str]) -> PhotoPoses:
    """Poses from a source that does not look into the photos."""
    frame_of = instants(names)
    if source == "rig":
        return poses_from_rig(cameras, names, camera_of, frame_of)
    if Path(source).is_dir():
        return poses_from_colmap(source, names, camera_of)
    if not Path(source).is_file():
        raise InputError(
            "--poses was expected to be a poses.csv, a corners.csv, a COLMAP model's folder, or one of "
            f"{', '.join((*SOURCES, SHEET))}, found '{source}'."
        )
    return _from_table(Path(source), names, cameras, camera_of, frame_of)


def instants(names: Sequence[str]) -> dict[str, str]:
    """The instant of each photo of a rig: photos of one file name are of one."""
    return {name: PurePosixPath(name).stem for name in names}


def _from_table(
    path: Path, names: Sequence[str], cameras: Calibration, camera_of: Mapping[str, str], frame_of: Mapping[str, str]
) -> PhotoPoses:
    if is_corners_table(path):
        return poses_from_corners(read_corners(path), cameras, {name: camera_of[name] for name in names})
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
