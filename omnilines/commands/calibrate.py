"""omnilines calibrate: photos or corners.csv -> calibration.yaml, corners.csv, report.html."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_patterns import pattern as parse_pattern
from camera_models import Calibration, CameraEstimate, InputError, model_class, save
from camera_models.formats.calibration_data import ViewRecord
from omnilines.calibration.single import CameraCalibration, calibrate_camera
from omnilines.commands._calibration_report import calibration_sections
from omnilines.commands._common import CommandResult, ProgressCallback, output_folder, provenance, silent
from omnilines.commands.detect import detect_corners
from omnilines.files import find_photos, read_corners, write_corners
from omnilines.least_squares import Loss, Progress
from omnilines.records import Corners, Summary, ViewResult
from omnilines.report import write_report


def calibrate_photos(
    photos: Sequence[Path],
    pattern_spec: str,
    out: Path,
    *,
    model: str = "scaramuzza",
    degree: int = 4,
    coefficients: int = 5,
    loss: str = "cauchy",
    mirror: bool = False,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from photos of a target.

    Raises InputError or GeometryError with one sentence: no photo, pattern not found, too few views, all boards parallel.
    """
    _check_options(model, degree, loss)
    refs = find_photos(photos)
    pattern = parse_pattern(pattern_spec)
    # Which side of the board is seen decides only the sense of the numbering, which the pose of a plain board absorbs.
    found = detect_corners(refs, pattern, mirrored=mirror, progress=progress)
    inputs = {"photos": found.photo_folder, "pattern": pattern.specification}
    return _calibrate(
        found.corners, found.image_size, out, model, degree, coefficients, loss, mirror, inputs, found.skipped,
        found.photo_folder, progress,
    )  # fmt: skip


def calibrate_corners(
    corners_csv: Path,
    image_size: tuple[int, int],
    out: Path,
    *,
    model: str = "scaramuzza",
    degree: int = 4,
    coefficients: int = 5,
    loss: str = "cauchy",
    mirror: bool = False,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from a table of corners; photos beside it (folder `images`) are drawn in the report if present.

    Raises InputError naming file, line and column where the table is malformed.
    """
    _check_options(model, degree, loss)
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
    inputs = {"corners": corners_csv}
    return _calibrate(
        corners, image_size, out, model, degree, coefficients, loss, mirror, inputs, (), beside[0] if beside else None, progress
    )


def _check_options(model: str, degree: int, loss: str) -> None:
    """Refuse what cannot work before any photo is looked at."""
    model_class(model)
    Loss(loss)
    if degree < 2:
        raise InputError(f"--degree was expected to be at least 2, found {degree}; 4 suits most lenses.")


def _calibrate(
    corners: Corners,
    image_size: tuple[int, int],
    out: Path,
    model: str,
    degree: int,
    coefficients: int,
    loss: str,
    mirror: bool,
    inputs: Mapping[str, Any],
    skipped: tuple[ViewResult, ...],
    photo_folder: Path | None,
    progress: ProgressCallback,
) -> CommandResult:
    def tell(step: Progress) -> None:
        progress("refining the camera", step.iteration, 0)

    options = {"degree": degree, "coefficients": coefficients}
    result = calibrate_camera(corners, image_size, model, loss=loss, mirror=mirror, options=options, callback=tell)
    result = replace(result, views=result.views + skipped)
    folder = output_folder(out)
    files = (folder / "calibration.yaml", folder / "corners.csv")
    save(files[0], calibration_record(result, mirror, inputs))
    write_corners(files[1], corners)
    progress("writing the report", 0, 0)
    summaries = _summaries(result)
    sections = calibration_sections(result, corners, summaries, photo_folder)
    report = write_report(folder / "report.html", f"Calibration of a {model} camera", sections)
    warnings = tuple(f"{view.image}: {view.reason}" for view in result.views if not view.used) + result.notes
    return CommandResult(summaries, _data(result), files=(*files, report), report=report, warnings=warnings)


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
    views = tuple(
        ViewRecord(
            view.image,
            view.camera,
            view.used,
            view.reason,
            view.corners_used,
            view.corners_rejected,
            view.rms_px_per_point,
            view.cam_from_board,
            view=view.name if view.name != view.image else None,
        )
        for view in result.views
    )
    return Calibration({"cam0": result.model}, {"cam0": estimate}, views=views, provenance=provenance(inputs))


def _summaries(result: CameraCalibration) -> tuple[Summary, ...]:
    used = [view for view in result.views if view.used]
    rows = (
        ("model", result.model.NAME),
        ("views used", f"{len(used)} of {len(result.views)}"),
        ("corners used", f"{int(result.kept.sum())} of {len(result.kept)}"),
        ("rms_px_per_axis", f"{result.rms_px_per_axis:.4f}"),
        ("rms_px_per_point", f"{result.rms_px_per_point:.4f}"),
        ("field of view supported by the data", f"{result.min_angle_deg:.1f} to {result.max_angle_deg:.1f} degrees off axis"),
    )
    sigma = result.sigma
    parameters = tuple(
        (name, f"{value:.8g} ± {sigma[name]:.2g}" if sigma[name] > 0 else f"{value:.8g} (held)")
        for name, value in result.model.named_parameters().items()
    )
    return Summary("Calibration", rows, result.notes), Summary("Parameters ± one standard deviation", parameters)


def _data(result: CameraCalibration) -> dict[str, Any]:
    return {
        "model": result.model.NAME,
        "image_size": list(result.model.image_size),
        "parameters": result.model.named_parameters(),
        "sigma": result.sigma,
        "rms_px_per_axis": result.rms_px_per_axis,
        "rms_px_per_point": result.rms_px_per_point,
        "min_angle_deg": result.min_angle_deg,
        "max_angle_deg": result.max_angle_deg,
        "views": [
            {"image": view.image, "used": view.used, "reason": view.reason, "rms_px_per_point": view.rms_px_per_point}
            for view in result.views
        ],
        "notes": list(result.notes),
    }
