"""omnilines calibrate: photos or corners.csv -> calibration.yaml, corners.csv, report.html."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from calib_patterns import Pattern
from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, CameraEstimate, InputError, model_class, save
from camera_models.formats.calibration_data import ViewRecord
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.duplicates import duplicate_views
from omnilines.calibration.select import select_model
from omnilines.calibration.single import CameraCalibration, calibrate_camera, with_remarks
from omnilines.commands.result import CommandResult
from omnilines.files import PhotoRef, find_photos, read_corners, write_corners
from omnilines.files.folders import check_output_folder, output_folder
from omnilines.least_squares import Loss, Progress
from omnilines.pages.calibration import calibration_data, calibration_sections, calibration_summaries
from omnilines.pipelines.detect import PhotoCorners, counts_remark, detect_corners, search_again
from omnilines.progress import ProgressCallback, silent
from omnilines.provenance import provenance
from omnilines.records import Corners, ViewResult
from omnilines.report import write_report

AUTO = "auto"
"""In the place of a model's name: fit all and take the one that predicts views best."""
GUIDE = "scaramuzza"
"""The model that leads to more corners where the user has not chosen one: it fits lenses of every width, and mirrors."""
SEARCHES = 3
"""Times at most that a camera is sent out for more corners."""


@dataclass(frozen=True)
class CalibrationOptions:
    """What a user can ask of a calibration."""

    model: str = "scaramuzza"
    """Name of a camera model, or AUTO."""
    degree: int | None = None
    coefficients: int | None = None
    loss: str = "cauchy"
    mirror: bool = False
    refine_board: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what cannot work before any photo is looked at."""
        if self.model != AUTO:
            model_class(self.model)
        elif self.of_model:
            raise InputError(
                f"--model auto tries every number of coefficients itself, found --{next(iter(self.of_model))} beside it; "
                "leave that out or name a model."
            )
        Loss(self.loss)
        BoardShape.to_refine(self.refine_board, torch.zeros(1, 3, dtype=torch.float64))
        if self.degree is not None and self.degree < 2:
            raise InputError(f"--degree was expected to be at least 2, found {self.degree}; leave it out to have it chosen.")

    @property
    def of_model(self) -> dict[str, int]:
        """The options that go to the model."""
        given = {"degree": self.degree, "coefficients": self.coefficients}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class _Source:
    """The corners of a calibration and where they come from."""

    corners: Corners
    image_size: tuple[int, int]
    inputs: Mapping[str, Any]
    photo_folder: Path | None
    skipped: tuple[ViewResult, ...] = ()
    remarks: tuple[str | None, ...] = ()
    """On each view, from its photo."""
    notes: tuple[str, ...] = ()
    result: CameraCalibration | None = None
    """The calibration of these corners with the options of the user, where it has been made already."""


def calibrate_photos(
    photos: Sequence[Path],
    pattern_spec: str,
    out: Path,
    *,
    model: str = "scaramuzza",
    degree: int | None = None,
    coefficients: int | None = None,
    loss: str = "cauchy",
    mirror: bool = False,
    refine_board: tuple[str, ...] = (),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from photos of a target; the camera leads to corners and photos that were missed, and is calibrated
    anew, until nothing is gained.

    With `model` "auto" all models are fitted and one is chosen by held-out views (`calibration.select`).
    Raises InputError or GeometryError with one sentence: no photo, pattern not found, too few views, all boards parallel.
    """
    options = CalibrationOptions(model, degree, coefficients, loss, mirror, refine_board)
    refs = find_photos(photos)
    pattern = parse_pattern(pattern_spec)
    check_output_folder(out)
    # Which side of the board is seen decides only the sense of the numbering, which the pose of a plain board absorbs.
    found = detect_corners(refs, pattern, mirrored=mirror, progress=progress)
    return _calibrate(_guided(refs, found, pattern, options, progress), out, options, progress)


