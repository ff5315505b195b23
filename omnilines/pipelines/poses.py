"""Where the poses of photos come from: a table, a COLMAP model, another tool's file, a rig, a board, a sheet, or the photos."""

import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from calib_patterns import DetectionOptions
from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, CameraModel, GeometryError, InputError
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.files import Photo, PhotoRef, Photos, photo_folder, photos_of
from omnilines.files.fingerprint import fingerprint, revision
from omnilines.files.folders import work_folder
from omnilines.files.frames import read_stamps
from omnilines.files.kept import read_kept, write_kept
from omnilines.files.masks import looked_at, mask_files
from omnilines.options import require_ranges
from omnilines.pipelines.arcs import calibration_of, cameras_of_photos, extract
from omnilines.pipelines.copies import is_copy, without_copies
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs, require_cameras_of
from omnilines.pipelines.pose_tables import from_table, named_cameras, unit_of_poses, unpaired_note, up_of_file
from omnilines.pipelines.recognise import as_printed
from omnilines.posing.find_rectangle import BearingArcs
from omnilines.posing.from_boards import is_mirrored, poses_from_boards
from omnilines.posing.from_colmap import poses_from_colmap
from omnilines.posing.from_rectangles import poses_from_rectangles
from omnilines.posing.from_rig import poses_from_rig
from omnilines.posing.from_tool import poses_from_tool
from omnilines.posing.instant_names import instants
from omnilines.posing.joining import LEAST_PHOTOS
from omnilines.posing.options import PosingOptions
from omnilines.posing.photo_poses import CameraByPoints, PhotoPoses
from omnilines.posing.rectangle import PREFIX, parse_rectangle
from omnilines.posing.sfm import sfm_poses
from omnilines.posing.tools import TITLES, pose_file_of
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Advice, ImagePoses

SOURCES = ("sfm", "rig", "boards")
SHEET = f"{PREFIX}WIDTHxHEIGHT"
"""In the provenance of a scene's calibration.yaml, and in `--json`."""
KEPT = "poses.npz"
MADE_BY = (
    "camera_models",
    "calib_patterns",
    *(f"omnilines.{part}" for part in ("geometry", "least_squares", "matching", "posing")),
)
"""Whose source decides what poses are found in photos, beside this module."""


def from_photos(source: str) -> bool:
    """Whether poses come from the photos and the calibration, not from a table or a model."""
    return source in SOURCES or source.startswith(PREFIX)


def check_source(
    source: str,
    photos: Sequence[Photo],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    pattern: str | None,
    body: Path | None = None,
) -> None:
    """Refuse what `estimate_poses` cannot work from, before any photo is looked at: tables, models and patterns are read.

    Raises InputError where the source is none of those there or does not fit the photos.
    """
    require_source(source, pattern, body)
    if source == "sfm":
        if len(photos) < LEAST_PHOTOS:
            raise InputError(f"`poses` sfm was expected with {LEAST_PHOTOS} photos or more, found {len(photos)}; give more.")
    elif source == "rig" or not from_photos(source):
        _without_photos(source, photos, cameras, camera_of, body)


def require_source(source: str, pattern: str | None, body: Path | None = None) -> None:
    """Raises InputError where a source of poses is none, whatever the photos: no name of one, no path, or a malformed target; and
    where `body` is given with one that is no trajectory."""
    require_pattern(source, pattern)
    if source == "boards":
        parse_pattern(pattern or "")
    elif source.startswith(PREFIX):
        parse_rectangle(source)
    elif not (from_photos(source) or Path(source).is_dir() or Path(source).is_file()):
        raise InputError(
            f"`poses` was expected to be a poses.csv, a corners.csv, a COLMAP model's folder, {TITLES}, or one of "
            f"{', '.join((*SOURCES, SHEET))}, found '{source}', and no file or folder is there; check the path."
        )
    require_body(source, body)


def require_body(source: str, body: Path | None) -> None:
    """Raises InputError where a body is given with poses that are of no other tool."""
    if body is not None and (from_photos(source) or kind_of(source) != "tool"):
        raise InputError(
            f"`body` was expected with `poses` of a trajectory and only there, found `poses` {source}; leave it out."
        )


