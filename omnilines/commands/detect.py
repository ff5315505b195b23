"""omnilines detect: photos -> corners.csv."""

from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from calib_patterns import DetectionOptions
from camera_models import Calibration, CameraModel, InputError
from camera_models.wording import listed
from omnilines.commands.camera_videos import Sizes, cameras_of_videos
from omnilines.commands.result import CommandResult
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.sets import claimed
from omnilines.pages.corners import corners_summary
from omnilines.pipelines import detect as pipeline
from omnilines.pipelines.photo_corners import CORNERS
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Detail


def detect(
    photos: Sequence[Path],
    pattern_spec: str,
    out: Path,
    *,
    calibration: Path | None = None,
    mirror: bool = False,
    options: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the corners of a target seen in photos to `out/corners.csv`; a `calibration` of the camera leads to more of them.
    Photos are looked through by the workers of an `executor`, where one is given. What is found is kept in `out/work`.

    Raises InputError when there is no photo, the specification is malformed, no photo shows the pattern, or the calibration is
    not that of one camera and these photos.
    """
    camera = None if calibration is None else _one_camera(calibration)
    read = [*photos, *([] if calibration is None else calibration_files(calibration))]
    check_results(out, [CORNERS], read)
    check_work_folder(out / WORK, read)
    found = pipeline.detect(
        photos,
        pattern_spec,
        camera=camera,
        mirrored=mirror,
        work=out / WORK,
        options=options,
        executor=executor,
        progress=progress,
    )
    with claimed(out, [CORNERS], read, by="detect"):
        files = found.save(out)
    counts = np.bincount(found.corners.view, minlength=len(found.corners.images))
    seen = list(zip(found.corners.images, counts.tolist(), found.remarks, strict=True))
    skipped = tuple(Detail(view.image, f"{view.image} is skipped: {view.reason}") for view in found.skipped)
    data = {
        "pattern": found.inputs["pattern"],
        "image_size": list(found.image_size),
        "photos": [{"image": image, "corners": count, "reason": None, "remark": remark} for image, count, remark in seen]
        + [{"image": view.image, "corners": 0, "reason": view.reason, "remark": None} for view in found.skipped],
    }
    summary = corners_summary(found, str(files[0]))
    given = len(seen) + len(skipped)
    size = "x".join(map(str, found.image_size))
    mirrored = ("--mirror",) if found.mirrored else ()
    then = ("calibrate", str(files[0]), "--image-size", size, *mirrored, "--out", "result")
    return CommandResult((summary,), data, files=files, warnings=found.notes, details=skipped, photos=given, then=then)


def camera_of_video(calibration: Path | None, sizes: Sizes) -> Calibration | None:
    """As `cameras_of_videos`, of the one camera that `detect` goes by, where it is given one."""
    if calibration is None:
        return None
    _one_camera(calibration)
    return cameras_of_videos(calibration, sizes)


def _one_camera(calibration: Path) -> CameraModel:
    """The camera of a file of one; raises InputError where it holds more."""
    cameras = read_cameras(calibration)
    if len(cameras) != 1:
        raise InputError(
            f"{calibration}: the calibration of one camera was expected, found {len(cameras)} cameras ({listed(cameras)}); "
            "write the one that took the photos to a file of its own."
        )
    return next(iter(cameras.values()))
