"""omnilines reconstruct and adjust: photos, or matched segments, calibration and poses -> 3D lines with their uncertainty."""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from camera_models import Calibration, InputError
from omnilines.adjustment.arcs import cameras_of_images
from omnilines.commands.camera_videos import Sizes, cameras_of_videos
from omnilines.commands.result import CommandResult
from omnilines.commands.resume import Stamp
from omnilines.extraction import ExtractionOptions
from omnilines.files import (
    Photo,
    find_photos,
    is_corners_table,
    photo_folder,
    read_corners,
    read_poses,
    read_segments,
)
from omnilines.files.cameras import calibration_files, read_cameras
from omnilines.files.colmap_scene import COLMAP_FILES, LINES_FILE, check_colmap_folder, colmap_cameras, write_colmap_scene
from omnilines.files.fingerprint import fingerprint, revision
from omnilines.files.folders import WORK, check_results, check_work_folder
from omnilines.files.masks import mask_files, with_masks
from omnilines.files.orientation import turned_note
from omnilines.files.recording import rerun_module, write_recording
from omnilines.files.sets import claimed
from omnilines.matching.tracks import FIRST_VIEWS
from omnilines.pages.scene import scene_data, scene_sections, scene_summary
from omnilines.pipelines.adjust import adjust
from omnilines.pipelines.arcs import SHORT_ARCS, cameras_of_photos, extract
from omnilines.pipelines.frame import parse_known_distance, require_poses
from omnilines.pipelines.given_arcs import check_given, given_arcs
from omnilines.pipelines.options import OF_TABLES, SceneOptions
from omnilines.pipelines.pose_tables import has_open_scale, named_cameras, require_readable, unit_of_file, up_of_file
from omnilines.pipelines.poses import check_source, estimate_poses, from_photos, require_body, require_source
from omnilines.pipelines.reconstruct import check_options, reconstruct
from omnilines.pipelines.scene import SCENE, SCENE_FILES, Scene
from omnilines.posing.from_colmap import poses_from_colmap
from omnilines.posing.from_corners import poses_from_corners
from omnilines.posing.from_tool import poses_from_tool
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.tools import pose_file_of
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Segments
from omnilines.report import write_report

STAMP = "done.json"
PAGE, RECORDING = "report.html", "scene.rrd"
RESULTS = (*SCENE_FILES, "lines.obj", PAGE, STAMP)
"""Of photos, always."""
COLMAP = tuple(f"colmap/{name}" for name in (*COLMAP_FILES, LINES_FILE))
MADE_BY = ("camera_models", "calib_patterns", "omnilines")
"""Whose source decides what is written."""