def require_pattern(source: str, pattern: str | None) -> None:
    """Raises InputError where a pattern is missing, or would do nothing."""
    if (pattern is not None) != (source == "boards"):
        raise InputError(
            f"`pattern` was expected with `poses` boards and only there, found `poses` {source}; correct the options."
        )


@typed
def estimate_poses(
    photos: Photos | PhotoArcs,
    camera: CameraModel | Calibration,
    source: str | Path = "sfm",
    *,
    pattern: str | None = None,
    body: str | Path | None = None,
    refine_rig: bool = False,
    options: PosingOptions = PosingOptions(),
    seed: int = 0,
    work: str | Path | None = None,
    progress: ProgressCallback = silent,
) -> PhotoPoses:
    """Poses of photos, or of the photos that arcs were found in.

    `source` is `sfm` (structure from motion), `rig`, `boards` (with a `pattern`), `rectangle:WIDTHxHEIGHT` (a sheet of that
    size, found by its arcs), or the path of a poses.csv, a corners.csv of points of known place, a folder with a COLMAP model, or
    a file with poses of Metashape, Pix4D, Nerfstudio, OpenMVG or OpenSfM, or with a trajectory (`omnilines/posing/tools`), of a
    body where the file `body` says how the cameras sit on it (`omnilines/posing/body.py`).
    Of a rig, a frame is the photos of one file name; poses of a table that names some of its cameras are completed. With
    `refine_rig`, the places of its cameras are found anew where structure from motion contradicts them (`PhotoPoses.rig`).
    Poses that were looked for in photos are kept in the folder `work`, where one is given.

    Raises InputError where the source does not fit the photos, and GeometryError where the photos give no poses.

        >>> posed = ol.estimate_poses("room/", ol.load("room/calibration.yaml"), "room/poses.csv")
        >>> len(posed.poses), posed.left_out, posed.unit.words
        (6, {}, 'metres')
    """
    source, cameras, body = str(source), calibration_of(camera), None if body is None else Path(body)
    require_ranges(options)
    if isinstance(photos, PhotoArcs):
        require_cameras_of(photos, cameras)
    photos = without_copies(photos) if isinstance(photos, PhotoArcs) and from_photos(source) else photos
    arcs = photos if isinstance(photos, PhotoArcs) else None
    if not isinstance(photos, PhotoArcs) and source.startswith(PREFIX):
        arcs = extract(photos, cameras, work=work, progress=progress)
    refs = [one.photo for one in photos.used] if isinstance(photos, PhotoArcs) else photos_of(photos)
    if arcs is None:
        camera_of = cameras_of_photos(refs, cameras, None if from_photos(source) else named_cameras(source))
    else:
        camera_of = arcs.camera_of
    require_source(source, pattern, body)
    if not isinstance(photos, PhotoArcs):
        check_source(source, refs, cameras, camera_of, pattern, body)
    try:
        found = _found(_Asked(source, refs, arcs, cameras, camera_of, pattern, body, refine_rig, options, seed), work, progress)
    except GeometryError as error:
        raise GeometryError(f"{error}{'' if arcs is None else _of_copies(arcs)}") from None
    kind = kind_of(source)
    if kind == "tool":  # its file was read with its unit and what is up
        return replace(found, source=kind)
    if kind == "sfm":
        found = replace(found, notes=(*found.notes, *unpaired_note(cameras, camera_of)))
    up = None if from_photos(source) else up_of_file(Path(source))
    return replace(found, source=kind, unit=unit_of_poses(source, cameras, camera_of), up=up)


def _of_copies(arcs: PhotoArcs) -> str:
    """What is to be said of them where poses are not found: they are left out, and may be why."""
    lost = [name for name, reason in arcs.skipped.items() if is_copy(reason)]
    if not lost:
        return ""
    are = "is a copy" if len(lost) == 1 else "are copies"
    why = f"of {lost[0]} it is said: {arcs.skipped[lost[0]]}"
    return f" {len(lost)} of {len(arcs.photos)} photos {are} of others and left out; {why}"


def kind_of(source: str) -> str:
    """The kind of a source of poses, as `PhotoPoses` names it."""
    if from_photos(source):
        return source.split(":")[0]
    path = Path(source)
    return "colmap" if path.is_dir() else "table" if pose_file_of(path) is None else "tool"


