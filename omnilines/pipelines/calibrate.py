"""Corners of a target -> a calibrated camera; in photos the camera leads to corners that were missed, and is calibrated anew."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, CameraModel, InputError, save
from camera_models.typed import typed
from omnilines.calibration.diagnose import has_blind_centre
from omnilines.calibration.duplicates import duplicate_views
from omnilines.calibration.line_delay import LineDelay
from omnilines.calibration.next_pose import NextViews
from omnilines.calibration.options import AUTO, CalibrationFields, CalibrationOptions
from omnilines.calibration.record import calibration_record
from omnilines.calibration.result import CameraCalibration, with_remarks
from omnilines.calibration.select import Selection, select_model
from omnilines.calibration.single import calibrate_camera
from omnilines.calibration.thresholds import DuplicateThresholds, ShootingThresholds
from omnilines.files.sets import claimed
from omnilines.least_squares import Progress
from omnilines.pipelines.batches import one_by_one
from omnilines.pipelines.copies import corners_without_copies
from omnilines.pipelines.detect import search_again
from omnilines.pipelines.line_delay import require_close, timed, with_line_delay
from omnilines.pipelines.next_views import next_views_of
from omnilines.pipelines.pages import claimed_report
from omnilines.pipelines.photo_corners import CORNERS, PhotoCorners
from omnilines.pipelines.seen_boards import before_geometry
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Corners, Detail, ViewResult

CALIBRATION_FILES = ("calibration.yaml", CORNERS)
GUIDE = "scaramuzza"
"""The model that leads to more corners where the user has not chosen one: it fits lenses of every width, and mirrors."""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibrated camera, how certain it is, and what it was made from."""

    fit: CameraCalibration
    """All figures of the fit."""
    found: PhotoCorners
    """The corners that it was fitted to, and their photos."""
    calibration: Calibration
    """The camera with its uncertainty, views and provenance: what `calibration.yaml` holds."""
    selection: Selection | None = None
    """How the camera models compare, where the model was chosen."""
    shooting: ShootingThresholds = ShootingThresholds()

    def __repr__(self) -> str:
        used = sum(view.used for view in self.views)
        return f"CalibrationResult({self.camera}, views={used} of {len(self.views)}, rms_px_per_axis={self.rms_px_per_axis:.3g})"

    @cached_property
    def next_views(self) -> NextViews | None:
        """What limits the calibration, and what to shoot next; None where nothing was estimated."""
        return next_views_of(self.fit, self.found.corners, self.found.photos, self.found.pattern, self.shooting)

    @property
    def line_delay(self) -> LineDelay | None:
        """Of a rolling shutter that was recognised or estimated."""
        return self.fit.line_delay

    @property
    def camera(self) -> CameraModel:
        """The camera."""
        return self.fit.model

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation of each parameter."""
        return self.fit.sigma

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Of the parameters in the order of `camera.PARAMETER_NAMES`."""
        return self.fit.covariance

    @property
    def views(self) -> tuple[ViewResult, ...]:
        """What became of each view; those of photos without corners are last."""
        return self.fit.views

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of the calibration, one sentence each."""
        return self.fit.notes

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of `notes`, and why the model was chosen."""
        return (*self.notes, *(() if self.selection is None else (self.selection.reason,)))

    @property
    def details(self) -> tuple[Detail, ...]:
        """Why views were left out, and what is to be said of others."""
        return view_details(self.views)

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
        """Write `calibration.yaml` and `corners.csv` into a folder, which is made if absent; returns the files."""
        with claimed(folder, self.file_names, by="calibrate") as out:
            save(out / "calibration.yaml", self.calibration)
            self.found.save(out)
        return tuple(out / name for name in self.file_names)

    @property
    def file_names(self) -> tuple[str, ...]:
        """Of what `save` writes."""
        return CALIBRATION_FILES

    @typed
    def report(self, path: str | Path, *, plots: str | Path | None = None) -> Path:
        """Write the page that shows all of it, with the photos where they are files, and return its path. Its figures
        are written as PNG and SVG into the folder `plots`, where one is given."""
        from omnilines.pages.calibration import write_calibration_page

        with claimed_report(path, plots):
            return write_calibration_page(self, path)