def reconstruct_photos(
    photos: Sequence[Path],
    calibration: Path,
    poses: str,
    out: Path,
    options: SceneOptions = SceneOptions(),
    *,
    extraction: ExtractionOptions = SHORT_ARCS,
    segments: Path | None = None,
    pattern: str | None = None,
    body: Path | None = None,
    scale_from: str | None = None,
    pose_sigma_deg: float | None = None,
    pose_sigma_m: float | None = None,
    mask: Path | None = None,
    colmap: bool = False,
    recording: bool = False,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Rebuild the straight lines that photos show.

    `poses` is a source of `estimate_poses`, `body` its file of where cameras sit on a body. `scale_from`, such as
    `a.jpg,b.jpg:2.5`, is the distance in metres of two photos, where poses leave the scale open. `pose_sigma_deg` and
    `pose_sigma_m`, both or neither, make given poses a prior with these standard deviations. `segments` is a table of unmatched
    segments of these photos, taken in place of arcs that would be found in them; the workers of an `executor` find those, and
    adjust the parts of a divided scene. `colmap` and `recording` add a COLMAP model and a recording for the rerun viewer.

    Writes a scene folder (docs/reconstruction.md). Arcs and poses that were found are kept in `out/work`; a run with the same
    inputs and options as the last one does nothing. A photo that cannot be used is named and skipped. Raises InputError on bad
    input, and GeometryError naming the stage where no line is left.
    """
    refs = with_masks(find_photos(photos), mask)
    cameras = read_cameras(calibration, refs)
    camera_of = cameras_of_photos(refs, cameras, None if from_photos(poses) else named_cameras(poses))
    given = _given(segments, mask, refs, camera_of)
    distance = None
    if scale_from is not None:
        scale_is_open = has_open_scale(poses, cameras, camera_of)
        distance = parse_known_distance(scale_from, [photo.name for photo in refs], scale_is_open)
    folder = Path(out)
    check_source(poses, refs, cameras, camera_of, pattern, body)
    _require_enough(refs, poses)
    prior = _pose_sigma(pose_sigma_deg, pose_sigma_m, "poses" in options.refine)
    check_options(options, cameras, prior)
    if colmap:
        check_colmap_folder(folder / "colmap", [photo.name for photo in refs])
    if recording:
        rerun_module()
    files = [*calibration_files(calibration), *mask_files(refs), *_given_files(segments, body), *_pose_files(poses)]
    read, work = [*photos, *(photo.path for photo in refs), *files], folder / WORK
    names = {*RESULTS, *(COLMAP if colmap else ()), *([RECORDING] if recording else ())}
    check_results(folder, names, read)
    check_work_folder(work, read)
    names_of = [photo.name for photo in refs]
    sizes = [model.image_size for model in cameras.values()]
    wanted = repr((options.stated, extraction.stated, sizes, poses, pattern, distance, prior, colmap, recording, names_of))
    stamp = Stamp(folder / STAMP, fingerprint([*(photo.path for photo in refs), *files], wanted, revision(*MADE_BY)))
    done = stamp.result()
    if done is not None:
        return replace(done, then=_next(folder, done.data.get("lines")))
    if distance is not None and not from_photos(poses):
        require_poses(distance, estimate_poses(refs, cameras, poses, body=body))
    if given is None:
        arcs = extract(
            refs, cameras, camera_of=camera_of, options=extraction, appearance=options.matching.appearance, work=work,
            executor=executor, progress=progress,
        )  # fmt: skip
    else:
        arcs = given_arcs(
            given, refs, cameras, camera_of=camera_of, appearance=options.matching.appearance, name=str(segments),
            progress=progress,
        )  # fmt: skip
    posed = estimate_poses(
        arcs, cameras, poses, pattern=pattern, body=body, refine_rig="rig" in options.refine, options=options.posing,
        seed=options.seed, work=work, progress=progress,
    )  # fmt: skip
    inputs = {"photos": photo_folder(refs), "calibration": calibration, "poses": poses}
    scene = reconstruct(
        arcs, posed, cameras, options, distance=distance, pose_sigma=prior, inputs=inputs, work=work, executor=executor,
        progress=progress,
    )  # fmt: skip
    with claimed(folder, names - {STAMP}, read, by=SCENE):
        result = _written(folder, scene, colmap, recording, progress)
    if colmap or Path(poses).is_dir():
        result = replace(result, warnings=(*result.warnings, *turned_note(refs)))
    if result.holds:
        stamp.write(result)
    return result


def check_videos(
    sizes: Sizes,
    calibration: Path,
    poses: str,
    options: SceneOptions,
    *,
    segments: Path | None = None,
    pattern: str | None = None,
    body: Path | None = None,
    pose_sigma_deg: float | None = None,
    pose_sigma_m: float | None = None,
    mask: Path | None = None,
) -> Calibration:
    """The calibration of videos; refuses, before any frame of them is read, what `reconstruct_photos` refuses of their frames.
    Raises InputError."""
    cameras = cameras_of_videos(calibration, sizes, mask)
    _read(segments, mask)
    require_source(poses, pattern, body)
    if not from_photos(poses):
        require_readable(Path(poses))
    check_options(options, cameras, _pose_sigma(pose_sigma_deg, pose_sigma_m, "poses" in options.refine))
    return cameras


def reconstruct_segments(
    calibration: Path,
    poses: Path,
    segments: Path,
    out: Path,
    options: SceneOptions = replace(OF_TABLES, refine=("lines",)),
    *,
    body: Path | None = None,
    robust: bool = False,
    pose_sigma_deg: float | None = None,
    pose_sigma_m: float | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Triangulate and adjust the lines of a user's own tables (`pipelines.adjust`).

    `pose_sigma_deg` and `pose_sigma_m`, both or neither, make the poses of the table a prior with these standard deviations.

    Writes a scene folder: calibration.yaml, poses.csv, segments.csv, lines.csv, covariance.npz, lines.ply, report.html. Raises
    InputError naming file, line and column where a table is malformed, and GeometryError when no track determines a line.
    """
    prior = _pose_sigma(pose_sigma_deg, pose_sigma_m, "poses" in options.refine)
    names, read = (
        (*SCENE_FILES, PAGE),
        [*calibration_files(calibration), *_given_files(poses, segments, body), *_pose_files(str(poses))],
    )
    check_results(out, names, read)
    cameras, table = read_cameras(calibration), read_segments(segments)
    posed = replace(_poses(poses, table, cameras, body), unit=unit_of_file(poses), up=up_of_file(poses))
    inputs = {"calibration": calibration, "poses": poses, "segments": segments}
    scene = adjust(table, posed, cameras, options, robust=robust, pose_sigma=prior, inputs=inputs, progress=progress)
    with claimed(out, names, read, by=SCENE):
        return _written(out, scene, False, False, progress)


def _require_enough(photos: Sequence[Photo], poses: str) -> None:
    """Raises InputError where photos are too few for any line to be confirmed."""
    if len(photos) >= FIRST_VIEWS:
        return
    more = "give more."
    if poses == "rig":
        more = (
            "a rig of two cameras sees every line from two places at an instant, which nothing confirms: take photos of more "
            "instants, with `poses` sfm."
        )
    raise InputError(f"{FIRST_VIEWS} photos or more were expected to rebuild lines, found {len(photos)}; {more}")


def _given(segments: Path | None, mask: Path | None, photos: Sequence[Photo], camera_of: Mapping[str, str]) -> Segments | None:
    """A user's own segments, where there are some, of these photos."""
    table = _read(segments, mask)
    if table is not None:
        check_given(table, photos, camera_of, str(segments))
    return table


def _read(segments: Path | None, mask: Path | None) -> Segments | None:
    """A user's own segments, where there are some."""
    if segments is None:
        return None
    if mask is not None:
        raise InputError("`mask` says where arcs are looked for, found `segments` beside it; leave one of them out.")
    return read_segments(segments)


def _given_files(*files: Path | None) -> list[Path]:
    return [file for file in files if file is not None]


def _pose_files(source: str) -> list[Path]:
    path = Path(source)
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.suffix in (".bin", ".txt") and file.is_file())
    return [path] if path.is_file() else []