@dataclass(frozen=True)
class _Asked:
    """What is asked of photos."""

    source: str
    photos: Sequence[Photo]
    arcs: PhotoArcs | None
    cameras: Calibration
    camera_of: Mapping[str, str]
    pattern: str | None
    body: Path | None
    refine_rig: bool
    options: PosingOptions
    seed: int


def _found(asked: _Asked, work: str | Path | None, progress: ProgressCallback) -> PhotoPoses:
    """The poses, kept where a folder for that is given and they had to be looked for."""
    if not from_photos(asked.source):
        return _without_photos(asked.source, asked.photos, asked.cameras, asked.camera_of, asked.body, asked.options)
    if work is None:
        with tempfile.TemporaryDirectory() as folder:
            return _looked_for(asked, Path(folder), progress)
    path, made_from = work_folder(work) / KEPT, _made_from(asked)
    known = _read(path, made_from)
    if known is None:
        known = _looked_for(asked, Path(work), progress)
        _write(path, made_from, known)
    return known


def _looked_for(asked: _Asked, work: Path, progress: ProgressCallback) -> PhotoPoses:
    names, cameras, camera_of = [photo.name for photo in asked.photos], asked.cameras, asked.camera_of
    photo_of = {photo.name: photo for photo in asked.photos}
    options, seed = asked.options, asked.seed

    def read(name: str) -> np.ndarray:
        return photo_of[name].read()

    if asked.source == "sfm":
        frames = instants(names, camera_of) if cameras.rig else None
        return sfm_poses(
            names, read, cameras, camera_of, work, frame_of=frames, progress=progress, seed=seed, options=options,
            mask_of=lambda name: looked_at(photo_of[name], cameras[camera_of[name]].image_size), refine_rig=asked.refine_rig,
        )  # fmt: skip
    if asked.source == "boards":
        target, otherwise = as_printed(
            parse_pattern(asked.pattern or ""), asked.photos, any_tags=True, mirrored=all(map(is_mirrored, cameras.values())),
            options=DetectionOptions(), progress=progress,
        )  # fmt: skip
        found = poses_from_boards(names, read, cameras, camera_of, target, progress=progress, options=options)
        return found if otherwise is None else replace(found, notes=(otherwise, *found.notes))
    if asked.source == "rig":
        return poses_from_rig(cameras, names, camera_of, instants(names, camera_of))
    assert asked.arcs is not None
    arcs_of = {found.photo.name: found for found in asked.arcs.photos}
    return poses_from_rectangles(
        names, read, lambda name: sides_of(arcs_of[name], cameras), cameras, camera_of, estimates=cameras.estimates,
        rectangle=parse_rectangle(asked.source), seed=seed, progress=progress, options=options,
    )  # fmt: skip


def sides_of(found: FoundArcs, cameras: Calibration) -> BearingArcs:
    """Arcs with the noise of their end bearings."""
    camera, ends = cameras[found.camera], torch.as_tensor(found.endpoints_px)
    with torch.no_grad():
        bearings, _ = camera.unproject(ends)
        by_pixel = camera.unproject_jacobian(ends)
    noise = by_pixel @ torch.as_tensor(found.covariance_px2) @ by_pixel.mT
    return BearingArcs(bearings.numpy(), noise.numpy(), found.colours)


def _without_photos(
    source: str,
    photos: Sequence[Photo],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    body: Path | None = None,
    options: PosingOptions = PosingOptions(),
) -> PhotoPoses:
    """Poses from a source that does not look into the photos."""
    names = [photo.name for photo in photos]
    if source == "rig":
        return poses_from_rig(cameras, names, camera_of, instants(names, camera_of))
    if Path(source).is_dir():
        return poses_from_colmap(source, names, camera_of)
    tool = pose_file_of(Path(source))
    if tool is not None:
        folder = photo_folder(photos)
        stamps_ns = {} if folder is None else read_stamps(folder)
        return poses_from_tool(
            Path(source), tool, names, cameras, camera_of, stamps_ns=stamps_ns, body=body, options=options.given
        )
    return from_table(Path(source), names, cameras, camera_of, options)


