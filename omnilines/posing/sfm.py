"""Poses of photos that nothing is known of, by structure from motion with the calibrated cameras held.

features as bearings (features.py) -> matches (feature_matches.py) -> COLMAP on ideal panoramas (colmap_mapper.py) -> guided
matches, resection of what COLMAP could not place, and a last adjustment of all poses with all bearings (growth.py).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import Calibration, CameraModel, GeometryError
from camera_models.pose import Pose, adjoint
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.cameras_by_points import cameras_by_points
from omnilines.posing.carried_along import agreeing, carried_share
from omnilines.posing.colmap_mapper import MapperInput
from omnilines.posing.feature_matches import matched, pairs_to_compare
from omnilines.posing.features import Features, feature_finder
from omnilines.posing.from_rig import cam_from_rig_of
from omnilines.posing.growth import Grown, Matches, grow, matched_again, start_from
from omnilines.posing.joining import TO_MASK, about_one_place, from_one_place, joined, mapped, others
from omnilines.posing.options import FeatureOptions, GrowthOptions, PosingOptions
from omnilines.posing.photo_changes import change_doubts
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.point_adjustment import Frames, PosesAndPoints
from omnilines.posing.rig_from_points import photos_alone, rig_doubts, with_rig_of_points
from omnilines.posing.still_rig import rig_that_stood_still
from omnilines.progress import ProgressCallback, on_all_cores, one_torch_thread, silent
from omnilines.records import ImagePoses

OPEN_SCALE = "The scale is not known: the unit of length is about the cameras' root mean square distance from their middle."
"""The note of poses whose unit nothing tells."""
GOES_ALONG = (
    "{:.0%} of what photos have in common lies at the same place in them although the camera turned: it goes along with it{}; "
    f"{TO_MASK}"
)
WITHOUT_IT = ", and poses are found without it"
MAX_TABLES = 4
"""Pairs of photos compared at once; each takes 0.1 GB."""


def sfm_poses(
    photos: Sequence[str],
    read: Callable[[str], np.ndarray],
    cameras: Mapping[str, CameraModel],
    camera_of: Mapping[str, str],
    work_folder: Path,
    *,
    frame_of: Mapping[str, str] | None = None,
    progress: ProgressCallback = silent,
    seed: int = 0,
    options: PosingOptions = PosingOptions(),
    mask_of: Callable[[str], Bool[np.ndarray, "h w"] | None] = lambda _: None,
    refine_rig: bool = False,
) -> PhotoPoses:
    """`cam_from_world` of photos from what they have in common, with covariances (left perturbation, rad and world units).

    `read` gives the photo of a name, (h, w) or (h, w, 3) of 8 or 16 bits; it is called from several threads, once for each photo,
    and so is `mask_of`, which gives where the photo is looked at, None for everywhere.
    `cameras` may be a `Calibration`: features beyond the angles that its estimates are supported by are then left out, and where
    it holds a rig and `frame_of` names the instants, the cameras of a frame move as one and lengths are metres. Otherwise the
    scale is open: the root mean square distance of the cameras from their middle is then 1. The world is the frame of the first
    photo that has a pose (of a rig: its rig frame). With `refine_rig`, photos that contradict the places of the rig's cameras
    tell others (`PhotoPoses.rig`). COLMAP works in `work_folder`/colmap.

    Raises InputError where a photo has not the size of its camera, and GeometryError where no three
    photos (frames) could be joined.
    """
    calibration = cameras if isinstance(cameras, Calibration) else Calibration(dict(cameras))
    rigid = bool(calibration.rig) and frame_of is not None
    frame_names = [frame_of[photo] if rigid and frame_of is not None else photo for photo in photos]
    order = {name: number for number, name in enumerate(dict.fromkeys(frame_names))}
    names = [camera_of[photo] for photo in photos]
    features = _features(photos, read, mask_of, calibration, names, progress, options.features)
    matches = _matches(features, seed, progress, options)
    numbers = list(calibration)
    in_rig = {numbers.index(name): calibration.rig[name].cam_from_rig for name in numbers} if rigid else {}
    frame = [order[name] for name in frame_names]
    given = MapperInput(features, matches.clear, [numbers.index(name) for name in names], frame, in_rig)
    asked = _Asked(
        photos, names, frame_names if rigid else None, calibration, given, refine_rig, Path(work_folder), seed, progress, options
    )
    parts, matches, told = joined(given, matches, asked.work, seed, progress, options)
    found = _placed(asked, parts, matches)
    # A rig that stood still sees the world at one bearing, also at an instant that something moving has taken along.
    if not told and rig_that_stood_still(found.poses, options.carried.rig_still) is None:
        found, told = _not_carried(asked, found, matches)
        told = told or about_one_place(given, matches, seed, options)
    return replace(found, notes=(*found.notes, *told))


@dataclass(frozen=True)
class _Asked:
    """The photos that poses are looked for, and how."""

    photos: Sequence[str]
    names: Sequence[str]
    """The camera of each."""
    frame_names: Sequence[str] | None
    """The instant of each, where a rig took them."""
    calibration: Calibration
    given: MapperInput
    refine_rig: bool
    work: Path
    seed: int
    progress: ProgressCallback
    options: PosingOptions


def _placed(asked: _Asked, parts: list[dict[int, Pose]], matches: Matches) -> PhotoPoses:
    """The poses that grow from what COLMAP joined. Raises GeometryError where they leave no points, with the reason."""
    try:
        with one_torch_thread():
            return _grown(asked, parts, matches)
    except GeometryError as none:
        # COLMAP joins photos of one place too, at times; they have no points then.
        raise GeometryError(from_one_place(asked.given, matches, asked.seed, asked.options) or str(none)) from none


def _grown(asked: _Asked, parts: list[dict[int, Pose]], matches: Matches) -> PhotoPoses:
    names, features, options = asked.names, asked.given.features, asked.options
    again = partial(grow, features=features, matches=matches, seed=asked.seed, progress=asked.progress, options=options)
    rig = Pose.identity(len(names)) if asked.frame_names is None else cam_from_rig_of(asked.calibration, names)
    grown = again(start_from(Frames(torch.tensor(asked.given.frame), rig), parts[0]))
    found = _result(asked.photos, names, asked.frame_names, features, grown, parts, options.growth)
    if not grown.frames.has_scale:
        return _with_doubts(asked, grown, found, ())
    alone, better = photos_alone(grown, names), None
    if asked.refine_rig:
        wide = partial(
            matched_again, features=features, matches=matches, limit=options.growth.tolerances_sigmas[0],
            stage="finding the rig anew", progress=asked.progress, options=options,
        )  # fmt: skip
        better = with_rig_of_points(grown, alone, names, wide, again, options.growth)
    if better is None:
        return _with_doubts(asked, grown, found, rig_doubts(grown, alone, refined=asked.refine_rig, options=options.growth))
    found = _result(asked.photos, names, asked.frame_names, features, better.grown, parts, options.growth)
    given = {name: mounted.cam_from_rig for name, mounted in asked.calibration.rig.items()}
    own = {name: better.grown.frames.cam_from_rig[k] for k, name in enumerate(names)}
    return replace(found, notes=(better.note, *found.notes), rig={**given, **own})


def _with_doubts(asked: _Asked, grown: Grown, found: PhotoPoses, of_rig: tuple[str, ...]) -> PhotoPoses:
    """What photos contradict: the rig, each other, or else their cameras, which would make up for both."""
    known, growth = PosesAndPoints(grown.rig_from_world, grown.points), asked.options.growth
    doubts = of_rig or change_doubts(grown, asked.calibration, asked.names, growth)
    if doubts:
        return replace(found, notes=(*found.notes, *doubts))
    cameras = cameras_by_points(grown.seen, grown.frames, known, asked.calibration, asked.names, asked.options.resection)
    return replace(found, cameras=cameras)


def _not_carried(asked: _Asked, found: PhotoPoses, matches: Matches) -> tuple[PhotoPoses, tuple[str, ...]]:
    """The poses by what does not go along with the camera, where something does and more of the rest agrees with these, and what
    is to be said of it."""
    features, camera, options = asked.given.features, asked.given.camera, asked.options
    poses = {asked.photos.index(name): found.poses.cam_from_world[k] for k, name in enumerate(found.poses.images)}
    share = carried_share(features, matches.clear, camera, poses, options)
    if share < options.carried.least_share:
        return found, ()
    # Poses with which only that agrees are wrong, though it be most of what photos have in common.
    without = others(asked.given, matches, options)
    parts = mapped(asked.given, without.clear, asked.work, asked.seed, asked.progress, options)
    its = agreeing(features, without.clear, parts[0], options) if parts else 0
    if its > agreeing(features, without.clear, poses, options):
        return _placed(asked, parts, without), (GOES_ALONG.format(share, WITHOUT_IT),)
    # The poses stand: what they explain of that is the world.
    share = carried_share(features, matches.clear, camera, poses, options, contradicting=True)
    return found, (GOES_ALONG.format(share, ""),) if share >= options.carried.least_share else ()


def _features(
    photos: Sequence[str],
    read: Callable[[str], np.ndarray],
    mask_of: Callable[[str], Bool[np.ndarray, "h w"] | None],
    calibration: Calibration,
    names: Sequence[str],
    progress: ProgressCallback,
    options: FeatureOptions,
) -> list[Features]:
    pycolmap()  # loaded by the main thread, which alone can keep hold of signals

    def look(k: int) -> Features:
        name = photos[k]
        return feature_finder(options)(read(name), calibration[names[k]], calibration.estimates.get(names[k]), mask_of(name))

    return on_all_cores(look, range(len(photos)), "finding features", progress)


def _matches(features: Sequence[Features], seed: int, progress: ProgressCallback, options: PosingOptions) -> Matches:
    pairs = pairs_to_compare(features, seed, options.matches)

    def compare(pair: tuple[int, int]) -> tuple[Int[Tensor, "k 2"], Int[Tensor, "l 2"]]:
        return matched(features[pair[0]], features[pair[1]], options.matches)

    # Tables of all descriptors by all: as many at once as memory takes gladly.
    found = on_all_cores(compare, pairs, "comparing photos", progress, MAX_TABLES)
    of_pair = list(zip(pairs, found, strict=True))
    return Matches({pair: clear for pair, (clear, _) in of_pair}, {pair: faint for pair, (_, faint) in of_pair})


def _result(
    photos: Sequence[str],
    names: Sequence[str],
    frame_names: Sequence[str] | None,
    features: Sequence[Features],
    grown: Grown,
    parts: Sequence[Mapping[int, Pose]],
    options: GrowthOptions,
) -> PhotoPoses:
    """The table of poses, in the frame of the first photo, and the reasons of those left out."""
    seen = torch.bincount(grown.seen.photo, minlength=len(photos)).numpy()
    in_frame = np.bincount(grown.frames.of_photo.numpy(), weights=seen, minlength=len(grown.known))
    enough = grown.known & (in_frame >= options.min_seen)
    kept = np.flatnonzero(enough[grown.frames.of_photo.numpy()]).tolist()
    lost = {}
    for k in sorted(set(range(len(photos))) - set(kept)):
        elsewhere = next((len(part) for part in parts[1:] if k in part), 0)
        if elsewhere:
            why = f"it belongs to {elsewhere} photos that could not be joined to the others"
        elif len(features[k]) < options.few_features:
            why = f"only {len(features[k])} features were found in it"
        else:
            why = f"too few of its {len(features[k])} features match those of the other photos"
        lost[photos[k]] = f"{photos[k]} has no pose: {why}."
    if not kept:
        raise GeometryError("Photos that see the same points were expected, found none; give photos that overlap more.")
    table = ImagePoses(
        tuple(photos[k] for k in kept),
        grown.cam_from_world[kept],
        tuple(names[k] for k in kept),
        _covariance(grown, kept),
        None if frame_names is None else tuple(frame_names[k] for k in kept),
    )
    first = grown.rig_from_world[grown.frames.of_photo[kept[0]]]
    note = (
        f"Structure from motion: {len(grown.points)} points, seen {len(grown.seen)} times; they scatter {grown.scale:.2f} times "
        "as much as was assumed."
    )
    if grown.frames.has_scale:
        return PhotoPoses(moved_poses(table, 1.0, first), lost, ("Lengths are metres, by the rig.", note))
    centre = table.cam_from_world.centre
    spread = float((centre - centre.mean(0)).square().sum(-1).mean().sqrt())
    return PhotoPoses(
        moved_poses(table, 1.0 / spread, Pose(first.rotation, first.translation / spread)), lost, (OPEN_SCALE, note)
    )


def doubt(lost: int, photos: int, options: GrowthOptions = GrowthOptions()) -> tuple[str, ...]:
    """What is to be said of the poses of structure from motion where many photos have none."""
    if lost < options.doubtful_share * photos:
        return ()
    return (
        f"{lost} of {photos} photos have no pose: they share little with the others, and the poses found are doubtful too, far "
        "more than their covariance says; take photos that overlap by more than half, or give poses.",
    )


def _covariance(grown: Grown, kept: Sequence[int]) -> Float[np.ndarray, "n 6 6"] | None:
    """Of the photos, from that of their frames."""
    if grown.covariance is None:
        return None
    turn = adjoint(grown.frames.cam_from_rig[kept]).numpy()
    whole: Float[np.ndarray, "n 6 6"] = turn @ grown.covariance[grown.frames.of_photo[kept].numpy()] @ turn.transpose(0, 2, 1)
    return whole
