"""omnilines check: photos + calibration -> whether it is still right, check.csv."""

from collections.abc import Sequence
from pathlib import Path

from omnilines.commands.result import CommandResult, with_calibration
from omnilines.files import find_photos
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.masks import mask_files, with_masks
from omnilines.files.sets import claimed
from omnilines.pages.check import check_data, check_summaries
from omnilines.pipelines.check import CHECK
from omnilines.pipelines.check import check as pipeline
from omnilines.pipelines.check_options import CheckOptions
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check


def check(
    photos: Sequence[Path],
    calibration: Path,
    out: Path | None = None,
    *,
    mask: Path | None = None,
    options: CheckOptions = CheckOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Say whether photos bear out a calibration, and write check.csv into `out` where it is given; edges are kept in `out/work`.

    Raises InputError and GeometryError as `pipelines.check.check` does.
    """
    refs = with_masks(find_photos(photos), mask)
    cameras = read_cameras(calibration, refs)
    read = [*photos, *(photo.path for photo in refs), *calibration_files(calibration), *mask_files(refs)]
    if out is not None:
        check_results(out, [CHECK], read)
        check_work_folder(out / WORK, read)
    result = pipeline(refs, cameras, options, work=None if out is None else out / WORK, progress=progress)
    files: tuple[Path, ...] = ()
    if out is not None:
        with claimed(out, result.file_names, read, by="check") as folder:
            files = result.save(folder)
    found = result.found
    # Of what chance explains no drift is held against the camera.
    drift = max(found.drift_px, found.least_drift_px) if found.probability < options.significance else 0.0
    return CommandResult(
        check_summaries(result, [*(str(path) for path in photos), *(() if mask is None else ("--mask", str(mask)))]),
        check_data(result),
        checks=(Check("drift beyond chance", drift, options.tolerance_px, "px", result.holds),),
        files=files,
        warnings=result.notes,
        details=result.skipped,
        photos=len(refs),
        then=with_calibration(calibration),
    )
