"""Corners of a target by several cameras -> the calibrated rig, which in photos leads to corners that were missed."""

import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Unpack

import numpy as np
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError, model_class, save
from camera_models.formats.calibration_data import RigCamera
from camera_models.formats.disk import write_atomically
from camera_models.typed import typed
from omnilines.calibration.next_pose import NextViews
from omnilines.calibration.options import AUTO, CalibrationFields, CalibrationOptions
from omnilines.calibration.record import calibration_record, rig_record
from omnilines.calibration.rig import calibrate as joint
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.one_camera import one_camera
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.views import BOARDS
from omnilines.calibration.thresholds import ShootingThresholds
from omnilines.files import write_corners
from omnilines.files.sets import claimed
from omnilines.least_squares import Progress
from omnilines.options import require_ranges
from omnilines.pipelines.line_delay import require_times
from omnilines.pipelines.next_views import next_views_of
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.rig_copies import rig_without_copies
from omnilines.pipelines.rig_corners import RigCorners, require_all_named
from omnilines.pipelines.rig_search import searched_with_rig
from omnilines.pipelines.seen_boards import before_geometry
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners, ViewResult

RIG_FILES = ("calibration.yaml", "corners.csv", "covariance.npz")


@dataclass(frozen=True)
class RigSetup:
    """What is to be done with the cameras of a rig. Raises InputError where it cannot work, before any photo is looked at."""

    options: CalibrationOptions
    models: Mapping[str, str]
    boards: str
    start: Mapping[str, CameraModel]
    hold: bool
    time_offsets: bool = False
    chosen: Mapping[str, str] = field(default_factory=dict)
    """Why models were chosen before, a sentence by camera."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        for name in self.models.values():
            if name != AUTO:
                model_class(name)
        if self.boards not in BOARDS:
            raise InputError(f"`boards` is one of {', '.join(BOARDS)}, found '{self.boards}'; choose one of these.")
        if self.hold and not self.start:
            raise InputError("`hold` holds the cameras of `start`, found no `start`; give their calibration.")

    def model_of(self, camera: str) -> str:
        """The camera model that is to be fitted."""
        return self.models.get(camera, self.models.get("", self.options.model))

    def as_chosen(self, result: RigCalibration, cameras: Iterable[str]) -> "RigSetup":
        """With the models that were chosen for these cameras, where none was named."""
        chosen = {one.name: one.model.NAME for one in result.members if self.model_of(one.name) == AUTO}
        models = {name: chosen[name] for name in cameras if name in chosen and name not in self.start}
        reasons = {one.name: one.chosen for one in result.members if one.name in models}
        return replace(self, models={**self.models, **models}, chosen=reasons)

    def axis_sign_open(self, camera: str) -> bool:
        """Whether the camera may turn out to look to either side."""
        model = self.model_of(camera)
        return model == AUTO or model_class(model).AXIS_SIGN_OPEN

    def require_cameras(self, cameras: Sequence[str]) -> None:
        """Raises InputError where a model, or all calibrations to begin from, are of none of these cameras."""
        require_all_named("`models`", self.models, cameras)
        if self.start and not set(self.start) & set(cameras):
            require_all_named("`start`", self.start, cameras)
        known = [name for name in cameras if name in self.start]
        for name in known:
            asked = self.models.get(name, self.models.get("") if len(known) == len(cameras) else None)
            if asked not in (None, self.start[name].NAME):
                raise InputError(
                    f"`models`: camera {name} begins from `start`, with the model {self.start[name].NAME}, found {asked}; leave "
                    "one of them out."
                )
        self.options.require_of_models([self.model_of(name) for name in cameras if name not in known])

    def require_photos(self) -> None:
        """Raises InputError where photos cannot give what is asked for."""
        if self.boards == "known":
            raise InputError(
                "`boards` known was expected with a corners.csv that has all boards in one frame, found photos; give fixed or "
                "moving."
            )

    def require(self, image_sizes: Mapping[str, tuple[int, int]]) -> None:
        """Raises InputError where cameras of these sizes, whose photos are still to be read, cannot give what is asked for."""
        self.require_photos()
        self.cameras(image_sizes)

    def cameras(self, image_sizes: Mapping[str, tuple[int, int]]) -> dict[str, CameraSetup]:
        """Camera by camera. Raises InputError where a name or an image size does not fit."""
        self.require_cameras(tuple(image_sizes))
        found = {}
        for name, size in image_sizes.items():
            start = self.start.get(name)
            if start is not None and start.image_size != size:
                raise InputError(
                    f"`start`: camera {name} was expected with images of {size[0]}x{size[1]} px, found "
                    f"{start.image_size[0]}x{start.image_size[1]} px; give the calibration of these photos."
                )
            hold = self.hold and start is not None
            found[name] = CameraSetup(
                size, self.model_of(name), self.options.of_model, start, hold, self.options.mirror, self.chosen.get(name, "")
            )
        return found


@dataclass(frozen=True, eq=False)
class RigResult:
    """Calibrated cameras and where they stand, how certain all of it is together, and what it was made from."""

    fit: RigCalibration
    """All figures of the fit."""
    found: RigCorners
    """The corners that it was fitted to, and their photos."""
    calibration: Calibration
    """Cameras and rig with their uncertainty, views and provenance: what `calibration.yaml` holds."""
    shooting: ShootingThresholds = ShootingThresholds()

    def __repr__(self) -> str:
        used = sum(view.used for view in self.views)
        names = ", ".join(self.cameras)
        return f"RigResult({names}, views={used} of {len(self.views)}, rms_px_per_axis={self.rms_px_per_axis:.3g})"

    @cached_property
    def next_views(self) -> dict[str, NextViews]:
        """What limits each camera that was estimated, by name, and what to shoot next with it."""
        photos = {item.camera: item.found.photos for item in self.found.cameras}
        advice: dict[str, NextViews] = {}
        for member in self.fit.members:
            single, corners = one_camera(self.fit, member)
            found = next_views_of(single, corners, photos.get(member.name, ()), thresholds=self.shooting)
            advice |= {} if found is None else {member.name: found}
        return advice

    @property
    def cameras(self) -> dict[str, CameraModel]:
        """The cameras by name."""
        return dict(self.calibration)

    @property
    def rig(self) -> Mapping[str, RigCamera]:
        """Where the cameras are in the frame of the first, by name; empty where only one is of the rig."""
        return self.calibration.rig

    @property
    def names(self) -> tuple[str, ...]:
        """What each row of `covariance` is."""
        return self.fit.names

    @property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        """Of all parameters, camera poses but the first, and free boards, together."""
        return self.fit.covariance

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """What became of each view of each camera."""
        return self.fit.views

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of the calibration, one sentence each."""
        return self.fit.notes

    @property
    def rms_px_per_axis(self) -> float:
        """Root mean square of the residuals' components (px)."""
        return self.fit.rms_px_per_axis

    @property
    def rms_px_per_point(self) -> float:
        """Root mean square of the residuals' lengths (px)."""
        return self.fit.rms_px_per_point

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `calibration.yaml`, `corners.csv`, `covariance.npz` and, for each camera that is not of the rig but could be
        calibrated alone, `calibration-NAME.yaml` into a folder, which is made if absent; returns the files."""
        with claimed(folder, self.file_names, by="calibrate") as home:
            files = [home / name for name in self.file_names]
            save(files[0], self.calibration)
            write_corners(files[1], self.fit.as_given()[0])
            archive = io.BytesIO()
            np.savez(archive, name=np.array(self.names), covariance=self.covariance)
            write_atomically(files[2], archive.getvalue())
            for path, single in zip(files[3:], self.fit.left_out_alone.values(), strict=True):
                save(path, calibration_record(single, False, self.found.inputs))
        return tuple(files)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return (*RIG_FILES, *(f"calibration-{name}.yaml" for name in self.fit.left_out_alone))

    @typed
    def report(self, path: str | Path, *, plots: str | Path | None = None) -> Path:
        """Write the page that shows all of it, with photos where they are files, and return its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.rig import write_rig_page

        with claimed_report(path, plots):
            return write_rig_page(self, path)