def _made_from(asked: _Asked) -> str:
    """Of all that poses found in photos depend on."""
    names = {photo.name: asked.camera_of[photo.name] for photo in asked.photos}
    of_masks = mask_files(asked.photos)
    masks = [of_masks.index(photo.mask) if isinstance(photo.mask, Path) else None for photo in asked.photos]
    known = [
        (name, model.NAME, model.image_size, model.parameters.detach().tolist(), _angles_deg(asked.cameras, name))
        for name, model in asked.cameras.items()
    ]
    rig = [
        (name, one.cam_from_rig.rotation.tolist(), one.cam_from_rig.translation.tolist())
        for name, one in asked.cameras.rig.items()
    ]
    seen = hashlib.sha256()
    if asked.source.startswith(PREFIX) and asked.arcs is not None:
        for one in asked.arcs.photos:
            for values in (one.endpoints_px, one.covariance_px2, one.colours):
                seen.update(np.ascontiguousarray(values).tobytes())
    for photo in asked.photos:
        if not isinstance(photo, PhotoRef):
            seen.update(np.ascontiguousarray(photo.read()).tobytes())
        if isinstance(photo.mask, np.ndarray):
            seen.update(np.packbits(photo.mask).tobytes())
    asked_for = (asked.source, asked.pattern, asked.refine_rig, asked.options.stated, asked.seed)
    options = repr((*asked_for, names, masks, known, rig, seen.hexdigest()))
    files = [*(photo.path for photo in asked.photos if isinstance(photo, PhotoRef)), *of_masks]
    return fingerprint(files, options, revision(*MADE_BY, __name__, as_printed.__module__, looked_at.__module__))


def _angles_deg(cameras: Calibration, name: str) -> tuple[float, float | None]:
    """Between which a camera is known."""
    estimate = cameras.estimates.get(name)
    return (0.0, None) if estimate is None else (estimate.min_angle_deg, estimate.max_angle_deg)


def _read(path: Path, inputs: str) -> PhotoPoses | None:
    """The poses in a file; None where it is absent, damaged, or of other inputs."""
    kept = read_kept(path, inputs)
    if kept is None:
        return None
    words = json.loads(str(kept["words"]))
    pose = Pose(torch.as_tensor(kept["rotation"]), torch.as_tensor(kept["translation"]))
    named = {name: None if words[name] is None else tuple(words[name]) for name in ("cameras", "frames")}
    poses = ImagePoses(tuple(words["images"]), pose, named["cameras"], kept.get("covariance"), named["frames"])
    advice = tuple(Advice(limit, do) for limit, do in words["advice"])
    mounted = Pose(torch.as_tensor(kept["rig_rotation"]), torch.as_tensor(kept["rig_translation"]))
    rig = {name: mounted[k] for k, name in enumerate(words["rig"])}
    cameras = {
        name: CameraByPoints(kept[f"camera_change_{k}"], kept[f"camera_covariance_{k}"], angle)
        for k, (name, angle) in enumerate(words["camera_angles"].items())
    }
    return PhotoPoses(poses, words["left_out"], tuple(words["notes"]), rig=rig, cameras=cameras, advice=advice)


def _write(path: Path, inputs: str, found: PhotoPoses) -> None:
    poses = found.poses
    words: dict[str, Any] = {"left_out": dict(found.left_out), "notes": found.notes}
    words["advice"] = [(one.limit, one.do) for one in found.advice]
    words |= {"images": poses.images, "cameras": poses.cameras, "frames": poses.frames}
    arrays = {"rotation": poses.cam_from_world.rotation.numpy(), "translation": poses.cam_from_world.translation.numpy()}
    words["rig"] = tuple(found.rig)
    mounted = Pose.stack(list(found.rig.values())) if found.rig else Pose.identity(0)
    arrays |= {"rig_rotation": mounted.rotation.numpy(), "rig_translation": mounted.translation.numpy()}
    words["camera_angles"] = {name: one.max_angle_rad for name, one in found.cameras.items()}
    for k, one in enumerate(found.cameras.values()):
        arrays |= {f"camera_change_{k}": one.change, f"camera_covariance_{k}": one.covariance}
    if poses.covariance is not None:
        arrays["covariance"] = poses.covariance
    write_kept(path, inputs, {"words": np.array(json.dumps(words)), **arrays})