def calibrate_corners(
    corners: PhotoCorners | Corners | Mapping[str, tuple[Any, Any]],
    image_size: tuple[int, int] | None = None,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
    **fields: Unpack[CalibrationFields],
) -> CalibrationResult:
    """`calibrate_one.calibrate` of corners.

    Those that `detect` found have photos: then the camera leads to corners and photos that were missed, and is calibrated anew,
    until nothing is gained. Where frames follow one another closely (of a video, or a table with `times_s`) a rolling shutter is
    recognised, which a note says; where its line delay is estimated, the pose of a view is that at the instant of its middle row.

    Raises InputError for options out of range, corners outside the image and too few views, and GeometryError where the data
    cannot determine the camera.
    """
    options = replace(options, **fields)
    options.require_of_models([options.model])
    if isinstance(corners, PhotoCorners):
        if image_size is not None:
            raise InputError("`image_size` was expected with a table of corners only, found it with photos; leave it out.")
    else:
        if image_size is None:
            raise InputError(
                "`image_size` was expected beside a table of corners, which does not hold the size of the photos, found none; "
                "give (width, height)."
            )
        corners = PhotoCorners.of_table(corners if isinstance(corners, Corners) else corners_of_views(corners), image_size)
    if options.rolling_shutter:
        require_close(timed(corners).corners, options.clocks)
    else:
        corners = corners_without_copies(corners)
    with before_geometry({"": corners}, progress):
        found, selection, options, result = _calibrated(corners, options, executor, progress)
    notes = (*_side(found, result, options.mirror), *_gains(corners, found), *found.notes)
    # Frames that follow one another are alike, and are meant to be.
    duplicates = None if options.rolling_shutter else options.duplicates
    result = with_remarks(result, _remarks(found, result, duplicates))
    result = replace(result, views=result.views + found.skipped, notes=notes + result.notes)
    return CalibrationResult(result, found, calibration_record(result, options.mirror, found.inputs), selection, options.shooting)


def _calibrated(
    corners: PhotoCorners, options: CalibrationOptions, executor: Executor | None, progress: ProgressCallback
) -> tuple[PhotoCorners, Selection | None, CalibrationOptions, CameraCalibration]:
    """The corners that the camera leads to, how its model was chosen, the options with that model, and the calibration."""
    found, result = _guided(corners, options, executor, progress) if corners.photos else (corners, None)
    found, selection = timed(found), None
    if options.model == AUTO:
        selection, options, result = _selected(found, options, executor, progress)
    if result is None:
        result = _fitted(found, options, progress)
    return found, selection, options, with_line_delay(found, result, options, progress)


def view_details(views: Sequence[ViewResult]) -> tuple[Detail, ...]:
    """Why views were left out, then what is to be said of those that were used; of a rig with the camera before the name."""
    several = len({view.camera for view in views}) > 1

    def called(view: ViewResult) -> str:
        """The image of a view; of a rig its camera too, unless that is its folder."""
        image = view.image
        return f"{view.camera} {image}" if several and not image.startswith(f"{view.camera}/") else image

    left_out = (Detail.of(called(view), view.reason or "") for view in views if not view.used)
    return (*left_out, *(Detail.of(called(view), remark) for view in views for remark in view.remarks))


def corners_of_views(views: Mapping[str, tuple[Any, Any]]) -> Corners:
    """A table of corners from arrays by view: points of the board (n, 3) in metres, or (n, 2) in its plane, and pixels (n, 2).

    Raises InputError where an array has another shape.
    """
    board_m, pixels = [], []
    for name, (board, seen) in views.items():
        own, uv = np.asarray(board, dtype=np.float64), np.asarray(seen, dtype=np.float64)
        if own.shape not in ((len(uv), 2), (len(uv), 3)) or uv.shape != (len(uv), 2):
            raise InputError(
                f"View {name} was expected as board points (n, 3) and pixels (n, 2), found {own.shape} and {uv.shape}; correct "
                "it."
            )
        board_m.append(np.pad(own, ((0, 0), (0, 3 - own.shape[1]))))
        pixels.append(uv)
    if not views:
        raise InputError("Corners of three views or more were expected, found none; give the corners.")
    names = tuple(views)
    view = np.repeat(np.arange(len(names)), [len(uv) for uv in pixels])
    return Corners(view, names, names, np.concatenate(board_m), np.concatenate(pixels))