def _guided(
    photos: Sequence[PhotoRef], first: PhotoCorners, pattern: Pattern, options: CalibrationOptions, progress: ProgressCallback
) -> _Source:
    """The corners of photos with those that the camera leads to."""
    found, result = first, None
    for done in range(SEARCHES):
        result = _fitted(found.corners, found.image_size, options, progress)
        poses = {view.name: view.cam_from_board for view in result.views if view.cam_from_board is not None}
        # A photo that shows nothing to the first camera shows nothing to the next one.
        again = search_again(
            photos, found, pattern, result.model, poses, lost_too=done == 0, mirrored=options.mirror, progress=progress
        )
        if np.array_equal(again.corners.pixels, found.corners.pixels):
            break
        found, result = again, None
    return _Source(
        found.corners,
        found.image_size,
        {"photos": found.photo_folder, "pattern": pattern.specification},
        found.photo_folder,
        found.skipped,
        found.remarks,
        _gains(first, found) + ((remark,) if (remark := counts_remark(pattern, found.corners)) else ()),
        None if options.model == AUTO else result,
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


def _fitted(
    corners: Corners, image_size: tuple[int, int], options: CalibrationOptions, progress: ProgressCallback
) -> CameraCalibration:
    """The camera by the user's model, or by GUIDE where that is yet to be chosen."""

    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    return calibrate_camera(
        corners,
        image_size,
        GUIDE if options.model == AUTO else options.model,
        loss=options.loss,
        mirror=options.mirror,
        options=options.of_model,
        refine_board=options.refine_board,
        callback=tell,
    )


def calibrate_corners(
    corners_csv: Path,
    image_size: tuple[int, int],
    out: Path,
    *,
    model: str = "scaramuzza",
    degree: int | None = None,
    coefficients: int | None = None,
    loss: str = "cauchy",
    mirror: bool = False,
    refine_board: tuple[str, ...] = (),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from a table of corners; photos beside it (folder `images`) are drawn in the report if present.

    Raises InputError naming file, line and column where the table is malformed.
    """
    options = CalibrationOptions(model, degree, coefficients, loss, mirror, refine_board)
    corners = read_corners(corners_csv)
    outside = ((corners.pixels < -0.5) | (corners.pixels > np.array(image_size) - 0.5)).any(-1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        u, v = corners.pixels[row]
        raise InputError(
            f"{corners_csv}: every corner was expected inside the image of {image_size[0]}x{image_size[1]} px, found "
            f"({u:g}, {v:g}) in view {corners.view_names[corners.view[row]]}; check --image-size (width x height)."
        )
    beside = [folder for folder in (corners_csv.parent / "images", corners_csv.parent) if (folder / corners.images[0]).is_file()]
    source = _Source(corners, image_size, {"corners": corners_csv}, beside[0] if beside else None)
    return _calibrate(source, out, options, progress)


def _calibrate(source: _Source, out: Path, options: CalibrationOptions, progress: ProgressCallback) -> CommandResult:
    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    selection = None
    model, of_model = options.model, options.of_model
    common: dict[str, Any] = {"loss": options.loss, "mirror": options.mirror}
    if model == AUTO:

        def trying(label: str, done: int, total: int) -> None:
            progress(f"fitting {label}", done, total)

        selection = select_model(source.corners, source.image_size, callback=trying, **common)
        model, of_model = selection.chosen.candidate.model, dict(selection.chosen.candidate.options)
    if selection is not None and not options.refine_board:
        result = selection.result
    elif source.result is not None:
        result = source.result
    else:
        board = options.refine_board
        result = calibrate_camera(
            source.corners, source.image_size, model, options=of_model, refine_board=board, callback=tell, **common
        )
    result = with_remarks(result, _remarks(source, result))
    result = replace(result, views=result.views + source.skipped, notes=source.notes + result.notes)
    folder = output_folder(out)
    files = (folder / "calibration.yaml", folder / "corners.csv")
    save(files[0], calibration_record(result, options.mirror, source.inputs))
    write_corners(files[1], source.corners)
    progress("writing the report", 0, 0)
    summaries = calibration_summaries(result, selection)
    sections = calibration_sections(result, source.corners, summaries, source.photo_folder)
    report = write_report(folder / "report.html", f"Calibration of one {model} camera", sections)
    warnings = tuple(f"{view.image}: {view.reason}" for view in result.views if not view.used)
    warnings += tuple(f"{view.image}: {remark}" for view in result.views for remark in view.remarks) + result.notes
    warnings += () if selection is None else (selection.reason,)
    return CommandResult(summaries, calibration_data(result, selection), files=(*files, report), report=report, warnings=warnings)


def _remarks(source: _Source, result: CameraCalibration) -> dict[str, tuple[str, ...]]:
    """What the photos and the table of corners say of single views: blur, and views that show the same as another."""
    names = source.corners.view_names
    found: dict[str, list[str]] = {name: [remark] for name, remark in zip(names, source.remarks, strict=False) if remark}
    for first, later in duplicate_views(source.corners, result.rms_px_per_axis):
        found.setdefault(names[later], []).append(
            f"it shows the board where {names[first]} does, to within the noise: a duplicate counts twice and adds little"
        )
    return {name: tuple(remarks) for name, remarks in found.items()}


def calibration_record(result: CameraCalibration, mirror: bool, inputs: Mapping[str, Any]) -> Calibration:
    """What `calibration.yaml` holds of a result."""
    estimate = CameraEstimate(
        sigma=result.sigma,
        covariance=result.covariance,
        max_angle_deg=result.max_angle_deg,
        min_angle_deg=result.min_angle_deg,
        rms_px_per_axis=result.rms_px_per_axis,
        rms_px_per_point=result.rms_px_per_point,
        sign_source=("mirror" if mirror else "assumed") if result.model.NAME == "scaramuzza" else None,
    )
    views = tuple(view_record(view) for view in result.views)
    if result.board_terms:
        # The poses of the views are those of this board.
        inputs = {**inputs, "board": " ".join(f"{name}={value:.6g}" for name, value in result.board_terms.items())}
    return Calibration({"cam0": result.model}, {"cam0": estimate}, views=views, provenance=provenance(inputs))


def view_record(view: ViewResult) -> ViewRecord:
    """What `calibration.yaml` holds of a view."""
    return ViewRecord(
        view.image,
        view.camera,
        view.used,
        view.reason,
        view.corners_used,
        view.corners_rejected,
        view.rms_px_per_point,
        view.cam_from_board,
        view.frame,
        view.name if view.name != view.image else None,
    )
