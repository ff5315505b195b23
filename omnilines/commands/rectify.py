"""omnilines rectify: photos resampled into perspective, cylindrical, panoramic and cube views, with their cameras and poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from camera_models import Calibration, CameraModel, InputError, load, save
from camera_models.pose import Pose
from camera_models.resampling import SamplingGrid, resample, sampling_grid
from camera_models.views import View, axis_from_camera, views
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos, read_photo, read_poses, write_png, write_poses
from omnilines.files.colmap_scene import check_colmap_folder, write_colmap_scene
from omnilines.files.folders import output_folder
from omnilines.files.photos import PhotoRef
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import ImagePoses, Summary

COLMAP_VIEWS = ("perspective", "cube")
"""Of which a COLMAP model is written."""


def rectify(
    photos: Sequence[str | Path],
    calibration: str | Path,
    out: str | Path,
    *,
    view: str = "perspective",
    poses: str | Path | None = None,
    fov_deg: float | None = None,
    size: tuple[int, int] | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write views of photos (PNG) into `out`, with calibration.yaml and, where poses are given, poses.csv of the views.

    `view`, `size`, `fov_deg`, `yaw_deg` and `pitch_deg` are those of `camera_models.views.views`. Perspective and cube views with
    poses are also written as a COLMAP text model, in the folder `colmap`. What the photo does not show is black. Of several
    cameras, poses.csv says which one a photo is of; it must name every photo.

    Raises InputError on files and options that are not what they have to be.
    """
    cameras = load(calibration)
    found = find_photos(photos)
    table = None if poses is None else read_poses(poses)
    of_photo = _cameras_of_photos(found, cameras, table)
    targets = views(view, size, fov_deg, yaw_deg, pitch_deg)
    folder = output_folder(out)
    if table is not None and view in COLMAP_VIEWS:
        check_colmap_folder(folder / "colmap", [photo.name for photo in found])
    grids: dict[tuple[str, str], SamplingGrid] = {}
    made: list[_Made] = []
    progress("resampling photos", 0, len(found))
    for k, photo in enumerate(found):
        name = of_photo[photo.name]
        image = read_photo(photo.path)
        for target in targets:
            key = (name, target.name)
            if key not in grids:
                grids[key] = sampling_grid(target.camera, cameras[name], _turn(cameras[name], target).T)
            file = _file_name(photo.name, target.name)
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            write_png(folder / file, resample(image, grids[key]))
            made.append(_Made(photo.name, name, file, target))
        progress("resampling photos", k + 1, len(found))
    files = [folder / one.file for one in made]
    inputs = {
        "calibration": calibration,
        "poses": poses,
        "view": view,
        "fov_deg": fov_deg,
        "yaw_deg": yaw_deg,
        "pitch_deg": pitch_deg,
    }
    save(folder / "calibration.yaml", Calibration({view: targets[0].camera}, provenance=provenance(inputs)))
    files.append(folder / "calibration.yaml")
    if table is not None:
        files += _write_poses(folder, cameras, view, targets[0].camera, table, made)
    shown = {key: float(grid.valid.mean()) for key, grid in grids.items()}
    return _result(view, targets, found, made, shown, tuple(files), folder)


@dataclass(frozen=True)
class _Made:
    photo: str
    camera: str
    file: str
    target: View


def _cameras_of_photos(photos: Sequence[PhotoRef], cameras: Calibration, table: ImagePoses | None) -> dict[str, str]:
    """Camera of each photo by name."""
    only = next(iter(cameras))
    if table is None:
        if len(cameras) > 1:
            raise InputError(
                f"A calibration of one camera was expected, found {len(cameras)}; give --poses with the camera of every photo."
            )
        return {photo.name: only for photo in photos}
    named = table.cameras or ("",) * len(table)
    known = {image: camera or only for image, camera in zip(table.images, named, strict=True)}
    for photo in photos:
        if photo.name not in known:
            raise InputError(f"A pose of every photo was expected, found none of '{photo.name}'; add it or leave the photo out.")
        if known[photo.name] not in cameras:
            raise InputError(
                f"A camera of the calibration was expected for '{photo.name}', found '{known[photo.name]}'; name one of "
                f"{', '.join(cameras)}."
            )
    if len(cameras) > 1 and table.cameras is None:
        raise InputError("The camera of every photo was expected in poses.csv, found none; fill in the column camera.")
    return known


def _turn(camera: CameraModel, target: View) -> np.ndarray:
    """view_from_cam."""
    return target.view_from_axis @ axis_from_camera(camera)


def _file_name(photo: str, face: str) -> str:
    stem = PurePosixPath(photo).with_suffix("")
    return f"{stem}_{face}.png" if face else f"{stem}.png"


def _write_poses(
    folder: Path, cameras: Calibration, view: str, camera: CameraModel, table: ImagePoses, made: Sequence[_Made]
) -> list[Path]:
    """poses.csv of the views, and for perspective ones a COLMAP model."""
    row = {image: k for k, image in enumerate(table.images)}
    source = table.cam_from_world[[row[one.photo] for one in made]]
    turn = torch.as_tensor(np.stack([_turn(cameras[one.camera], one.target) for one in made]))
    turned = Pose(turn @ source.rotation, (turn @ source.translation[..., None])[..., 0])
    frames = None if table.frames is None else tuple(table.frames[row[one.photo]] for one in made)
    result = ImagePoses(tuple(one.file for one in made), turned, (view,) * len(made), None, frames)
    write_poses(folder / "poses.csv", result)
    files = [folder / "poses.csv"]
    if view in COLMAP_VIEWS:
        files += write_colmap_scene(output_folder(folder / "colmap"), {view: camera}, result)
    return files


def _result(
    view: str,
    targets: Sequence[View],
    photos: Sequence[PhotoRef],
    made: Sequence[_Made],
    shown: dict[tuple[str, str], float],
    files: tuple[Path, ...],
    folder: Path,
) -> CommandResult:
    camera = targets[0].camera
    size = "x".join(map(str, camera.image_size))
    empty = sorted({face or view for (_, face), share in shown.items() if share == 0})
    covered = float(np.mean(list(shown.values())))
    rows = (
        ("view", view),
        ("camera model", camera.NAME),
        ("image size", f"{size} px"),
        ("photos", f"{len(photos)}, {len(made)} views"),
        ("shown by the photos", f"{100 * covered:.1f} percent of the views"),
        ("written to", str(folder)),
    )
    data = {
        "view": view,
        "model": camera.NAME,
        "image_size": list(camera.image_size),
        "parameters": camera.named_parameters(),
        "photos": len(photos),
        "views": [one.file for one in made],
        "shown_share": covered,
    }
    warnings = tuple(f"The photos show nothing of the view '{name}'; it is black." for name in empty)
    return CommandResult((Summary("Views", rows),), data, files=files, warnings=warnings)