def _guided(
    first: PhotoCorners, options: CalibrationOptions, executor: Executor | None, progress: ProgressCallback
) -> tuple[PhotoCorners, CameraCalibration | None]:
    """The corners of photos with those that the camera leads to, and the calibration of them where it has been made already."""
    found, result = first, None
    guide = replace(options, model=GUIDE) if options.model == AUTO else options
    for done in range(options.searches):
        result = _fitted(found, guide, progress)
        poses = {view.name: view.cam_from_board for view in result.views if view.cam_from_board is not None}
        # What a photo shows to the first camera, corners and bends of edges, it shows to the next one.
        again = search_again(found, result.model, poses, first=done == 0, executor=executor, progress=progress)
        if done and np.array_equal(again.corners.board_m, found.corners.board_m):
            break
        found, result = again, None
    return found, None if options.model == AUTO else result


def _fitted(found: PhotoCorners, options: CalibrationOptions, progress: ProgressCallback) -> CameraCalibration:
    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    return calibrate_camera(
        found.corners,
        found.image_size,
        options.model,
        loss=options.loss,
        mirror=options.mirror,
        options=options.of_model,
        refine_board=options.refine_board,
        thresholds=options,
        callback=tell,
    )


def _selected(
    found: PhotoCorners, options: CalibrationOptions, executor: Executor | None, progress: ProgressCallback
) -> tuple[Selection, CalibrationOptions, CameraCalibration | None]:
    """The model that was chosen, the options with it, and its calibration unless a board is to be refined with it."""
    each = partial(one_by_one, stage="fitting", executor=executor, noun="camera models", progress=progress)
    selection = select_model(
        found.corners, found.image_size, loss=options.loss, mirror=options.mirror, thresholds=options, each=each
    )
    chosen = selection.chosen.candidate
    options = replace(options, model=chosen.model, **chosen.options)
    return selection, options, None if options.refine_board else selection.result


def _side(found: PhotoCorners, result: CameraCalibration, mirror: bool) -> tuple[str, ...]:
    """One sentence where the camera may look into a mirror and was taken for a lens, on nothing but that it was not said."""
    # Tags are read in one sense alone.
    tagged = found.pattern is not None and found.pattern.plain_grid is None
    wide = result.model.AXIS_SIGN_OPEN or result.max_angle_deg > 90
    pixels = torch.from_numpy(found.corners.pixels[result.kept])
    if mirror or tagged or not wide or not has_blind_centre(result.model, pixels):
        return ()
    return (
        "A lens is assumed, though no corner lies near the axis, where a mirror would show its own camera: boards without tags "
        "fit both equally well; where the camera looks into a mirror, give `mirror`.",
    )


def _gains(first: PhotoCorners, last: PhotoCorners) -> tuple[str, ...]:
    """One sentence on what the camera led to, none where that is nothing."""
    corners = len(last.corners) - len(first.corners)
    photos = len(set(last.corners.images) - set(first.corners.images))
    if corners <= 0:
        return ()
    among = f", those of {_count(photos, 'photo')} in which no board had been found among them" if photos else ""
    return (f"The camera led to {_count(corners, 'corner')} that had been missed{among}.",)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _remarks(
    found: PhotoCorners, result: CameraCalibration, duplicates: DuplicateThresholds | None
) -> dict[str, tuple[str, ...]]:
    """What the photos and the table of corners say of single views: blur and, unless that is None, views that show the same as
    another."""
    names: Sequence[str] = found.corners.view_names
    remarks: dict[str, list[str]] = {name: [remark] for name, remark in zip(names, found.remarks, strict=False) if remark}
    alike = () if duplicates is None else duplicate_views(found.corners, result.rms_px_per_axis, duplicates)
    for first, later in alike:
        remarks.setdefault(names[later], []).append(
            f"it shows the board where {names[first]} does, to within the noise: a duplicate counts twice and adds little"
        )
    return {name: tuple(texts) for name, texts in remarks.items()}
