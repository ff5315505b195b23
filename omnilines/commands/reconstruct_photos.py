"""omnilines reconstruct PHOTOS: photos + calibration + poses -> arcs, tracks, adjusted lines, scene folder, report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from camera_models import Calibration, GeometryError, InputError, load
from omnilines.adjustment.scene import parse_refine
from omnilines.commands.extract import camera_of_photo, read_mask
from omnilines.commands.reconstruct import write_scene
from omnilines.commands.result import CommandResult
from omnilines.commands.resume import Stamp
from omnilines.costs import check_cost
from omnilines.files import PhotoRef, find_photos, write_poses
from omnilines.files.colmap_scene import check_colmap_folder, colmap_cameras, write_colmap_scene
from omnilines.files.fingerprint import fingerprint
from omnilines.files.folders import output_folder
from omnilines.files.obj import write_obj
from omnilines.files.recording import rerun_module, write_recording
from omnilines.least_squares import Loss
from omnilines.least_squares.devices import usable_device
from omnilines.matching.match import LEAST_VIEWS
from omnilines.pages.photo_scene import scene_data, scene_sections, scene_summary
from omnilines.pipelines.given_arcs import GivenSegments, given_arcs, read_given, remarks_on
from omnilines.pipelines.kept_poses import kept_poses
from omnilines.pipelines.line_scene import PhotoScene, SceneOptions, photo_scene
from omnilines.pipelines.photo_arcs import FoundArcs, find_arcs
from omnilines.pipelines.photo_poses import check_source, from_photos, photo_poses
from omnilines.pipelines.rough_poses import better_poses
from omnilines.pipelines.scene_frame import (
    KnownDistance,
    parse_known_distance,
    require_poses,
    scene_frame,
    unit_of_poses,
    without_scale,
)
from omnilines.pipelines.weak_photos import advice
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.rectangle import PREFIX
from omnilines.posing.sfm import doubt
from omnilines.progress import ProgressCallback, silent
from omnilines.records import LengthUnit
from omnilines.report import write_report
from omnilines.structure.families import line_families
from omnilines.triangulation import check_triangulation

WORK, STAMP, POSES = "work", "done.json", "poses.npz"


def reconstruct_photos(
    photos: Sequence[Path],
    calibration: Path,
    poses: str,
    out: Path,
    *,
    segments: Path | None = None,
    pattern: str | None = None,
    scale_from: str | None = None,
    mask: Path | None = None,
    least_views: int = LEAST_VIEWS,
    tolerance_px: float | None = None,
    triangulation: str = "ml",
    triangulation_options: Mapping[str, Any] | None = None,
    cost: str = "whitened",
    refine: str | None = None,
    loss: str = "cauchy",
    colmap: bool = False,
    recording: bool = False,
    device: str = "cpu",
    seed: int = 0,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Rebuild the straight lines that photos show.

    `poses` is a poses.csv, a folder with a COLMAP model, `rig`, `boards` (with a `pattern`), `rectangle:279x216mm` (a sheet of
    that size in the photos) or `sfm`. `refine` is `lines` unless given, and `lines,poses` with `sfm`; with poses refined, photos
    that have none are placed by the lines. A line is kept that at least `least_views` photos see. `tolerance_px` is the standard
    deviation that arcs have beyond what they state, for errors of poses and calibration; it is found from the arcs where it is
    not given. `scale_from`, such as `a.jpg,b.jpg:2.5`, is the distance in metres of two photos, where poses leave the scale open.
    `segments` is a table of unmatched segments of these photos, taken in place of arcs that would be found in them. `colmap` and
    `recording` add a COLMAP model and a recording for the rerun viewer. `device` is `cpu` or `cuda`.

    Writes a scene folder (docs/reconstruction.md). Arcs and poses that were found are kept in `out/work`; a run with the same
    inputs and options as the last one does nothing. A photo that cannot be used is named and skipped. Raises InputError on bad
    input, and GeometryError naming the stage where no line is left.
    """
    parts = parse_refine(refine or ("lines,poses" if poses == "sfm" else "lines"))
    refs = find_photos(photos)
    cameras = load(calibration)
    camera_of = {photo.name: camera_of_photo(photo, cameras) for photo in refs}
    keep = None if mask is None else read_mask(mask, [cameras[name] for name in set(camera_of.values())])
    unit = unit_of_poses(poses, cameras, camera_of)
    given = _given(segments, mask, refs, camera_of)
    distance = None if scale_from is None else parse_known_distance(scale_from, [photo.name for photo in refs], unit)
    options = SceneOptions(least_views, tolerance_px, triangulation, cost, loss, parts, device, seed, triangulation_options or {})
    folder = output_folder(out)
    _check(options, poses, refs, cameras, camera_of, pattern, folder / "colmap" if colmap else None, recording)
    files = [calibration, *(path for path in (mask, segments) if path is not None), *_pose_files(poses)]
    wanted = repr((options, poses, pattern, distance, colmap, recording, [photo.name for photo in refs]))
    stamp = Stamp(folder / STAMP, fingerprint([*(photo.path for photo in refs), *files], wanted))
    done = stamp.result()
    if done is not None:
        return done
    if distance is not None and not from_photos(poses):
        names = photo_poses(poses, refs, cameras, camera_of, folder, progress=progress)
        require_poses(distance, names)
    if given is None:
        found = find_arcs(refs, cameras, camera_of, keep, folder / WORK / "arcs", progress)
    else:
        found = given_arcs(given, refs, cameras, camera_of, progress)

    def posed_by(source: str) -> PhotoPoses:
        return _posed(source, found, cameras, camera_of, calibration, folder / WORK, pattern, seed, progress)

    posed = posed_by(poses)
    if "poses" in parts and not from_photos(poses) and posed.poses.frames is None:
        posed = better_poses(found, posed, cameras, seed, lambda: posed_by("sfm"), progress)
    table = output_folder(folder / WORK) / "poses.csv"
    write_poses(table, posed.poses)
    if distance is not None:
        require_poses(distance, posed)
    try:
        scene = photo_scene(found, posed.poses, cameras, options, progress)
    except GeometryError as error:
        raise GeometryError(f"{error} Of {len(refs)} photos, {len(posed.poses)} have poses: {table}.") from None
    remarks = () if given is None else remarks_on(given, found)
    asked = _Asked(calibration, poses, unit, distance, "poses" in parts, least_views, colmap, recording, remarks)
    result = _written(folder, scene, found, posed, cameras, refs, asked, progress)
    stamp.write(result)
    return result


