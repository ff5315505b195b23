"""Corners of a target by several cameras -> the calibrated rig, which in photos leads to corners that were missed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Unpack

import numpy as np
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError, model_class, save
from camera_models.formats.calibration_data import RigCamera
from omnilines.calibration.options import AUTO, CalibrationFields, CalibrationOptions
from omnilines.calibration.record import calibration_record, rig_record
from omnilines.calibration.rig import calibrate as joint
from omnilines.calibration.rig.alone import CameraSetup
from omnilines.calibration.rig.result import RigCalibration
from omnilines.calibration.rig.views import BOARDS
from omnilines.files import write_corners
from omnilines.files.folders import output_folder
from omnilines.least_squares import Progress
from omnilines.pipelines.detect_rig import RigCorners
from omnilines.pipelines.rig_search import searched_with_rig
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners, ViewResult


@dataclass(frozen=True)
class RigSetup:
    """What is to be done with the cameras of a rig. Raises InputError where it cannot work, before any photo is looked at."""

    options: CalibrationOptions
    models: Mapping[str, str]
    boards: str
    start: Mapping[str, CameraModel]
    hold: bool

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

    def axis_sign_open(self, camera: str) -> bool:
        """Whether the camera may turn out to look to either side."""
        model = self.model_of(camera)
        return model == AUTO or model_class(model).AXIS_SIGN_OPEN

    def require_cameras(self, cameras: Sequence[str]) -> None:
        """Raises InputError where a model, or all calibrations to begin from, are of none of these cameras."""
        for kind, names in (("`models`", self.models), ("`start`", self.start)):
            unknown = [name for name in names if name and name not in cameras]
            if unknown and not (kind == "`start`" and set(names) & set(cameras)):
                raise InputError(
                    f"{kind}: cameras among {', '.join(cameras)} were expected, found '{unknown[0]}'; correct the name."
                )

    def require_photos(self) -> None:
        """Raises InputError where photos cannot give what is asked for."""
        if self.boards == "known":
            raise InputError(
                "`boards` known was expected with a corners.csv that has all boards in one frame, found photos; give fixed or "
                "moving."
            )

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
            found[name] = CameraSetup(size, self.model_of(name), self.options.of_model, start, hold, self.options.mirror)
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

    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `calibration.yaml`, `corners.csv`, `covariance.npz` and, for each camera that is not of the rig but could be
        calibrated alone, `calibration-NAME.yaml` into a folder, which is made if absent; returns the files."""
        home = output_folder(folder)
        files = [home / name for name in ("calibration.yaml", "corners.csv", "covariance.npz")]
        save(files[0], self.calibration)
        write_corners(files[1], self.fit.as_given()[0])
        np.savez(files[2], name=np.array(self.names), covariance=self.covariance)
        for name, single in self.fit.left_out_alone.items():
            files.append(home / f"calibration-{name}.yaml")
            save(files[-1], calibration_record(single, False, self.found.inputs))
        return tuple(files)

    def report(self, path: str | Path) -> Path:
        """Write the page that shows all of it, with photos where they are files, and return its path."""
        from omnilines.pages.rig import write_rig_page

        return write_rig_page(self, path)


def calibrate_rig(
    corners: RigCorners | Corners,
    image_size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    models: Mapping[str, str] | None = None,
    boards: str = "fixed",
    start: Mapping[str, CameraModel] | None = None,
    hold: bool = False,
    progress: ProgressCallback = silent,
    **fields: Unpack[CalibrationFields],
) -> RigResult:
    """Calibrate cameras that are mounted together, of any models, in one joint adjustment.

    `corners` are what `detect_rig` found: then the rig leads to corners and boards that were missed, and is calibrated once more.
    Or they are a table whose views name camera (and frame, board); then `image_size` is needed, one (width, height) or by
    camera. `models` are those of single cameras, by name; fields of the options, of all cameras, may be given by name. Several
    boards are "fixed" to each other, "known" (their coordinates have one frame) or "moving" by themselves. `start` are known
    cameras by name to begin from; `hold` holds their parameters.

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
    setup = RigSetup(replace(options, **fields), models or {}, boards, start or {}, hold)
    if not isinstance(corners, RigCorners):
        if image_size is None:
            raise InputError("`image_size` was expected beside a table of corners, found none; give (width, height).")
        corners = RigCorners.of_table(corners, {"": image_size} if isinstance(image_size, tuple) else image_size)
    if corners.cameras:
        setup.require_photos()
    found, result = corners, _fitted(corners, setup, progress)
    again = searched_with_rig(found, result, progress)
    if again is not None:
        found, result = again, _fitted(again, setup, progress)
    remarks = found.remarks
    views = tuple(
        replace(view, remarks=(*view.remarks, remarks[view.name])) if view.used and view.name in remarks else view
        for view in result.views
    )
    result = replace(result, views=views + found.skipped, notes=found.notes + result.notes)
    return RigResult(result, found, rig_record(result, found.inputs))


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
        thresholds=setup.options,
        callback=tell,
    )
