"""omnilines detect: photos -> corners.csv."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib_patterns import pattern as parse_pattern
from camera_models import CameraModel, InputError, load
from omnilines.commands.result import CommandResult
from omnilines.files import find_photos, write_corners
from omnilines.files.folders import check_output_folder, output_folder
from omnilines.pipelines.detect import counts_remark, detect_corners
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Summary


def detect(
    photos: Sequence[Path],
    pattern_spec: str,
    out: Path,
    *,
    calibration: Path | None = None,
    mirror: bool = False,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the corners of a target seen in photos to `out/corners.csv`; a `calibration` of the camera leads to more of them.

    Raises InputError when there is no photo, the specification is malformed, no photo shows the pattern, or the calibration is
    not that of one camera and these photos.
    """
    pattern = parse_pattern(pattern_spec)
    model = None if calibration is None else _one_camera(calibration)
    check_output_folder(out)
    found = detect_corners(find_photos(photos), pattern, model=model, mirrored=mirror, progress=progress)
    if model is not None and found.image_size != model.image_size:
        photo_size, camera_size = (f"{width}x{height} px" for width, height in (found.image_size, model.image_size))
        raise InputError(
            f"{calibration}: the camera of the photos, of {photo_size}, was expected, found one of {camera_size}; give the "
            "calibration of these photos, or leave it out."
        )
    path = output_folder(out) / "corners.csv"
    write_corners(path, found.corners)
    counts = np.bincount(found.corners.view, minlength=len(found.corners.images))
    seen = list(zip(found.corners.images, counts.tolist(), found.remarks, strict=True))
    rows = tuple((image, f"{count} corners" + (f"; {remark}" if remark else "")) for image, count, remark in seen)
    skipped = tuple((view.image, f"skipped: {view.reason}") for view in found.skipped)
    data = {
        "pattern": pattern.specification,
        "image_size": list(found.image_size),
        "photos": [{"image": image, "corners": count, "reason": None, "remark": remark} for image, count, remark in seen]
        + [{"image": view.image, "corners": 0, "reason": view.reason, "remark": None} for view in found.skipped],
    }
    summary = Summary(f"Corners of {pattern.specification}", rows + skipped, (f"{len(found.corners)} corners in {path}",))
    remark = counts_remark(pattern, found.corners)
    return CommandResult((summary,), data, files=(path,), warnings=(remark,) if remark else ())


def _one_camera(calibration: Path) -> CameraModel:
    """The camera of a file of one; raises InputError where it holds more."""
    cameras = load(calibration)
    if len(cameras) != 1:
        raise InputError(
            f"{calibration}: the calibration of one camera was expected, found {len(cameras)} cameras ({', '.join(cameras)}); "
            "write the one that took the photos to a file of its own."
        )
    return next(iter(cameras.values()))