def _given(
    segments: Path | None, mask: Path | None, photos: Sequence[PhotoRef], camera_of: Mapping[str, str]
) -> GivenSegments | None:
    """A user's own segments, where there are some."""
    if segments is None:
        return None
    if mask is not None:
        raise InputError("--mask says where arcs are looked for, found --segments beside it; leave one of them out.")
    return read_given(segments, photos, camera_of)


def _posed(
    source: str,
    found: Sequence[FoundArcs],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    calibration: Path,
    work: Path,
    pattern: str | None,
    seed: int,
    progress: ProgressCallback,
) -> PhotoPoses:
    """Poses of the photos that can be used; what has to be looked for in them is kept."""
    usable = [arcs.photo for arcs in found if arcs.reason is None]
    pattern = pattern if source == "boards" else None

    def find() -> PhotoPoses:
        return photo_poses(source, usable, cameras, camera_of, work, pattern=pattern, arcs=found, seed=seed, progress=progress)

    if not from_photos(source):
        return find()
    names = [photo.name for photo in usable]
    counts = [len(arcs) for arcs in found] if source.startswith(PREFIX) else None
    made_from = fingerprint([*(photo.path for photo in usable), calibration], repr((source, pattern, seed, names, counts)))
    return kept_poses(work / POSES, made_from, find)


@dataclass(frozen=True)
class _Asked:
    """What else decides what is written."""

    calibration: Path
    poses: str
    unit: LengthUnit
    distance: KnownDistance | None
    refines_poses: bool
    least_views: int
    colmap: bool
    recording: bool
    remarks: tuple[str, ...]
    """On the segments that were given."""


