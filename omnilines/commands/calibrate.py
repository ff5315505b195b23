"""omnilines calibrate: photos or corners.csv -> calibration.yaml, corners.csv, report.html."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from calib_patterns import DetectionOptions
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.result import CommandResult, with_calibration
from omnilines.files import find_photos, read_corners
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.sets import claimed
from omnilines.pages.calibration import calibration_data, calibration_summaries
from omnilines.pipelines.calibrate import CALIBRATION_FILES, CalibrationResult
from omnilines.pipelines.calibrate_one import calibrate
from omnilines.pipelines.detect import detect
from omnilines.pipelines.detect_rig import shared_frames
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.progress import ProgressCallback, silent

PAGE = "report.html"
NAMES = (*CALIBRATION_FILES, PAGE)


def calibrate_photos(
    photos: Sequence[Path],
    pattern_spec: str,
    out: Path,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    detection: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from photos of a target, and write calibration, corners and report into `out`; `executor` as in
    `detect`. Corners that were found are kept in `out/work`.

    Raises InputError or GeometryError with one sentence: no photo, pattern not found, too few views, all boards parallel.
    """
    options.require_of_models([options.model])
    check_results(out, NAMES, photos)
    check_work_folder(out / WORK, photos)
    found = detect(
        photos, pattern_spec, mirrored=options.mirror, work=out / WORK, options=detection, executor=executor, progress=progress
    )
    result = calibrate(found, options=options, executor=executor, progress=progress)
    done = _written(result, out, photos, progress)
    if cameras := shared_frames(find_photos(photos)):
        one = (
            f"Photos of the same names lie in {' and '.join(cameras[:2])}, and were taken to be of one camera; give the folders "
            "themselves where they are cameras of a rig."
        )
        return replace(done, warnings=(*done.warnings, one))
    return done


def calibrate_corners(
    corners_csv: Path,
    image_size: tuple[int, int],
    out: Path,
    options: CalibrationOptions = CalibrationOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from a table of corners; photos beside it (folder `images`) are drawn in the report if present.

    Raises InputError naming file, line and column where the table is malformed.
    """
    check_results(out, NAMES, [corners_csv])
    corners = read_corners(corners_csv)
    found = PhotoCorners.of_table(corners, image_size, corners_csv, photos_beside(corners_csv, corners.images[0]))
    return _written(calibrate(found, options=options, progress=progress), out, [corners_csv], progress)


def photos_beside(corners_csv: Path, image: str) -> Path | None:
    """The folder beside a table that holds its photos, if there is one."""
    return next((f for f in (corners_csv.parent / "images", corners_csv.parent) if (f / image).is_file()), None)


def _written(result: CalibrationResult, out: Path, read: Sequence[Path], progress: ProgressCallback) -> CommandResult:
    with claimed(out, NAMES, read, by="calibrate"):
        files = result.save(out)
        progress("writing the report", 0, 0)
        report = result.report(out / PAGE)
    summaries, data = calibration_summaries(result), calibration_data(result)
    files = (*files, report)
    return CommandResult(
        summaries,
        data,
        files=files,
        report=report,
        warnings=result.warnings,
        details=result.details,
        photos=len(result.views),
        then=with_calibration(files[0]),
    )
