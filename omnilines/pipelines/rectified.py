"""Views resampled from photos, made when they are asked for: what `rectify` returns, and its files."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt

from camera_models import Calibration, CameraModel, InputError, load, save
from camera_models.blending import BlendedGrid, axis_from_rig, blended, blended_grid
from camera_models.pose import Pose
from camera_models.resampling import SamplingGrid, sampling_grid
from camera_models.typed import typed
from camera_models.views import View, axis_from_camera
from omnilines.files import Photo, PhotoRef, write_png, write_poses
from omnilines.files.colmap_scene import COLMAP_FILES, check_colmap_folder, write_colmap_scene
from omnilines.files.folders import written
from omnilines.files.levels import LevelRow, read_levels, write_levels
from omnilines.files.sets import claimed, settle
from omnilines.pipelines.upright import Level
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import Detail, ImagePoses

LEVELS = "upright.csv"
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
    """Turned from the optical axis, or from level."""
    level: Level | None = None
    """By which the photos are turned upright, where that was asked for."""


@dataclass(frozen=True)
class RectifiedViews:
    """Views of photos; pixels are made when they are asked for, so that one photo is in memory at a time."""

    view: str
    photos: tuple[Photo, ...]
    views: tuple[OneView, ...]
    camera: CameraModel
    """Of all views."""
    grids: "Grids" = field(repr=False)
    """Where the pixels of each view lie in its photos."""
    poses: ImagePoses | None = None
    """Of the views, by name, where those of the photos were given."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What the views were made from."""
    left_out: tuple[Detail, ...] = ()
    """Photos that cannot be used, and those that show no vertical where upright views were asked for."""

    def __repr__(self) -> str:
        return f"RectifiedViews({self.view!r}, views={len(self)}, photos={len(self.photos)}, {self.camera})"

    def __len__(self) -> int:
        return len(self.views)

    @property
    def provenance(self) -> dict[str, Any]:
        """Software, and what the views were made from."""
        return provenance(self.inputs)

    @property
    def shown_share(self) -> dict[str, float]:
        """Share of each view that its photos show, by its name."""
        return {one.name: self.grids.shown_share(one) for one in self.views}

    def pixels(self, progress: ProgressCallback = silent) -> Iterator[tuple[str, UInt[np.ndarray, "h w *channels"]]]:
        """Name and pixels of every view; what the photo does not show is black. Raises InputError where a photo is none."""
        progress("resampling photos", 0, len(self.views))
        read: tuple[Photo, ...] = ()
        images: list[np.ndarray] = []
        for k, one in enumerate(self.views):
            if one.photos != read:
                read, images = one.photos, [photo.read() for photo in one.photos]
            yield one.name, blended(images, self.grids.of(one))
            progress("resampling photos", k + 1, len(self.views))

    @typed
    def save(self, folder: str | Path, progress: ProgressCallback = silent) -> tuple[Path, ...]:
        """Write the views (PNG), calibration.yaml, of upright views upright.csv and, where poses are known, poses.csv and for
        perspective views a COLMAP model into a folder, which is made; the files written. Raises InputError where the folder holds
        parts of another model."""
        if self._colmap:
            check_colmap_folder(Path(folder) / "colmap", [photo.name for photo in self.photos])
        photos = [photo.path for photo in self.photos if isinstance(photo, PhotoRef)]
        levels, names = self._levels(Path(folder)), self.names_in(folder)
        with claimed(folder, names, photos, by="rectify", kept=self.views_that_stay(folder)) as out:
            for name, pixels in self.pixels(progress):
                write_png(out / name, pixels)
            save(out / "calibration.yaml", Calibration({self.view: self.camera}, provenance=self.provenance))
            if levels:
                write_levels(out / LEVELS, levels)
            if self.poses is not None:
                write_poses(out / "poses.csv", self.poses)
            if self._colmap and self.poses is not None:
                write_colmap_scene(out / "colmap", {self.view: self.camera}, self.poses)
        return tuple(out / name for name in names)

    def names_in(self, folder: str | Path) -> tuple[str, ...]:
        """Of the files that `save` writes into a folder."""
        poses = ("poses.csv",) if self.poses is not None else ()
        colmap = tuple(f"colmap/{name}" for name in COLMAP_FILES) if self._colmap else ()
        levels = (LEVELS,) if self._levels(Path(folder)) else ()
        return (*(one.name for one in self.views), "calibration.yaml", *levels, *poses, *colmap)

    def _levels(self, folder: Path) -> list[LevelRow]:
        """How upright views are turned: these, and those of an earlier run that stay."""
        own = [_level_row(one, one.level, self.grids) for one in self.views if one.level is not None]
        stay = set(self.views_that_stay(folder)) - {one.name for one in self.views}
        known = stay and LEVELS in written(folder) and (folder / LEVELS).is_file()
        return [*(row for row in read_levels(folder / LEVELS) if row.image in stay), *own] if known else own

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


