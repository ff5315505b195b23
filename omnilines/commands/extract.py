"""omnilines extract: photos + calibration -> segments.csv and pictures of the arcs."""

from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractionOptions
from omnilines.files import find_photos
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.masks import mask_files, with_masks
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed
from omnilines.pages.arcs import arcs_data, arcs_summary, picture_name, write_pictures
from omnilines.pipelines.arcs import extract as pipeline
from omnilines.posing.joining import LEAST_PHOTOS
from omnilines.progress import ProgressCallback, silent

TABLE, PICTURES = "segments.csv", "pictures"
SCENE = ("--poses", "sfm", "--out", "scene")


def extract(
    photos: Sequence[Path],
    calibration: Path,
    out: Path,
    *,
    mask: Path | None = None,
    options: ExtractionOptions = ExtractionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the arcs seen in photos to `out/segments.csv` and a picture of each photo with its arcs to `out/pictures`.

    Only where the image `mask` is white is looked at, or that which each photo or camera has in the folder `mask`; by the
    workers of an `executor` where one is given. What is found is kept in `out/work`.
    Raises InputError as `pipelines.arcs.extract` does.
    """
    refs = with_masks(find_photos(photos), mask)
    cameras = read_cameras(calibration, refs)
    require_distinct_stems(refs)
    pictures = [f"{PICTURES}/{picture_name(photo)}" for photo in refs]
    read = [*photos, *(photo.path for photo in refs), *calibration_files(calibration), *mask_files(refs)]
    check_results(out, [TABLE, *pictures], read)
    check_work_folder(out / WORK, read)
    arcs = pipeline(refs, cameras, options=options, work=out / WORK, executor=executor, progress=progress)
    with claimed(out, [TABLE, *pictures], read, by="extract") as folder:
        files = (*arcs.save(folder), *write_pictures(folder / PICTURES, arcs, progress))
    also = () if mask is None else ("--mask", str(mask))
    return CommandResult(
        (arcs_summary(arcs, files[0]),),
        arcs_data(arcs),
        files=files,
        warnings=arcs.notes,
        details=arcs.skipped_details,
        photos=len(refs),
        then=("reconstruct", *map(str, photos), "--calibration", str(calibration), *also, *SCENE)
        if len(arcs) and len(refs) >= LEAST_PHOTOS
        else (),
    )
