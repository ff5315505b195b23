"""omnilines validate: render photos with a known camera, run the whole path from the files, compare with the truth."""

from pathlib import Path

from camera_models import load
from omnilines.calibration.options import CalibrationOptions
from omnilines.commands.calibrate import calibrate_photos
from omnilines.commands.result import CommandResult
from omnilines.files import read_corners
from omnilines.files.folders import output_folder
from omnilines.pages.validation import validation_data, validation_sections, validation_summaries
from omnilines.pipelines.render import MODEL, RenderOptions, render_targets
from omnilines.pipelines.scene import Scene, refined_calibration
from omnilines.progress import ProgressCallback, silent
from omnilines.report import write_report
from omnilines.studies.validation import compare

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

    Renders photos of a target with a camera drawn from the seed, calibrates from the photo
    files, rebuilds the rows and columns of the board as 3D lines with the calibrated camera and poses, and compares:

    - at most 5 percent of the photos (rounded up) are without a usable target;
    - the RMS angle between estimated and true bearings, uniform over the pixels as far out as boards were shown, after the best
      common rotation, is at most 0.02 degrees, or 0.1 px at the mean angular size of a pixel (`fov_deg` over the shorter side of
      the image) where that is more, as it is for small images;
    - the parameters agree with the truth within their covariance: jointly, by the 99.9 percent quantile, and each within 4.5
      standard deviations;
    - the lines agree with the rows and columns of the true board, after the best similarity, within what the accuracy that the
      detector states for each corner predicts, by the same quantile; at most 5 percent of the corners (rounded up) fit no line;
    - whatever is stated, their ends are within 0.25 px (RMS) where the board is, and its lines are not too long or too short by
      more than 0.1 px over the board.

    Writes `photos/` (photos and truth), calibration.yaml, corners.csv, the line scene and report.html into `out`. The result
    holds when every check does. Raises InputError for options out of range and GeometryError where the data determine nothing.
    """
    folder = output_folder(out)
    truth = render_targets(pattern_spec, model, options)
    shown = truth.save(folder / PHOTOS, progress)
    photos = [folder / PHOTOS / name for name in truth.photos]
    calibrated = calibrate_photos(photos, pattern_spec, folder, CalibrationOptions(model), progress=progress)
    progress("rebuilding lines", 0, 0)
    corners = read_corners(folder / "corners.csv")
    validation = compare(truth, load(folder / "calibration.yaml"), corners)
    scene = validation.scene
    asked = {"fov_deg": truth.fov_deg, "views": options.views, "noise": options.noise_grey, "blur": options.blur_px}
    inputs = {"photos": folder / PHOTOS, "model": model, **asked, "seed": options.seed}
    cameras = refined_calibration(scene, validation.calibration)
    tables = Scene(scene, validation.board.segments, cameras, inputs).save(folder)
    progress("writing the report", 0, 0)
    summaries = validation_summaries(validation)
    sections = validation_sections(validation, summaries, folder / PHOTOS)
    page = write_report(folder / "report.html", f"Validation of a {model} camera", sections)
    files = (*shown, folder / "corners.csv", *tables, page)
    data = validation_data(validation)
    return CommandResult(summaries, data, validation.checks, files, page, calibrated.warnings)
