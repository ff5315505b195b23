"""Arcs of photos, poses and cameras -> 3D lines with their uncertainty: `reconstruct`."""

import math
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from camera_models import Calibration, CameraModel, GeometryError, InputError
from camera_models.typed import typed
from camera_models.wording import listed
from omnilines.adjustment.arcs import arcs_from_segments
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import check_refine
from omnilines.costs import check_cost, cost_named
from omnilines.files import photo_folder, write_poses
from omnilines.files.folders import work_folder
from omnilines.least_squares import Loss
from omnilines.least_squares.devices import usable_device
from omnilines.matching.tracks import FIRST_VIEWS
from omnilines.options import require_ranges_of_parts
from omnilines.pipelines.adjust import adjust, check_prior
from omnilines.pipelines.advice import advice, still_rig, weak_photos
from omnilines.pipelines.arcs import calibration_of
from omnilines.pipelines.asked_cameras import asked_by_points, asked_cameras
from omnilines.pipelines.assumed_errors import require_error, with_assumed_errors
from omnilines.pipelines.better_poses import better_poses
from omnilines.pipelines.calibration_errors import (
    beside_stated,
    errors_by_calibration,
    lines_with_calibration_errors,
    poses_with_calibration_errors,
    wider_lines,
)
from omnilines.pipelines.copies import without_copies
from omnilines.pipelines.coplanar_lines import coplanar_lines
from omnilines.pipelines.cornered_lines import cornered_lines, corners_of
from omnilines.pipelines.directions import world_verticals
from omnilines.pipelines.frame import SFM, KnownDistance, require_poses, scene_frame, without_scale
from omnilines.pipelines.frame_notes import frame_notes, unplaced_notes
from omnilines.pipelines.judged_photos import READ, doubted_photos, refuse_reading
from omnilines.pipelines.kept_lines import KeptLines
from omnilines.pipelines.lines import lines_of_arcs
from omnilines.pipelines.moved_photos import photos_far_from_given
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.parallel_lines import guided_lines, with_rms
from omnilines.pipelines.part_workers import check_partition, matching_workers, part_workers
from omnilines.pipelines.photo_arcs import PhotoArcs, require_cameras_of
from omnilines.pipelines.pose_errors import errors_by_poses
from omnilines.pipelines.pose_tables import given_poses
from omnilines.pipelines.poses import estimate_poses
from omnilines.pipelines.rig_of_poses import rig_by_poses
from omnilines.pipelines.same_place import without_same_place
from omnilines.pipelines.scene import FromPhotos, Scene, refined_calibration
from omnilines.pipelines.scene_size import size_notes
from omnilines.pipelines.still_camera import still_share
from omnilines.pipelines.supposed_errors import supposed_errors, unfollowed_errors
from omnilines.posing.from_rig import with_rig
from omnilines.posing.options import PosingOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.sfm import doubt
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Advice, Check, Detail, ImagePoses, Lines, Segments
from omnilines.structure.families import Families, line_families
from omnilines.structure.options import DirectionsOptions
from omnilines.triangulation import check_triangulation


def check_options(options: SceneOptions, cameras: Calibration, pose_sigma: tuple[float, float] | None = None) -> None:
    """Refuse what cannot be done before any photo is looked at. Raises InputError."""
    check_prior(pose_sigma, options)
    check_refine(options.refine)
    check_triangulation(options.triangulation)
    check_cost(options.cost)
    Loss(options.loss)
    usable_device(options.device)
    check_partition(options, rig=False, prior=pose_sigma is not None)
    if options.min_views < 3 or (options.tolerance_px is not None and not options.tolerance_px > 0):
        raise InputError(
            f"`min_views` of 3 or more and a `tolerance_px` above 0 were expected, found {options.min_views} and "
            f"{options.tolerance_px}; correct the options."
        )
    if options.bow_share is not None and not 0 <= options.bow_share < 1:
        raise InputError(f"A `bow_share` from 0 to below 1 was expected, found {options.bow_share}; correct the option.")
    require_error(options)
    require_ranges_of_parts(options)
    if options.seed < 0:
        raise InputError(f"A `seed` of 0 or more was expected, found {options.seed}; correct it.")
    if "rig" in options.refine and not cameras.rig:
        raise InputError("`refine` rig was expected with the calibration of a rig, found cameras without one; leave it out.")