def _check(
    options: SceneOptions,
    poses: str,
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    pattern: str | None,
    colmap_folder: Path | None,
    recording: bool,
) -> None:
    """Refuse what cannot be done before any photo is looked at."""
    check_source(poses, photos, cameras, camera_of, pattern)
    check_triangulation(options.triangulation)
    check_cost(options.cost)
    Loss(options.loss)
    usable_device(options.device)
    if options.least_views < 3 or (options.slack_px is not None and not options.slack_px > 0):
        raise InputError(
            f"--min-views of 3 or more and a --tolerance-px above 0 were expected, found {options.least_views} and "
            f"{options.slack_px}; correct the options."
        )
    if "rig" in options.refine and not cameras.rig:
        raise InputError("--refine rig was expected with the calibration of a rig, found cameras without one; leave it out.")
    if colmap_folder is not None:
        check_colmap_folder(colmap_folder, [photo.name for photo in photos])
    if recording:
        rerun_module()


def _pose_files(source: str) -> list[Path]:
    path = Path(source)
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.suffix in (".bin", ".txt") and file.is_file())
    return [path] if path.is_file() else []


def _written(
    folder: Path,
    scene: PhotoScene,
    found: Sequence[FoundArcs],
    posed: PhotoPoses,
    cameras: Calibration,
    photos: Sequence[PhotoRef],
    asked: _Asked,
    progress: ProgressCallback,
) -> CommandResult:
    progress("looking for parallel lines", 0, 0)
    families = line_families(scene.scene.lines)
    frame = scene_frame(scene.scene.lines, scene.scene.poses, families, asked.poses, asked.unit, asked.distance)
    scene = replace(scene, scene=replace(scene.scene, lines=frame.lines, poses=frame.poses))
    told = (*_of_poses(asked.poses, posed, scene), *frame.notes, *advice(scene, asked.refines_poses, asked.least_views, progress))
    progress("writing the scene", 0, 0)
    inputs = {"photos": photos[0].path.parent, "calibration": asked.calibration, "poses": asked.poses}
    files = [*write_scene(folder, scene.scene, scene.segments, cameras, inputs), folder / "lines.obj"]
    write_obj(files[-1], frame.lines)
    final = refined_cameras(cameras, scene)
    remarks: tuple[str, ...] = ()
    if asked.colmap:
        known, remarks = colmap_cameras(final)
        files += write_colmap_scene(output_folder(folder / "colmap"), known, frame.poses, frame.lines, remarks=remarks)
    if asked.recording:
        files.append(folder / "scene.rrd")
        write_recording(files[-1], frame.lines, frame.poses, final)
    progress("writing the report", 0, 0)
    summary = scene_summary(scene, len(photos), frame.families)
    skipped = tuple(f"{arcs.photo.name} is skipped: {arcs.reason}" for arcs in found if arcs.reason is not None)
    notes = (*skipped, *asked.remarks, *told, *remarks, *summary.notes)
    sections = scene_sections(scene, final, photos, frame, replace(summary, notes=notes))
    files.append(write_report(folder / "report.html", "Line scene", sections))
    return CommandResult((summary,), scene_data(scene, frame), files=tuple(files), report=files[-1], warnings=notes)


def _of_poses(source: str, posed: PhotoPoses, scene: PhotoScene) -> tuple[str, ...]:
    """What is to be said of where photos were taken."""
    known = set(scene.scene.poses.images)
    placed = sorted(name for name in scene.scene.poses.images if name not in posed.poses.images)
    lost = {name: why for name, why in posed.left_out.items() if name not in known}
    by_lines = f"{', '.join(placed)} had no pose and {'was' if len(placed) == 1 else 'were'} placed by the lines of other photos."
    doubts = doubt(len(lost), len(known) + len(lost)) if source == "sfm" else ()
    return (*lost.values(), *([by_lines] if placed else []), *without_scale(posed.notes), *doubts)


def refined_cameras(cameras: Calibration, scene: PhotoScene) -> Calibration:
    """The calibration with the cameras as they were refined, where they were."""
    if not scene.scene.cameras:
        return cameras
    return replace(cameras, cameras=dict(zip(cameras.cameras, scene.scene.cameras, strict=True)))
