"""omnilines extract: photos + calibration -> segments.csv and pictures of the arcs."""

import os
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from camera_models import CameraModel, InputError, load
from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractionOptions
from omnilines.files import PhotoRef, find_photos, read_photo
from omnilines.files.folders import check_results
from omnilines.files.photos import require_distinct_stems
from omnilines.files.sets import claimed
from omnilines.pages.arcs import arcs_data, arcs_summary, picture_name, write_pictures
from omnilines.pipelines.arcs import cameras_of_photos
from omnilines.pipelines.arcs import extract as pipeline
from omnilines.posing.sfm import LEAST_PHOTOS
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

    The white pixels of the image `mask` are looked at, by the workers of an `executor` where one is given.
    Raises InputError as `pipelines.arcs.extract` does.
    """
    cameras, refs = load(calibration), find_photos(photos)
    require_distinct_stems(refs)
    camera_of = cameras_of_photos(refs, cameras)
    keep = None if mask is None else read_mask(mask, refs, [cameras[name] for name in set(camera_of.values())])
    pictures = [f"{PICTURES}/{picture_name(photo)}" for photo in refs]
    read = [*photos, *(photo.path for photo in refs), calibration, *([] if mask is None else [mask])]
    check_results(out, [TABLE, *pictures], read)
    arcs = pipeline(refs, cameras, mask=keep, options=options, executor=executor, progress=progress)
    with claimed(out, [TABLE, *pictures], read, by="extract") as folder:
        files = (*arcs.save(folder), *write_pictures(folder / PICTURES, arcs, progress))
    masked = () if mask is None else ("--mask", str(mask))
    return CommandResult(
        (arcs_summary(arcs, files[0]),),
        arcs_data(arcs),
        files=files,
        warnings=arcs.notes,
        details=arcs.skipped_details,
        photos=len(refs),
        then=("reconstruct", *map(str, photos), "--calibration", str(calibration), *masked, *SCENE)
        if len(arcs) and len(refs) >= LEAST_PHOTOS
        else (),
    )


def read_mask(path: Path, photos: Sequence[PhotoRef], cameras: Sequence[CameraModel]) -> Bool[np.ndarray, "h w"]:
    """Where an image is white; raises InputError where it is one of the photos, has not the size that the cameras have, or is
    white nowhere."""
    image = read_photo(path)
    if os.path.realpath(path) in {os.path.realpath(photo.path) for photo in photos}:
        raise InputError(f"The mask {path} was expected apart from the photos, found it among them; keep it in another folder.")
    for camera in cameras:
        if image.shape[1::-1] != camera.image_size:
            raise InputError(
                f"The mask {path} was expected with {camera.image_size[0]}x{camera.image_size[1]} px, as the camera has, found "
                f"{image.shape[1]}x{image.shape[0]} px; give one of that size."
            )
    bright = image if image.ndim == 2 else image.max(-1)
    most = np.iinfo(image.dtype).max
    keep = bright > most // 2
    if not keep.any():
        raise InputError(
            f"The mask {path} was expected to be white (above {most // 2} of {most}) where to look, found nothing brighter than "
            f"{bright.max()}; draw white what counts."
        )
    return keep
