"""Photos resampled into perspective, cylindrical, panoramic and cube views, with their cameras and poses: `rectify`.

Of a rig without poses, the photos of one instant become one view, from the middle of the rig. Photos may be turned level by the
vertical that their lines show.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError
from camera_models.pose import Pose
from camera_models.typed import typed
from camera_models.views import View, axis_from_camera, views
from camera_models.wording import listed
from omnilines.extraction import ExtractionOptions
from omnilines.files import Photo, Photos, photos_at_once, photos_of
from omnilines.files.orientation import by_camera
from omnilines.files.photos import READ_BYTES_PER_PIXEL
from omnilines.options import require_ranges
from omnilines.photo_size import wrong_size
from omnilines.pipelines.arcs import SHORT_ARCS, calibration_of, cameras_of_photos, none_usable
from omnilines.pipelines.rectified import Grids, OneView, RectifiedViews, cam_from_axis, view_from_camera
from omnilines.pipelines.upright import Level, Levels, levels_of
from omnilines.posing.instant_names import instants
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.records import Detail, ImagePoses
from omnilines.structure.options import DirectionsOptions


@typed
def rectify(
    photos: Photos,
    camera: CameraModel | Calibration,
    view: str = "perspective",
    *,
    poses: ImagePoses | PhotoPoses | None = None,
    fov_deg: float | None = None,
    size: tuple[int, int] | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    distance_m: float | None = None,
    upright: bool = False,
    work: str | Path | None = None,
    extraction: ExtractionOptions = SHORT_ARCS,
    options: DirectionsOptions = DirectionsOptions(),
    inputs: Mapping[str, Any] | None = None,
    progress: ProgressCallback = silent,
) -> RectifiedViews:
    """Perspective, cylindrical, panorama or cube views of photos, and where they look from.

    `view`, `size` (px), `fov_deg`, `yaw_deg` and `pitch_deg` are those of `camera_models.views.views`. Of several cameras, the
    poses say which one a photo is of; they must name every photo. Photos of a rig without poses, in folders named like its
    cameras, are taken together: those of one file name become one view from the middle of the rig, blended where two cameras
    look equally much that way; what lies at `distance_m` (default: far away) is without parallax there.

    With `upright` the vertical is found in the lines of each photo, or of the photos of a rig at one instant, and views look
    along the ground, upright, before they are turned by `yaw_deg` and `pitch_deg`. `extraction` and `options` are how arcs and
    directions are found; arcs are kept in the folder `work`, where one is given. `inputs` is what the views say that they were
    made from. In `left_out` are photos that cannot be read, have not the size of their camera or another EXIF orientation than
    its others, or show no vertical where that counts.

    Raises InputError on poses and options that are not what they have to be and where no photo can be used, GeometryError where
    upright views are asked for and no photo shows the vertical.

        >>> views = ol.rectify("room/", ol.load("room/calibration.yaml"), "cube", size=(100, 100))
        >>> len(views), {pixels.shape for _, pixels in views.pixels()}
        (36, {(100, 100, 3)})
    """
    require_ranges(extraction)
    require_ranges(options)
    cameras, found = calibration_of(camera), photos_of(photos)
    table = poses.poses if isinstance(poses, PhotoPoses) else poses
    targets = views(view, size, fov_deg, yaw_deg, pitch_deg)
    together = table is None and len(cameras.rig) > 1
    if distance_m is not None and not together:
        raise InputError("`distance_m` counts with the photos of a rig, without `poses`; found it otherwise: leave it out.")
    of_photo = cameras_of_photos(found, cameras) if together else _cameras_of_photos(found, cameras, table)
    found, unusable = _usable(found, cameras, of_photo, progress)
    groups = _instants(found, of_photo) if together else {photo.name: {of_photo[photo.name]: photo} for photo in found}
    levels = Levels({}, ())
    if upright:
        axes = {name: _axis_from_rig_camera(cameras, name) if together else axis_from_camera(cameras[name]) for name in cameras}
        levels = levels_of(groups, cameras, axes, work=work, extraction=extraction, options=options, progress=progress)
        groups = {name: own for name, own in groups.items() if name in levels.found}
    made = tuple(
        OneView(_file_name(name, target.name), tuple(own.values()), tuple(own), _levelled(target, level), level)
        for name, own in groups.items()
        for level in [levels.found.get(name)]
        for target in targets
    )
    grids = Grids(cameras, None if not together else math.inf if distance_m is None else distance_m)
    if not upright:
        for one in made:
            grids.of(one)
    its = None if table is None else _poses_of_views(view, cameras, table, made)
    asked: dict[str, Any] = {
        "view": view,
        "fov_deg": fov_deg,
        "yaw_deg": yaw_deg,
        "pitch_deg": pitch_deg,
        "distance_m": distance_m,
    }
    if upright:
        asked |= {"upright": True, "extraction": extraction, "directions": options}
    given = asked if inputs is None else inputs
    return RectifiedViews(view, tuple(found), made, targets[0].camera, grids, its, given, (*unusable, *levels.left_out))


def _usable(
    photos: Sequence[Photo], cameras: Calibration, camera_of: Mapping[str, str], progress: ProgressCallback
) -> tuple[list[Photo], tuple[Detail, ...]]:
    """The photos of which views can be made, and the others, each with its reason. Raises InputError where there is none."""
    turned = by_camera(photos, camera_of)

    def look(photo: Photo) -> str | None:
        """Why a photo cannot be used."""
        if photo.name in turned:
            return turned[photo.name]
        try:
            height, width = photo.read().shape[:2]
        except InputError as error:
            return str(error)
        return wrong_size("photo", (width, height), cameras[camera_of[photo.name]].image_size)

    found = on_all_cores(look, photos, "reading photos", progress, photos_at_once(photos, READ_BYTES_PER_PIXEL))
    reasons = {photo.name: reason for photo, reason in zip(photos, found, strict=True) if reason is not None}
    if len(reasons) == len(photos):
        raise none_usable(list(reasons.values()), "photos and calibration")
    left_out = tuple(Detail(name, f"{name} is skipped: {reason}") for name, reason in reasons.items())
    return [photo for photo in photos if photo.name not in reasons], left_out


def _levelled(target: View, level: Level | None) -> View:
    return target if level is None else replace(target, view_from_axis=target.view_from_axis @ level.level_from_axis)


def _instants(photos: Sequence[Photo], camera_of: Mapping[str, str]) -> dict[str, dict[str, Photo]]:
    """The photos of a rig by instant and camera. Raises InputError where a camera has two of one instant."""
    found: dict[str, dict[str, Photo]] = {}
    instant = instants([photo.name for photo in photos], camera_of)
    for photo in photos:
        own = found.setdefault(instant[photo.name], {})
        if (camera := camera_of[photo.name]) in own:
            raise InputError(
                f"One photo of camera {camera} was expected an instant, found {own[camera].name} and {photo.name}; rename it."
            )
        own[camera] = photo
    return found


def _axis_from_rig_camera(cameras: Calibration, name: str) -> Float[np.ndarray, "3 3"]:
    turn: Float[np.ndarray, "3 3"] = cam_from_axis(cameras).rotation[list(cameras.rig).index(name)].numpy().T
    return turn


def _cameras_of_photos(photos: Sequence[Photo], cameras: Calibration, table: ImagePoses | None) -> dict[str, str]:
    """Camera of each photo by name."""
    only = next(iter(cameras))
    if table is None:
        if len(cameras) > 1:
            raise InputError(
                f"A calibration of one camera, or of a rig, was expected, found {len(cameras)} cameras that are in none; give "
                "`poses` with the camera of every photo."
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
                f"{listed(cameras)}."
            )
    if len(cameras) > 1 and table.cameras is None:
        raise InputError("The camera of every photo was expected in poses.csv, found none; fill in the column camera.")
    return known


def _file_name(photo: str, face: str) -> str:
    stem = PurePosixPath(photo).with_suffix("")
    return f"{stem}_{face}.png" if face else f"{stem}.png"


def _poses_of_views(view: str, cameras: Calibration, table: ImagePoses, made: Sequence[OneView]) -> ImagePoses:
    row = {image: k for k, image in enumerate(table.images)}
    source = table.cam_from_world[[row[one.photos[0].name] for one in made]]
    turn = torch.as_tensor(np.stack([view_from_camera(cameras[one.cameras[0]], one.target) for one in made]))
    turned = Pose(turn @ source.rotation, (turn @ source.translation[..., None])[..., 0])
    frames = None if table.frames is None else tuple(table.frames[row[one.photos[0].name]] for one in made)
    return ImagePoses(tuple(one.name for one in made), turned, (view,) * len(made), None, frames)