def _poses(path: Path, segments: Segments, cameras: Calibration, body: Path | None) -> PhotoPoses:
    """The poses of a table, a COLMAP model or another tool's file, or those that see a table's points of known place."""
    require_body(str(path), body)
    tool = pose_file_of(path)
    if tool is None and not path.is_dir() and not is_corners_table(path):
        return PhotoPoses(read_poses(path))
    camera_of = dict(zip(segments.images, cameras_of_images(segments, None, cameras), strict=True))
    if path.is_dir():
        return poses_from_colmap(path, segments.images, camera_of)
    if tool is not None:
        return poses_from_tool(path, tool, segments.images, cameras, camera_of, body=body)
    found = poses_from_corners(read_corners(path), cameras, camera_of)
    if found.left_out:
        raise InputError(f"{path}: {next(iter(found.left_out.values()))}")
    return found


def _pose_sigma(sigma_deg: float | None, sigma_m: float | None, refined: bool) -> tuple[float, float] | None:
    """Standard deviations (rad, m) of the prior on poses, or None."""
    if sigma_deg is None and sigma_m is None:
        return None
    if sigma_deg is None or sigma_m is None or not (sigma_deg > 0 and sigma_m > 0) or not refined:
        raise InputError(
            "A prior on poses takes `pose_sigma_deg` and `pose_sigma_m` above 0 and `refine` with poses, found "
            f"{sigma_deg}, {sigma_m} and poses {'refined' if refined else 'held'}; give both or neither."
        )
    return math.radians(sigma_deg), sigma_m


def _written(folder: Path, scene: Scene, colmap: bool, recording: bool, progress: ProgressCallback) -> CommandResult:
    """The scene folder and its page."""
    progress("writing the scene", 0, 0)
    files = [*scene.save(folder)]
    remarks: tuple[str, ...] = ()
    if colmap:
        known, remarks = colmap_cameras(scene.cameras)
        files += write_colmap_scene(folder / "colmap", known, scene.poses, scene.lines, remarks=remarks)
    if recording:
        files.append(folder / RECORDING)
        write_recording(files[-1], scene.lines, scene.poses, scene.cameras)
    progress("writing the report", 0, 0)
    summary = scene_summary(scene)
    files.append(write_report(folder / PAGE, "Line scene", scene_sections(scene, remarks)))
    notes = (*scene.told, *remarks, *summary.notes)
    given = None if scene.from_photos is None else scene.from_photos.given
    return CommandResult(
        (summary,),
        scene_data(scene),
        scene.checks,
        tuple(files),
        files[-1],
        warnings=notes,
        details=scene.details,
        photos=given,
        then=_next(folder, len(scene.lines)),
    )


def _next(folder: Path, lines: int | None) -> tuple[str, ...]:
    """The command that comes next where there are lines."""
    return ("export", str(folder), "lines.dxf") if lines else ()
