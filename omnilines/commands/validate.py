"""omnilines validate: render photos with a known camera, run the whole path from the files, compare with the truth."""

from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.files.folders import check_results
from omnilines.files.sets import claimed
from omnilines.pages.validation import validation_data, validation_summaries
from omnilines.pipelines.render import MODEL, RenderOptions, render_targets
from omnilines.progress import ProgressCallback, silent
from omnilines.studies.validate import validate_targets
from omnilines.studies.validation import VALIDATION_FILES

PAGE = "report.html"
NAMES = (*VALIDATION_FILES, PAGE)
TARGET = "checkerboard:8x6:30mm"
PHOTOS = "photos"
"""Folder of the photos and of the truth, inside the output folder."""


def validate(
    out: str | Path,
    pattern_spec: str = TARGET,
    model: str = MODEL,
    options: RenderOptions = RenderOptions(),
    *,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Check that the software recovers what it is given, from pixels to lines.

    Renders photos of a target with a camera drawn from the seed, and does with the files what `validate_targets` says.

    Writes `photos/` (photos and truth), calibration.yaml, corners.csv, the line scene and report.html into `out`. The result
    holds when every check does. Raises InputError for options out of range and GeometryError where the data determine nothing.
    """
    folder = Path(out)
    check_results(folder, NAMES)
    shown = folder / PHOTOS
    truth = render_targets(pattern_spec, model, options)
    files = truth.save(shown, progress)
    validation = validate_targets(truth, photos=[shown / name for name in truth.photos], progress=progress)
    asked = {"fov_deg": truth.fov_deg, "views": options.views, "noise": options.noise_grey, "blur": options.blur_px}
    with claimed(folder, NAMES, by="validate"):
        tables = validation.save(folder, {"photos": shown, "model": model, **asked, "seed": options.seed})
        progress("writing the report", 0, 0)
        page = validation.report(folder / PAGE, shown)
    summaries, data = validation_summaries(validation), validation_data(validation)
    return CommandResult(summaries, data, validation.checks, (*files, *tables, page), page, validation.notes)
