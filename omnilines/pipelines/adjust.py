"""Matched segments, poses and cameras -> 3D lines: `triangulate`, and `adjust` with all that is refined."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models import Calibration, CameraModel, GeometryError, InputError
from camera_models._arrays import as_tensor
from camera_models.pose import Pose
from camera_models.typed import found, typed
from omnilines.adjustment.arcs import MatchedArcs, arcs_from_segments, cameras_of_images
from omnilines.adjustment.prior import KnownPoses
from omnilines.adjustment.scene import AdjustedScene, check_refine, reconstruct_lines
from omnilines.files.scene_folder import Z_UP
from omnilines.files.segments import repeated
from omnilines.least_squares.devices import usable_device
from omnilines.options import require_ranges_of_parts
from omnilines.pipelines.arcs import calibration_of
from omnilines.pipelines.asked_cameras import AskedCamera, asked_cameras
from omnilines.pipelines.assumed_errors import require_error, with_assumed_errors
from omnilines.pipelines.calibration_errors import (
    errors_by_calibration,
    lines_with_calibration_errors,
    poses_with_calibration_errors,
)
from omnilines.pipelines.copies import copied_segments
from omnilines.pipelines.far_photos import far_photos
from omnilines.pipelines.frame_notes import frame_notes, unplaced_notes
from omnilines.pipelines.inside import require_inside
from omnilines.pipelines.judged_tracks import Misfit, judge_tracks, limits_px
from omnilines.pipelines.moved_photos import photos_far_from_given
from omnilines.pipelines.options import OF_PHOTOS, OF_TABLES, SceneOptions
from omnilines.pipelines.part_workers import check_partition, part_workers
from omnilines.pipelines.rig_of_poses import rig_by_poses
from omnilines.pipelines.scene import Scene, refined_calibration
from omnilines.pipelines.scene_size import size_notes
from omnilines.pipelines.supposed_errors import supposed_errors, unfollowed_errors
from omnilines.posing.from_rig import with_rig
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Check, ImagePoses, LengthUnit, Lines, PosePoints, Segments
from omnilines.triangulation import check_triangulation
from omnilines.triangulation.batches import triangulate_on
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation


@typed
def adjust(
    segments: Segments,
    poses: PhotoPoses | ImagePoses | Pose,
    camera: CameraModel | Calibration,
    options: SceneOptions = OF_TABLES,
    *,
    robust: bool = False,
    pose_sigma: tuple[float, float] | None = None,
    inputs: Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> Scene:
    """Triangulate the tracks of matched segments and adjust their lines, and what `options.refine` names beside them.

    `poses` alone (a `Pose` of n) are those of `segments.images` in their order. With `robust`, observations of other lines are
    found by consensus and left out. `pose_sigma` (rad, m) makes the given poses a prior with these standard deviations of each
    component; poses have to be refined then. `inputs` is what the scene says that it was made from. The workers of an `executor`
    adjust the parts of a scene that is divided (`options.partition`).

    Raises InputError where tables do not fit together, segments lie outside their images, or poses and cameras explain the tracks
    no better than chance or far worse than if they were read in another way (`judge_tracks`), and GeometryError when no track
    determines a line.

        >>> segments, poses = ol.read_segments("scene/segments.csv"), ol.read_poses("scene/poses.csv")
        >>> scene = ol.adjust(segments, poses, ol.load("scene/calibration.yaml"))
        >>> scene.lines.ends_m.shape[1:], scene.poses.covariance.shape
        ((2, 3), (6, 6, 6))
    """
    check_refine(options.refine)
    require_error(options)
    require_ranges_of_parts(options)
    idle = [name for name in OF_PHOTOS if getattr(options, name) != getattr(OF_TABLES, name)]
    if idle:
        raise InputError(f"`{idle[0]}` counts only with photos, found matched segments; leave that option as it is.")
    check_prior(pose_sigma, options)
    cameras = with_rig(calibration_of(camera), poses.rig if isinstance(poses, PhotoPoses) else {})
    table = _table_of(poses, segments)
    cameras, of_rig = rig_by_poses(table, cameras, options)
    known = None if pose_sigma is None else KnownPoses(table, *pose_sigma)
    check_partition(options, rig=bool(cameras.rig) and table.frames is not None, prior=known is not None)
    require_inside(segments, cameras_of_images(segments, table, cameras), cameras, options.judge)
    progress("triangulating", 0, 0)
    scene = _adjusted(segments, table, cameras, options, robust, known, executor=executor, progress=progress)
    misfit = _judged(scene, table.cam_from_world, cameras, options)
    _require_lines(scene.lines)
    cameras = with_assumed_errors(cameras, _fitting(scene)[0], options)
    points = poses.points if isinstance(poses, PhotoPoses) else {}
    supposed = supposed_errors(scene.lines, *_fitting(scene), scene.poses, cameras, options, points, prior=known)
    scene = _with_calibration_errors(scene, points, cameras, options, known)
    told = (*scene.table.left_out, *copied_segments(segments), *of_rig, *(() if misfit is None else misfit.notes))
    told += unfollowed_errors(cameras, options, supposed)
    unit, up = (poses.unit, poses.up) if isinstance(poses, PhotoPoses) else (LengthUnit.METRES, None)
    scene = replace(scene, lines=replace(scene.lines, unit=unit))
    told += (*unplaced_notes(scene), *frame_notes(scene, known, options), *size_notes(scene.lines, scene.poses, options.judge))
    made_from = {"options": options} if inputs is None else inputs
    checks = _checks(scene, misfit, limits_px(scene.table.arcs, list(cameras.values()), options.judge)[1])
    refined, holds = "poses" in options.refine, all(check.holds for check in checks)
    strange = far_photos(scene, table.cam_from_world, options.judge, refined=refined, seed=options.seed)
    # An adjustment that went astray tells nothing of the poses that it began from.
    moves = photos_far_from_given(table, scene.poses, {}, unit, options.moved)[0] if refined and holds else ()
    asked: tuple[AskedCamera, ...] = ()
    # Photos and poses that are wrong ask anything of a camera.
    if not strange and holds:
        progress("asking lines for the calibration", 0, 0)
        asked = asked_cameras(scene.lines, *_fitting(scene), scene.poses, cameras, options)
    return Scene(
        scene,
        segments,
        refined_calibration(scene, cameras),
        made_from,
        told,
        options=options,
        checks=checks,
        advice=(*strange, *moves),
        asked=asked,
        supposed=supposed,
        up=up or Z_UP,
    )


def _adjusted(
    segments: Segments,
    table: ImagePoses,
    cameras: Calibration,
    options: SceneOptions,
    robust: bool,
    known: KnownPoses | None,
    *,
    executor: Executor | None,
    progress: ProgressCallback,
) -> AdjustedScene:
    """The scene of the tracks. Where none gives a line, the error is what the tracks tell of poses and cameras, if they do."""
    try:
        return reconstruct_lines(
            segments,
            table,
            cameras,
            triangulation=options.triangulation,
            triangulation_options=options.triangulation_options,
            cost=options.cost,
            refine_poses="poses" in options.refine,
            refine_cameras="intrinsics" in options.refine,
            refine_rig="rig" in options.refine,
            rig=cameras.rig,
            known=known,
            robust=robust,
            loss=options.loss,
            options=options.adjustment,
            device=options.device,
            partition=options.partition,
            workers=part_workers(executor, None),
            callback=lambda step: progress("adjusting the scene", step.iteration, 0),
        )
    except GeometryError:
        arcs = arcs_from_segments(segments, table, cameras, with_nodes=False).arcs
        judge_tracks(arcs, table.cam_from_world, list(cameras.values()), options=options.judge, seed=options.seed)
        raise


def _require_lines(lines: Lines) -> None:
    """Raises GeometryError where no track has a line, with the reasons."""
    if not lines.known.any():
        reasons = ", ".join(f"{count} {status}" for status, count in Counter(lines.status).most_common())
        raise GeometryError(
            f"At least one track that determines a line was expected, found none of {len(lines)} after the adjustment: "
            f"{reasons}; give photos from more places."
        )


def _with_calibration_errors(
    scene: AdjustedScene,
    points: Mapping[str, PosePoints],
    cameras: Calibration,
    options: SceneOptions,
    known: KnownPoses | None,
) -> AdjustedScene:
    """With what errors of the calibration leave uncertain of lines and poses."""
    arcs, every = _fitting(scene)
    errors = errors_by_calibration(scene.lines, arcs, every, scene.poses, cameras, options, points, prior=known)
    lines = lines_with_calibration_errors(scene.lines, errors, options.adjustment.weak_share)
    return replace(scene, lines=lines, poses=poses_with_calibration_errors(scene.poses, errors))


def _fitting(scene: AdjustedScene) -> tuple[MatchedArcs, Int[np.ndarray, " n"]]:
    """The arcs that lines rest on, and the line of each row of the table: each has one."""
    used = torch.as_tensor(np.isfinite(scene.residual_px).all(1))
    return scene.table.arcs.rows(used), np.arange(len(scene.lines))


def check_prior(pose_sigma: tuple[float, float] | None, options: SceneOptions) -> None:
    """Raises InputError where the deviations of a prior are none, or poses are held."""
    if pose_sigma is not None and not (min(pose_sigma) > 0 and "poses" in options.refine):
        held = "refined" if "poses" in options.refine else "held"
        raise InputError(
            f"A prior on poses takes deviations above 0 and `refine` with poses, found {pose_sigma} and poses {held}."
        )


def _checks(scene: AdjustedScene, misfit: Misfit | None, limit_px: float) -> tuple[Check, ...]:
    """Whether the lines are those of the tracks: not where half of the tracks, or of the segments, lie far from their lines."""
    far_px = np.abs(scene.residual_px).max(-1)
    known = far_px[np.isfinite(far_px)]
    figures = {} if misfit is None else {"half of the tracks from any line": misfit.px}
    if len(known):
        figures["half of the segments from their lines"] = float(np.median(known))
    return tuple(Check(f"distance of {what}", px, limit_px, "px", px <= limit_px) for what, px in figures.items())


def _judged(scene: AdjustedScene, given: Pose, cameras: Calibration, options: SceneOptions) -> Misfit | None:
    """How well tracks fit. Raises InputError where nothing explains them."""
    arcs = scene.table.arcs
    final = arcs.seen_by(scene.cameras) if scene.cameras else arcs
    end = final, scene.poses.cam_from_world
    return judge_tracks(arcs, given, list(cameras.values()), refined=end, options=options.judge, seed=options.seed)


@typed
def triangulate(
    segments: Segments,
    poses: PhotoPoses | ImagePoses | Pose,
    camera: CameraModel | Calibration,
    method: str = "ml",
    *,
    device: str = "cpu",
    **options: Any,
) -> Triangulation:
    """The lines of the tracks of matched segments, from poses and cameras as they are; `options` are those of the method.

    Raises InputError where tables do not fit together, segments lie outside their images, there is no such method, or poses and
    cameras explain the tracks no better than chance or far worse than if they were read in another way (`judge_tracks`).

        >>> segments, poses = ol.read_segments("scene/segments.csv"), ol.read_poses("scene/poses.csv")
        >>> found = ol.triangulate(segments, poses, ol.load("scene/calibration.yaml"))
        >>> len(found) == len(segments.tracks), found.status_names.count("ok") > 20
        (True, True)
    """
    check_triangulation(method)
    cameras, table = calibration_of(camera), _table_of(poses, segments)
    require_inside(segments, cameras_of_images(segments, table, cameras), cameras)
    arcs = arcs_from_segments(segments, table, cameras, with_nodes=False).arcs
    judge_tracks(arcs, table.cam_from_world, list(cameras.values()))
    covariance = arcs.covariance_px2 if arcs.sigma_known else None
    seen_from = table.cam_from_world[arcs.image]
    planes = PlaneObservations.from_arcs(
        arcs.bearings, seen_from, arcs.track, arcs.tracks, arcs.by_pixel, covariance_px2=covariance
    )
    return triangulate_on(usable_device(device), method, planes, **options)


def segments_of_arrays(
    endpoints_px: Float[np.ndarray, "n 2 2"] | Float[torch.Tensor, "n 2 2"],
    image: Int[np.ndarray, " n"] | Int[torch.Tensor, " n"] | Sequence[int],
    track: Int[np.ndarray, " n"] | Int[torch.Tensor, " n"] | Sequence[int],
    *,
    sigma_px: Float[np.ndarray, " n"] | Float[torch.Tensor, " n"] | None = None,
    covariance_px2: Float[np.ndarray, "n 2 2 2"] | Float[torch.Tensor, "n 2 2 2"] | None = None,
) -> Segments:
    """A table of segments from arrays: both ends of each, the number of its photo, and that of its line (-1 for none).

    Raises InputError where their lengths differ, they are no segments (`Segments`), the two ends of one are one pixel, or a line
    has the same segment of a photo twice, either way round.

        >>> ends_px = np.array([[[10.0, 10.0], [50.0, 12.0]], [[8.0, 30.0], [9.0, 70.0]]])
        >>> ol.segments_of_arrays(ends_px, [0, 1], [0, 0]).images
        ('0', '1')
    """
    photo, line = _indices(image, "image"), _indices(track, "track")
    segments = Segments(
        photo,
        tuple(str(k) for k in range(int(photo.max(initial=-1)) + 1)),
        line,
        tuple(str(k) for k in range(int(line.max(initial=-1)) + 1)),
        as_tensor(endpoints_px).numpy(),
        None if sigma_px is None else as_tensor(sigma_px).numpy(),
        None if covariance_px2 is None else as_tensor(covariance_px2).numpy(),
    )
    ends = segments.endpoints_px
    points = np.flatnonzero((ends[:, 0] == ends[:, 1]).all(1))
    if len(points):
        raise InputError(
            f"`endpoints_px` was expected with two ends for each segment, found {ends[points[0], 0].tolist()} as both of row "
            f"{points[0]}; remove the row."
        )
    if (pair := repeated(photo, line, ends)) is not None:
        raise InputError(
            f"`endpoints_px` was expected with each segment once, found that of row {pair[0]} in row {pair[1]} again; remove one "
            "of the two rows."
        )
    return segments


def _indices(given: np.ndarray | torch.Tensor | Sequence[int], name: str) -> Int[np.ndarray, " n"]:
    """Numbers of photos or lines. Raises InputError where they are none."""
    numbers = np.asarray(given)
    if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
        raise InputError(f"`{name}` was expected as whole numbers in a row, found {found(given)}; correct it.")
    return numbers.astype(np.int64)


def _table_of(poses: PhotoPoses | ImagePoses | Pose, segments: Segments) -> ImagePoses:
    """The poses as a table; single ones are of the photos of the segments."""
    if isinstance(poses, PhotoPoses):
        return poses.poses
    if isinstance(poses, ImagePoses):
        return poses
    each = poses[None] if poses.is_single else poses
    if len(each) != len(segments.images):
        raise InputError(f"A pose of each of {len(segments.images)} photos was expected, found {len(each)}; give as many.")
    return ImagePoses(segments.images, each)