@typed
def reconstruct(
    arcs: PhotoArcs | Segments,
    poses: PhotoPoses | ImagePoses,
    camera: CameraModel | Calibration,
    options: SceneOptions = SceneOptions(),
    *,
    distance: KnownDistance | None = None,
    pose_sigma: tuple[float, float] | None = None,
    inputs: Mapping[str, Any] | None = None,
    work: str | Path | None = None,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> Scene:
    """The straight lines that photos show, from their arcs (`extract`), or from a table of matched segments.

    `poses` are those of `estimate_poses` or `read_poses`. With poses refined (`options.refine`), rough ones are made better
    first, and photos that have none are placed by the lines. `distance`, known in metres, scales poses whose unit is open.
    `pose_sigma` (rad, m) makes given poses that are refined a prior with these standard deviations of each component, but for
    those of photos that lines put elsewhere.
    `inputs` is what the scene says that it was made from. Poses that have to be found in the photos are kept in the folder
    `work`, where one is given. The workers of an `executor` compare arcs, and adjust the parts of a scene that
    is divided (`options.partition`).

    Raises InputError on bad options or tables, and where poses explain the photos only if they are read in another way, and
    GeometryError naming the stage where no line is left.

        >>> camera = ol.load("room/calibration.yaml")["cam0"]
        >>> arcs, poses = ol.extract("room/", camera), ol.read_poses("room/poses.csv")
        >>> scene = ol.reconstruct(arcs, poses, camera, ol.SceneOptions(refine=("lines", "poses")))
        >>> scene.lines.ends_m.shape[1:], scene.lines.covariance.shape[1:], scene.poses.covariance.shape
        ((2, 3), (4, 4), (6, 6, 6))
        >>> len(scene.save("rebuilt/")), scene.report("rebuilt/report.html").name
        (7, 'report.html')
    """
    if isinstance(arcs, Segments):
        if distance is not None:
            raise InputError("`distance` counts only with arcs of photos, found matched segments; give poses in metres.")
        return adjust(arcs, poses, camera, options, pose_sigma=pose_sigma, inputs=inputs, executor=executor, progress=progress)
    cameras = calibration_of(camera)
    require_cameras_of(arcs, cameras)
    check_options(options, cameras, pose_sigma)
    stated = poses if isinstance(poses, ImagePoses) else poses.poses
    cameras = with_rig(cameras, poses.rig if isinstance(poses, PhotoPoses) else {})
    arcs, posed, given = _with_poses(arcs, poses, cameras, options, distance, work, progress, pose_sigma)
    cameras, of_rig = rig_by_poses(posed.poses, cameras, options)
    posed = replace(posed, notes=(*posed.notes, *of_rig))
    if options.min_views == SceneOptions.min_views:
        # Nobody who brings three photos asks for lines of four.
        options = replace(options, min_views=max(3, min(options.min_views, len(arcs.used))))
    table = None if work is None else work_folder(work) / "poses.csv"
    if table is not None:
        write_poses(table, posed.poses)
    if distance is not None:
        require_poses(distance, posed)
    try:
        found = lines_of_arcs(
            arcs.photos, posed.poses, cameras, options, progress, known=given,
            workers=part_workers(executor, work), compare=matching_workers(executor),
        )  # fmt: skip
    except GeometryError as error:
        refuse_reading(arcs.photos, posed, cameras, options, progress)
        known = f"{len(posed.poses)} have poses" + (f": {table}." if table else ".")
        why = "".join(f" {said}" for said in (*list(posed.left_out.values())[:1], *posed.notes[:1]))
        if posed.source in READ and "poses" not in options.refine:
            why += " Where names of photos and poses are exchanged, or slipped by a row, `refine` lines,poses says so."
        raise GeometryError(f"{error} Of {len(arcs.photos)} photos, {known}{why}") from None
    if not found.matched.beyond_chance:
        refuse_reading(arcs.photos, posed, cameras, options, progress)
    made_from = {**arcs.inputs, "poses": posed.source, "options": options} if inputs is None else inputs
    return _scene(arcs, stated, posed, found, cameras, options, distance, given, made_from, progress)


def _with_poses(
    arcs: PhotoArcs,
    poses: PhotoPoses | ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    distance: KnownDistance | None,
    work: str | Path | None,
    progress: ProgressCallback,
    pose_sigma: tuple[float, float] | None,
) -> tuple[PhotoArcs, PhotoPoses, KnownPoses | None]:
    """The photos that tell something beside others, the poses that they are matched with, and what a prior says of those given.

    Raises InputError where a prior holds poses that were found in the photos.
    """
    arcs = without_copies(arcs, (poses if isinstance(poses, ImagePoses) else poses.poses).images)
    posed = poses if isinstance(poses, PhotoPoses) else _of_table(arcs, poses, cameras)
    given = posed.poses
    if pose_sigma is not None and posed.source == SFM:
        raise InputError("A prior holds given poses, found those of the photos alone (`poses` sfm); leave the prior out.")
    if "poses" in options.refine and posed.source in READ and posed.poses.frames is None:
        posed = better_poses(
            arcs.photos,
            posed,
            cameras,
            from_photos=lambda: estimate_poses(
                arcs, cameras, SFM, options=options.posing, seed=options.seed, work=work, progress=progress
            ),
            options=options,
            progress=progress,
        )
    asked = () if distance is None else (distance.first, distance.second)
    arcs, posed = without_same_place(arcs, posed, cameras, options.same_place, asked)
    if pose_sigma is None:
        return arcs, posed, None
    rows = [k for k, image in enumerate(given.images) if image in posed.poses.images]
    return arcs, posed, KnownPoses(given.rows(rows), *pose_sigma)


def _of_table(arcs: PhotoArcs, poses: ImagePoses, cameras: Calibration) -> PhotoPoses:
    """A table's poses of the photos that can be used."""
    return given_poses(poses, [one.photo.name for one in arcs.used], cameras, arcs.camera_of, path="The table of poses")


def _scene(
    arcs: PhotoArcs,
    stated: ImagePoses,
    posed: PhotoPoses,
    found: KeptLines,
    cameras: Calibration,
    options: SceneOptions,
    distance: KnownDistance | None,
    known: KnownPoses | None,
    inputs: Mapping[str, Any],
    progress: ProgressCallback,
) -> Scene:
    """Lines and poses in the frame that they are written in, and what is to be said of them; `stated` are the poses as they were
    given."""
    lines, poses = found.scene.lines, found.scene.poses
    arcs_of_lines = arcs_from_segments(found.segments, poses, cameras, with_nodes=cost_named(options.cost).integrates).arcs
    cameras = with_assumed_errors(cameras, arcs_of_lines, options)
    progress("asking lines for the calibration", 0, 0)
    prior = beside_stated(found.held, found.scene.adjusted.noise)
    errors = errors_by_calibration(lines, arcs_of_lines, found.track, poses, cameras, options, posed.points, prior=prior)
    supposed = supposed_errors(lines, arcs_of_lines, found.track, poses, cameras, options, posed.points, prior=prior)
    by_poses = errors_by_poses(lines, arcs_of_lines, found.track, poses, options)
    asked = asked_cameras(lines, arcs_of_lines, found.track, poses, cameras, options)
    asked += asked_by_points(posed.cameras, cameras, options)
    poses = poses_with_calibration_errors(poses, errors)
    progress("looking for parallel lines", 0, 0)
    families = line_families(lines, options.structure.families)
    lines = _guided(found, families, options)
    if lines is not found.scene.lines:
        lines = with_rms(lines, found.segments, poses, refined_calibration(found.scene, cameras).cameras)
    sought = DirectionsOptions(upright=options.structure.upright)
    frame = scene_frame(
        lines, poses, families, source=posed.source, unit=posed.unit, stated_up=posed.up, known=distance,
        verticals=lambda: world_verticals(arcs.used, poses, cameras, sought, progress), options=options,
    )  # fmt: skip
    # Only now: families, planes and corners are of lines whose errors are their own.
    weak_share = options.adjustment.weak_share
    whole = frame.lines if by_poses is None else wider_lines(frame.lines, by_poses, weak_share)
    whole = lines_with_calibration_errors(whole, errors, weak_share)
    found = replace(found, scene=replace(found.scene, lines=whole, poses=frame.poses))
    lost = _without_poses(posed, found.scene.poses)
    told = (
        *arcs.notes,
        *_by_chance(found),
        *unfollowed_errors(cameras, options, supposed),
        *_of_few(len(arcs.used), options.min_views),
        *_of_poses(posed, found.scene.poses, len(lost), distance, options.posing),
        *unplaced_notes(found.scene),
        *_of_given(posed, found, known, options),
        *frame.notes,
        *size_notes(frame.lines, frame.poses, options.judge),
    )
    still = still_share(found)
    explained = float(np.median([photo.share for photo in found.photos]))
    doubts = doubted_photos(arcs.photos, posed, cameras, explained, options, progress)
    moves, moved = _of_moved(stated, posed, found, options)
    folder = photo_folder([one.photo for one in arcs.photos])
    of_photos = FromPhotos(
        folder, len(arcs.photos), arcs.skipped, found.stages, found.photos, found.tolerance_px, found.matched.bow_share,
        frame.families, math.nan if posed.source == SFM else still,
        still_rig(poses, posed.source, options) is not None,
    )  # fmt: skip
    unused = (*arcs.skipped_details, *lost)
    return Scene(
        found.scene,
        found.segments,
        refined_calibration(found.scene, cameras),
        inputs,
        told,
        unused,
        of_photos,
        options,
        _checks(found),
        (*posed.advice, *moves, *doubts, *advice(found, still, posed.source, moved, options, progress)),
        asked,
        supposed,
        frame.up,
    )


def _of_moved(
    stated: ImagePoses, posed: PhotoPoses, found: KeptLines, options: SceneOptions
) -> tuple[tuple[Advice, ...], frozenset[str]]:
    """The photos that refined poses put far from those given, where some were given."""
    if posed.source == SFM or "poses" not in options.refine or not found.matched.beyond_chance:
        return (), frozenset()
    weak = {photo.image: photo for photo in weak_photos(found.photos, options.advice.hardly_explained)}
    return photos_far_from_given(stated, found.scene.poses, weak, posed.unit, options.moved)


def _of_given(posed: PhotoPoses, found: KeptLines, known: KnownPoses | None, options: SceneOptions) -> tuple[str, ...]:
    """What refined poses keep of given ones, and which of these a prior does not hold."""
    if posed.source == SFM:
        return ()
    told = frame_notes(found.scene, found.held, options)
    if known is None or found.held is None:
        return told
    free = [image for image in known.poses.images if image not in found.held.poses.images]
    if not free:
        return told
    them = "its pose" if len(free) == 1 else "their poses"
    elsewhere = f"The lines of other photos put {listed(free)} elsewhere than given: no prior holds {them}."
    return (*told[:1], elsewhere, *told[1:])


def _guided(found: KeptLines, families: Families, options: SceneOptions) -> Lines:
    """The lines as families, planes and corners tell them, one after the other, as far as they are less certain."""
    lines, track, asked = found.scene.lines, found.track, options.kept_lines
    if asked.guided_by_families:
        lines = guided_lines(lines, families)
    if asked.guided_by_planes:
        lines = coplanar_lines(lines, track, families, options.structure)
    if asked.guided_by_corners:
        arcs = found.matched.arcs.with_poses(found.scene.poses.cam_from_world)
        corners = corners_of(arcs, np.append(track, -1)[found.segments.track], options.structure.corners)
        lines = cornered_lines(lines, track, corners, options.structure.corners)
    return lines


def _checks(found: KeptLines) -> tuple[Check, ...]:
    """None where lines stand out."""
    if found.matched.beyond_chance:
        return ()
    return (
        Check("arcs in lines that agree by chance alone", float(sum(photo.in_lines for photo in found.photos)), 0.0, "", False),
    )


def _by_chance(found: KeptLines) -> tuple[str, ...]:
    """Where hardly anything is explained."""
    if found.matched.beyond_chance:
        return ()
    kept, arcs = (sum(getattr(photo, stage) for photo in found.photos) for stage in ("in_lines", "arcs"))
    return (
        f"The arcs of the photos agree no more than by chance, and the lines explain {kept} of {arcs}: do not rely on them, and "
        "check that poses and calibration are of these photos.",
    )


def _of_few(photos: int, min_views: int) -> tuple[str, ...]:
    """Where every photo has to see every line."""
    if photos > min_views:
        return ()
    fewer = max(min_views - 1, FIRST_VIEWS)
    or_fewer = f", or {fewer} whose arcs all agree" if fewer < photos else ""
    return (f"All {photos} photos have to see a line{or_fewer}: what fewer show is left out, and no other confirms it.",)


def _without_poses(posed: PhotoPoses, final: ImagePoses) -> tuple[Detail, ...]:
    """Why photos have no pose."""
    known = set(final.images)
    return tuple(Detail(name, why) for name, why in posed.left_out.items() if name not in known)


def _of_poses(
    posed: PhotoPoses, final: ImagePoses, lost: int, distance: KnownDistance | None, options: PosingOptions
) -> tuple[str, ...]:
    """What is to be said of where photos were taken; `lost` of them have no pose."""
    placed = sorted(name for name in final.images if name not in posed.poses.images)
    by_lines = f"{', '.join(placed)} had no pose and {'was' if len(placed) == 1 else 'were'} placed by the lines of other photos."
    doubts = doubt(lost, len(set(final.images)) + lost, options.growth) if posed.source == SFM else ()
    return (*doubts, *([by_lines] if placed else []), *without_scale(posed.notes, distance))
