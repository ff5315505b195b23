"""omnilines directions: photos + calibration -> directions.csv, arcs.csv, poses.csv, report.html and pictures."""

from collections.abc import Sequence
from pathlib import Path

from camera_models import load
from omnilines.commands.extract import read_mask
from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractionOptions
from omnilines.files import find_photos
from omnilines.files.folders import check_results
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed
from omnilines.pages.arcs import picture_name
from omnilines.pages.directions import directions_data, directions_summary, write_direction_pictures
from omnilines.pipelines.arcs import SHORT_ARCS, cameras_of_photos, extract
from omnilines.pipelines.directions import ARCS, COVARIANCE, DIRECTIONS, POSES
from omnilines.pipelines.directions import directions as pipeline
from omnilines.progress import ProgressCallback, silent
from omnilines.structure.options import DirectionsOptions

PICTURES, REPORT = "pictures", "report.html"
UPRIGHT = ("--view", "panorama", "--upright", "--out", "level")
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

    The white pixels of the image `mask` are looked at. Raises InputError as `pipelines.arcs.extract` and
    `pipelines.directions.directions` do.
    """
    cameras, refs = load(calibration), find_photos(photos)
    require_distinct_stems(refs)
    camera_of = cameras_of_photos(refs, cameras)
    keep = None if mask is None else read_mask(mask, refs, [cameras[name] for name in set(camera_of.values())])
    pictures = [f"{PICTURES}/{picture_name(photo)}" for photo in refs]
    read = [*photos, *(photo.path for photo in refs), calibration, *([] if mask is None else [mask])]
    turns = (POSES, COVARIANCE) if orthogonal or vertical else ()
    check_results(out, [DIRECTIONS, ARCS, REPORT, *turns, *pictures], read)
    arcs = extract(refs, cameras, mask=keep, options=extraction, progress=progress)
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
        then=("rectify", *map(str, photos), "--calibration", str(calibration), *UPRIGHT) if len(found) else (),
    )
