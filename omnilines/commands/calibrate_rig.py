"""omnilines calibrate with several cameras: folders of photos or corners.csv -> calibration.yaml with the rig, report.html."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

from calib_patterns import DetectionOptions
from omnilines.commands.calibrate import PAGE, photos_beside
from omnilines.commands.result import CommandResult, with_calibration
from omnilines.files import read_rig_corners
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.sets import claimed
from omnilines.pages.rig_figures import rig_data, rig_summaries
from omnilines.pipelines.calibrate import view_details
from omnilines.pipelines.calibrate_rig import RIG_FILES, RigSetup, calibrate_rig
from omnilines.pipelines.detect_rig import detect_rig
from omnilines.pipelines.rig_corners import RigCorners
from omnilines.progress import ProgressCallback, silent


def calibrate_rig_photos(
    folders: Sequence[Path],
    pattern_specs: Sequence[str],
    out: Path,
    setup: RigSetup,
    *,
    camera: str | None = None,
    detection: DetectionOptions = DetectionOptions(),
    read: Sequence[Path] = (),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate a rig from a folder with one sub-folder of photos per camera, or from these sub-folders; photos of the same name
    are of the same instant. With `camera` all photos are of one camera of that name, which sees several boards.

    `read` are the files that the setup is from; `executor` as in `detect`.
    Raises InputError or GeometryError with one sentence.
    """
    setup.require_photos()
    check_results(out, (*RIG_FILES, PAGE), [*folders, *read])
    check_work_folder(out / WORK, [*folders, *read])
    inside = sorted(folders[0].iterdir()) if len(folders) == 1 and folders[0].is_dir() else folders
    cameras = [path.name for path in inside if path.is_dir()] if camera is None else [camera]
    setup.require_cameras(cameras)
    perhaps = [name for name in cameras if setup.axis_sign_open(name)]
    found = detect_rig(
        folders[0] if len(folders) == 1 else folders,
        pattern_specs,
        mirrored=setup.options.mirror,
        perhaps_mirrored=perhaps,
        camera=camera,
        work=out / WORK,
        options=detection,
        executor=executor,
        progress=progress,
    )
    return _written(found, setup, out, [*folders, *read], executor, progress)


def calibrate_rig_corners(
    corners_csv: Path,
    image_sizes: Mapping[str, tuple[int, int]],
    out: Path,
    setup: RigSetup,
    *,
    read: Sequence[Path] = (),
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Calibrate a rig from a table of corners with a column `camera` (and `frame`, `board`); `image_sizes` by camera, "" standing
    for all others. `read` are the files that the setup is from.

    Raises InputError naming file, line and column where the table is malformed, and GeometryError where the rig is left open.
    """
    check_results(out, (*RIG_FILES, PAGE), [corners_csv, *read])
    corners = read_rig_corners(corners_csv)
    found = RigCorners.of_table(corners, image_sizes, corners_csv, photos_beside(corners_csv, corners.images[0]))
    return _written(found, setup, out, [corners_csv, *read], None, progress)


def _written(
    found: RigCorners,
    setup: RigSetup,
    out: Path,
    read: Sequence[Path],
    executor: Executor | None,
    progress: ProgressCallback,
) -> CommandResult:
    result = calibrate_rig(
        found,
        options=setup.options,
        models=setup.models,
        boards=setup.boards,
        start=setup.start,
        hold=setup.hold,
        time_offsets=setup.time_offsets,
        executor=executor,
        progress=progress,
    )
    with claimed(out, (*result.file_names, PAGE), read, by="calibrate"):
        files = result.save(out)
        progress("writing the report", 0, 0)
        report = result.report(out / PAGE)
    return CommandResult(
        rig_summaries(result),
        rig_data(result),
        files=(*files, report),
        report=report,
        warnings=result.notes,
        details=view_details(result.views),
        photos=len(result.views),
        then=with_calibration(files[0]),
    )