@typed
def calibrate_rig(
    corners: RigCorners | Corners,
    image_size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    models: Mapping[str, str] | None = None,
    boards: str = "fixed",
    start: Mapping[str, CameraModel] | None = None,
    hold: bool = False,
    time_offsets: bool = False,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
    **fields: Unpack[CalibrationFields],
) -> RigResult:
    """Calibrate cameras that are mounted together, of any models, in one joint adjustment.

    `corners` are what `detect_rig` found: then the rig leads to corners and boards that were missed, and is calibrated once more.
    Or they are a table whose views name camera (and frame, board); then `image_size` is needed, one (width, height) or by
    camera. `models` are those of single cameras, by name; fields of the options, of all cameras, may be given by name. Several
    boards are "fixed" to each other, "known" (their coordinates have one frame) or "moving" by themselves. `start` are known
    cameras by name to begin from; `hold` holds their parameters. Where frames have times (of videos, or a table's `times_s`) and
    the cameras contradict each other, the offset of each camera's clock is estimated; with `time_offsets` always. With
    `rolling_shutter` the line delay of each camera is estimated too; the pose of a view is then that at its middle row.
    `executor` as in `calibrate`.

    Raises InputError for options that do not fit, and GeometryError where no two cameras hang together or the data leave the rig
    open.

        >>> found = ol.detect_rig("rig/", "checkerboard:8x6:30mm")
        >>> result = ol.calibrate_rig(found, model="opencv-fisheye")
        >>> list(result.cameras), result.rms_px_per_axis < 0.1
        (['left', 'right'], True)
        >>> round(float(result.rig["right"].cam_from_rig.centre[0]), 3)
        0.1
        >>> [path.name for path in result.save("rig_result")]
        ['calibration.yaml', 'corners.csv', 'covariance.npz']
    """
    setup = RigSetup(replace(options, **fields), models or {}, boards, start or {}, hold, time_offsets)
    require_ranges(setup.options)
    if isinstance(corners, RigCorners):
        if image_size is not None:
            raise InputError("`image_size` was expected with a table of corners only, found it with photos; leave it out.")
    else:
        if image_size is None:
            raise InputError("`image_size` was expected beside a table of corners, found none; give (width, height).")
        corners = RigCorners.of_table(corners, {"": image_size} if isinstance(image_size, tuple) else image_size)
    if corners.cameras:
        setup.require_photos()
    if time_offsets and corners.corners.times_s is None:
        raise InputError(
            "`time_offsets` compares cameras by when their frames were taken, found no times; give videos, or a table with a "
            "column time_s."
        )
    if setup.options.rolling_shutter:
        require_times(corners.corners)
    thresholds = setup.options
    least = {name: 1 if name in setup.start else thresholds.views.least_views for name in corners.image_sizes}
    # Of several boards each may show the tags of another.
    one_board = len({item.pattern for item in corners.cameras}) == 1
    with before_geometry({item.camera: item.found for item in corners.cameras} if one_board else {}, progress):
        found = rig_without_copies(corners, least, thresholds.duplicates, in_cameras=not thresholds.rolling_shutter)
        result = _fitted(found, setup, progress)
    again = searched_with_rig(found, result, executor, progress)
    if again is not None:
        # The same corners, a little nearer to where they are, choose no other model.
        before, now = (_corners_of_cameras(one.corners) for one in (found, again))
        setup_again = setup.as_chosen(result, [name for name in found.image_sizes if now[name] <= before[name]])
        found, result = again, _fitted(again, setup_again, progress)
    remarks = found.remarks
    views = tuple(
        replace(view, remarks=(*view.remarks, remarks[view.name])) if view.used and view.name in remarks else view
        for view in result.views
    )
    left_out = {**result.left_out, **found.blind}
    result = replace(result, views=views + found.skipped, notes=found.notes + result.notes, left_out=left_out)
    return RigResult(result, found, rig_record(result, found.inputs), setup.options.shooting)


def _corners_of_cameras(corners: Corners) -> Counter[str]:
    """How many corners each camera has."""
    cameras = np.array(corners.cameras or ())
    return Counter(cameras[corners.view].tolist())


def _fitted(found: RigCorners, setup: RigSetup, progress: ProgressCallback) -> RigCalibration:
    def tell(stage: str, step: Progress) -> None:
        progress(stage, step.iteration, 0)

    return joint.calibrate_rig(
        found.corners,
        setup.cameras(found.image_sizes),
        relation=setup.boards,
        loss=setup.options.loss,
        numberings=found.numberings,
        seen_from_front=found.seen_from_front,
        refine_board=setup.options.refine_board,
        time_offsets=setup.time_offsets,
        rolling_shutter=setup.options.rolling_shutter,
        thresholds=setup.options,
        callback=tell,
    )
