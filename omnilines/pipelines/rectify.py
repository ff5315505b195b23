"""Photos resampled into perspective, cylindrical, panoramic and cube views, with their cameras and poses: `rectify`.

Of a rig without poses, the photos of one instant become one view, from the middle of the rig.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt

from camera_models import Calibration, CameraModel, InputError, load, save
from camera_models.blending import BlendedGrid, axis_from_rig, blended, blended_grid
from camera_models.formats.forms import listed
from camera_models.pose import Pose
from camera_models.resampling import SamplingGrid, sampling_grid
from camera_models.views import View, axis_from_camera, views
from omnilines.files import Photo, PhotoRef, Photos, photos_of, write_png, write_poses
from omnilines.files.colmap_scene import COLMAP_FILES, check_colmap_folder, write_colmap_scene
from omnilines.files.folders import written
from omnilines.files.sets import claimed, settle
from omnilines.pipelines.arcs import calibration_of, cameras_of_photos
from omnilines.pipelines.detect_rig import frame_of
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import ImagePoses

COLMAP_VIEWS = ("perspective", "cube")
"""Of which a COLMAP model is written."""


@dataclass(frozen=True)
class OneView:
    """A view of a photo, or of the photos that a rig took at one instant."""

    name: str
    """The file that it is written to."""
    photos: tuple[Photo, ...]
    """One, or those of an instant of a rig."""
    cameras: tuple[str, ...]
    """Of the photos."""
    target: View


@dataclass(frozen=True)
class RectifiedViews:
    """Views of photos; pixels are made when they are asked for, so that one photo is in memory at a time."""

    view: str
    photos: tuple[Photo, ...]
    views: tuple[OneView, ...]
    camera: CameraModel
    """Of all views."""
    grids: Mapping[tuple[tuple[str, ...], str], BlendedGrid] = field(repr=False)
    """Of each camera, or cameras, and face."""
    poses: ImagePoses | None = None
    """Of the views, by name, where those of the photos were given."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What the views were made from."""

    def __len__(self) -> int:
        return len(self.views)

    @property
    def provenance(self) -> dict[str, Any]:
        """Software, and what the views were made from."""
        return provenance(self.inputs)

    @property
    def shown_share(self) -> dict[tuple[tuple[str, ...], str], float]:
        """Share of a view that the photos of a camera, or of several, show, by cameras and face."""
        return {key: grid.shown_share for key, grid in self.grids.items()}

    def pixels(self, progress: ProgressCallback = silent) -> Iterator[tuple[str, UInt[np.ndarray, "h w *channels"]]]:
        """Name and pixels of every view; what the photo does not show is black. Raises InputError where a photo is none."""
        progress("resampling photos", 0, len(self.views))
        read: tuple[Photo, ...] = ()
        images: list[np.ndarray] = []
        for k, one in enumerate(self.views):
            if one.photos != read:
                read, images = one.photos, [photo.read() for photo in one.photos]
            yield one.name, blended(images, self.grids[one.cameras, one.target.name])
            progress("resampling photos", k + 1, len(self.views))

    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the views (PNG), calibration.yaml and, where poses are known, poses.csv and for perspective views a COLMAP model
        into a folder, which is made; the files written. Raises InputError where the folder holds parts of another model."""
        if self._colmap:
            check_colmap_folder(Path(folder) / "colmap", [photo.name for photo in self.photos])
        photos = [photo.path for photo in self.photos if isinstance(photo, PhotoRef)]
        with claimed(folder, self.file_names, photos, by="rectify", kept=self.views_that_stay(folder)) as out:
            for name, pixels in self.pixels(progress):
                write_png(out / name, pixels)
            save(out / "calibration.yaml", Calibration({self.view: self.camera}, provenance=self.provenance))
            if self.poses is not None:
                write_poses(out / "poses.csv", self.poses)
            if self._colmap and self.poses is not None:
                write_colmap_scene(out / "colmap", {self.view: self.camera}, self.poses)
        return tuple(out / name for name in self.file_names)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        poses = ("poses.csv",) if self.poses is not None else ()
        colmap = tuple(f"colmap/{name}" for name in COLMAP_FILES) if self._colmap else ()
        return (*(one.name for one in self.views), "calibration.yaml", *poses, *colmap)

    @property
    def _colmap(self) -> bool:
        return self.poses is not None and self.view in COLMAP_VIEWS

    def views_that_stay(self, folder: str | Path) -> tuple[str, ...]:
        """Views of other photos by the same camera, which an earlier run wrote into a folder: photos may be given one by one."""
        settle(Path(folder))
        try:
            earlier = load(Path(folder) / "calibration.yaml")[self.view]
        except (InputError, KeyError):
            return ()
        if (earlier.NAME, earlier.image_size) != (self.camera.NAME, self.camera.image_size):
            return ()
        same = torch.equal(earlier.parameters, self.camera.parameters)
        return tuple(name for name in written(folder) if same and Path(name).suffix == ".png")


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
    inputs: Mapping[str, Any] | None = None,
) -> RectifiedViews:
    """Perspective, cylindrical, panorama or cube views of photos, and where they look from.

    `view`, `size` (px), `fov_deg`, `yaw_deg` and `pitch_deg` are those of `camera_models.views.views`. Of several cameras, the
    poses say which one a photo is of; they must name every photo. Photos of a rig without poses, in folders named like its
    cameras, are taken together: those of one file name become one view from the middle of the rig, blended where two cameras
    look equally much that way; what lies at `distance_m` (default: far away) is without parallax there. `inputs` is what the
    views say that they were made from.

    Raises InputError on photos, poses and options that are not what they have to be.

        >>> views = ol.rectify("room/", ol.load("room/calibration.yaml"), "cube", size=(100, 100))
        >>> len(views), {pixels.shape for _, pixels in views.pixels()}
        (36, {(100, 100, 3)})
    """
    cameras, found = calibration_of(camera), photos_of(photos)
    table = poses.poses if isinstance(poses, PhotoPoses) else poses
    targets = views(view, size, fov_deg, yaw_deg, pitch_deg)
    together = table is None and len(cameras.rig) > 1
    if distance_m is not None and not together:
        raise InputError("`distance_m` counts with the photos of a rig, without `poses`; found it otherwise: leave it out.")
    if together:
        groups = _instants(found, cameras_of_photos(found, cameras))
    else:
        of_photo = _cameras_of_photos(found, cameras, table)
        groups = {photo.name: {of_photo[photo.name]: photo} for photo in found}
    made = tuple(
        OneView(_file_name(name, target.name), tuple(own.values()), tuple(own), target)
        for name, own in groups.items()
        for target in targets
    )
    grids = {}
    for one in made:
        if (key := (one.cameras, one.target.name)) not in grids:
            grids[key] = (
                _rig_grid(cameras, one, math.inf if distance_m is None else distance_m)
                if together
                else BlendedGrid.of(_grid(cameras[one.cameras[0]], one.target))
            )
    its = None if table is None else _poses_of_views(view, cameras, table, made)
    asked = {"view": view, "fov_deg": fov_deg, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "distance_m": distance_m}
    return RectifiedViews(view, tuple(found), made, targets[0].camera, grids, its, asked if inputs is None else inputs)


def _instants(photos: Sequence[Photo], camera_of: Mapping[str, str]) -> dict[str, dict[str, Photo]]:
    """The photos of a rig by instant and camera. Raises InputError where a camera has two of one instant."""
    found: dict[str, dict[str, Photo]] = {}
    for photo in photos:
        path = PurePosixPath(photo.name)
        own = found.setdefault(frame_of(path) if len(path.parts) > 1 else path.stem, {})
        if (camera := camera_of[photo.name]) in own:
            raise InputError(
                f"One photo of camera {camera} was expected an instant, found {own[camera].name} and {photo.name}; rename it."
            )
        own[camera] = photo
    return found


def _rig_grid(cameras: Calibration, one: OneView, distance_m: float) -> BlendedGrid:
    mounted = [cameras.rig[name].cam_from_rig for name in cameras.rig]
    whole = Pose(torch.stack([pose.rotation for pose in mounted]), torch.stack([pose.translation for pose in mounted]))
    axis = axis_from_rig([cameras[name] for name in cameras.rig], whole)
    chosen = [list(cameras.rig).index(name) for name in one.cameras]
    return blended_grid(one.target, [cameras[name] for name in one.cameras], whole[chosen] @ axis.inverse(), distance_m)


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


def _grid(camera: CameraModel, target: View) -> SamplingGrid:
    return sampling_grid(target.camera, camera, _turn(camera, target).T)


def _turn(camera: CameraModel, target: View) -> np.ndarray:
    """view_from_cam."""
    return target.view_from_axis @ axis_from_camera(camera)


def _file_name(photo: str, face: str) -> str:
    stem = PurePosixPath(photo).with_suffix("")
    return f"{stem}_{face}.png" if face else f"{stem}.png"


def _poses_of_views(view: str, cameras: Calibration, table: ImagePoses, made: Sequence[OneView]) -> ImagePoses:
    row = {image: k for k, image in enumerate(table.images)}
    source = table.cam_from_world[[row[one.photos[0].name] for one in made]]
    turn = torch.as_tensor(np.stack([_turn(cameras[one.cameras[0]], one.target) for one in made]))
    turned = Pose(turn @ source.rotation, (turn @ source.translation[..., None])[..., 0])
    frames = None if table.frames is None else tuple(table.frames[row[one.photos[0].name]] for one in made)
    return ImagePoses(tuple(one.name for one in made), turned, (view,) * len(made), None, frames)
