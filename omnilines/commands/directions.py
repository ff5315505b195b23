"""omnilines directions: photos + calibration -> directions.csv, arcs.csv, poses.csv, report.html and pictures."""

import math
from collections.abc import Sequence
from pathlib import Path

from camera_models import Calibration
from camera_models.views import USUAL_PERSPECTIVE_DEG
from omnilines.calibration.diagnose import angles_off_axis
from omnilines.calibration.uncertainty import supported_grid
from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractionOptions
from omnilines.files import find_photos
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.masks import mask_files, with_masks
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed
from omnilines.pages.arcs import picture_name
from omnilines.pages.directions import directions_data, directions_summary, write_direction_pictures
from omnilines.pipelines.arcs import SHORT_ARCS, extract
from omnilines.pipelines.directions import ARCS, COVARIANCE, DIRECTIONS, POSES, require_one
from omnilines.pipelines.directions import directions as pipeline
from omnilines.progress import ProgressCallback, silent
from omnilines.structure.options import DirectionsOptions

PICTURES, REPORT = "pictures", "report.html"
UPRIGHT = ("--upright", "--out", "level")
"""What most often comes next: the photos turned upright."""


def directions(
    photos: Sequence[Path],
    calibration: Path,
    out: Path,
    *,
    orthogonal: bool = False,
    vertical: bool = False,
    mask: Path | None = None,
    extraction: ExtractionOptions = SHORT_ARCS,
    options: DirectionsOptions = DirectionsOptions(),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the directions in which the lines of each photo meet, the arcs of each, rotations where asked for, and pictures.

    Only where the image `mask` is white is looked at, or that which each photo or camera has in the folder `mask`. Arcs are kept
    in `out/work`. Raises InputError as `pipelines.arcs.extract` and `pipelines.directions.directions` do.
    """
    require_one(orthogonal, vertical)
    refs = with_masks(find_photos(photos), mask)
    cameras = read_cameras(calibration, refs)
    require_distinct_stems(refs)
    pictures = [f"{PICTURES}/{picture_name(photo)}" for photo in refs]
    read = [*photos, *(photo.path for photo in refs), *calibration_files(calibration), *mask_files(refs)]
    turns = (POSES, COVARIANCE) if orthogonal or vertical else ()
    check_results(out, [DIRECTIONS, ARCS, REPORT, *turns, *pictures], read)
    check_work_folder(out / WORK, read)
    arcs = extract(refs, cameras, options=extraction, work=out / WORK, progress=progress)
    found = pipeline(arcs, orthogonal=orthogonal, vertical=vertical, options=options, progress=progress)
    with claimed(out, [*found.file_names, *pictures, REPORT], read, by="directions") as folder:
        files = (*found.save(folder), *write_direction_pictures(folder / PICTURES, found, progress))
        progress("writing the report", 0, 0)
        page = found.report(folder / REPORT)
    return CommandResult(
        (directions_summary(found),),
        directions_data(found),
        files=files,
        warnings=arcs.notes,
        details=found.details,
        photos=len(refs),
        report=page,
        then=("rectify", *map(str, photos), "--calibration", str(calibration), *_view_of(cameras), *UPRIGHT)
        if len(found)
        else (),
    )


def _view_of(cameras: Calibration) -> tuple[str, ...]:
    """The view that photos are turned upright in: a perspective one as wide as the widest camera sees where that is no wider than
    is usual; else, and of a rig, a panorama."""
    grids = [(model, supported_grid(model, math.pi)) for model in cameras.values()]
    across_deg = max(2.0 * math.degrees(float(angles_off_axis(model, pixels).max())) for model, pixels in grids)
    if cameras.rig or across_deg > USUAL_PERSPECTIVE_DEG:
        return ("--view", "panorama")
    return ("--view", "perspective", "--fov-deg", str(math.ceil(across_deg)))