@dataclass(frozen=True)
class Grids:
    """Where the pixels of views lie in their photos: one grid for all that look through the same cameras at the same face; of
    upright views, each of which is turned by itself, one is made when it is asked for."""

    cameras: Calibration
    distance_m: float | None
    """Of what has no parallax in the photos of a rig, which are taken together; None for photos by themselves."""
    known: dict[tuple[tuple[str, ...], str], BlendedGrid] = field(default_factory=dict)
    shown: dict[str, float] = field(default_factory=dict)

    def of(self, one: OneView) -> BlendedGrid:
        """The grid of a view."""
        key = (one.cameras, one.target.name)
        grid = self.known[key] if key in self.known and one.level is None else self._made(one)
        if one.level is None:
            self.known[key] = grid
        self.shown[one.name] = grid.shown_share
        return grid

    def shown_share(self, one: OneView) -> float:
        """Share of a view that its photos show."""
        return self.shown[one.name] if one.name in self.shown else self.of(one).shown_share

    def _made(self, one: OneView) -> BlendedGrid:
        if self.distance_m is not None:
            return _rig_grid(self.cameras, one, self.distance_m)
        return BlendedGrid.of(_grid(self.cameras[one.cameras[0]], one.target))


def _level_row(one: OneView, level: Level, grids: Grids) -> LevelRow:
    """How an upright view is turned: of a rig, from its first camera."""
    first = one.cameras[0] if grids.distance_m is None else next(iter(grids.cameras.rig))
    turn = one.target.view_from_axis @ level.level_from_axis.T
    covariance = turn @ level.covariance @ turn.T
    return LevelRow(one.name, view_from_camera(grids.cameras[first], one.target), covariance, level.tilt_rad, level.arcs)


def _rig_grid(cameras: Calibration, one: OneView, distance_m: float) -> BlendedGrid:
    chosen = [list(cameras.rig).index(name) for name in one.cameras]
    return blended_grid(one.target, [cameras[name] for name in one.cameras], cam_from_axis(cameras)[chosen], distance_m)


def cam_from_axis(cameras: Calibration) -> Pose:
    """The cameras of a rig from the frame that its views are turned in."""
    mounted = [cameras.rig[name].cam_from_rig for name in cameras.rig]
    whole = Pose(torch.stack([pose.rotation for pose in mounted]), torch.stack([pose.translation for pose in mounted]))
    return whole @ axis_from_rig([cameras[name] for name in cameras.rig], whole).inverse()


def _grid(camera: CameraModel, target: View) -> SamplingGrid:
    return sampling_grid(target.camera, camera, view_from_camera(camera, target).T)


def view_from_camera(camera: CameraModel, target: View) -> np.ndarray:
    """Rotation from the frame of a camera to that of a view."""
    return target.view_from_axis @ axis_from_camera(camera)
