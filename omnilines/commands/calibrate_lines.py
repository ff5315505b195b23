"""omnilines calibrate --pattern lines: photos of buildings or rooms -> calibration.yaml, report.html."""

from collections.abc import Sequence
from pathlib import Path

from calib_patterns import DetectionOptions
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.result import CommandResult, with_calibration
from omnilines.files import find_photos
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.masks import mask_files, with_masks
from omnilines.files.sets import claimed
from omnilines.pages.calibration_lines import line_calibration_data, line_calibration_summaries
from omnilines.pipelines.calibrate_lines import CALIBRATION, LineResult
from omnilines.pipelines.calibrate_one import calibrate
from omnilines.pipelines.line_options import LinesOptions
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check

PAGE = "report.html"


def calibrate_line_photos(
    photos: Sequence[Path],
    pattern: str,
    out: Path,
    options: CalibrationOptions = CalibrationOptions(),
    lines: LinesOptions = LinesOptions(),
    *,
    mask: Path | None = None,
    detection: DetectionOptions = DetectionOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate one camera from the straight lines of photos, and write calibration and report into `out`. Where the
    pattern names a target beside lines, its corners count too. Edges are followed where the image `mask` is white, or that
    which each photo has in the folder `mask`. What photos show is kept in `out/work`.

    A camera of which the lines leave something open is written all the same, and the check fails. Raises InputError or
    GeometryError as `pipelines.calibrate_one.calibrate` does.
    """
    refs = with_masks(find_photos(photos), mask)
    read = [*photos, *mask_files(refs)]
    check_results(out, (CALIBRATION, PAGE), read)
    check_work_folder(out / WORK, read)
    result = calibrate(refs, pattern, options, lines=lines, work=out / WORK, detection=detection, progress=progress)
    assert isinstance(result, LineResult)
    with claimed(out, (CALIBRATION, PAGE), read, by="calibrate"):
        files = result.save(out)
        progress("writing the report", 0, 0)
        page = result.report(out / PAGE)
    left_open = len(result.fit.open_terms)
    return CommandResult(
        line_calibration_summaries(result),
        line_calibration_data(result),
        checks=(Check("directions of the camera that lines leave open", float(left_open), 0.0, "", left_open == 0),),
        files=(*files, page),
        report=page,
        warnings=result.notes,
        details=result.details,
        photos=len(result.fit.photos) + len(result.skipped),
        then=with_calibration(files[0]),
    )
