"""Poses of photos that nothing is known of, by structure from motion with the calibrated cameras held.

features as bearings (features.py) -> matches (feature_matches.py) -> COLMAP on ideal panoramas (colmap_mapper.py) -> guided
matches, resection of what COLMAP could not place, and a last adjustment of all poses with all bearings (growth.py).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import Calibration, CameraModel, GeometryError
from camera_models.formats.disk import own_folder
from camera_models.pose import Pose, adjoint
from omnilines.posing._pycolmap import pycolmap
from omnilines.posing.carried_along import agreeing, carried_share, without_carried
from omnilines.posing.colmap_mapper import MapperInput, map_photos
from omnilines.posing.feature_matches import matched, pairs_to_compare
from omnilines.posing.features import Features, feature_finder
from omnilines.posing.from_rig import cam_from_rig_of
from omnilines.posing.growth import Grown, Matches, PairMatches, grow, start_from
from omnilines.posing.one_place import at_one_place
from omnilines.posing.options import FeatureOptions, GrowthOptions, PosingOptions
from omnilines.posing.photo_poses import PhotoPoses, moved_poses
from omnilines.posing.point_adjustment import Frames
from omnilines.posing.rig_from_points import rig_doubts
from omnilines.posing.still_rig import rig_that_stood_still
from omnilines.progress import ProgressCallback, on_all_cores, one_torch_thread, silent
from omnilines.records import ImagePoses

OPEN_SCALE = "The scale is not known: the unit of length is about the cameras' root mean square distance from their middle."
"""The note of poses whose unit nothing tells."""
TO_MASK = "leave out a vehicle, a mount, a hand or a date that photos always show, with `mask`."
LEFT_OUT = (
    "Photos could be joined only without what lies at one place in all of them, which goes along with the camera, or far away: "
    f"{TO_MASK}"
)
GOES_ALONG = (
    "{:.0%} of what photos have in common lies at the same place in them although the camera turned: it goes along with it{}; "
    f"{TO_MASK}"
)
WITHOUT_IT = ", and poses are found without it"
ONE_PLACE = (
    "A turn of the camera alone explains most of what {} of {} photos have in common: from about one place hardly anything has a "
    "depth, so that poses and lines are doubtful, far more than they state; move the camera between photos."
)
LEAST_PHOTOS = 3
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
) -> PhotoPoses:
    """`cam_from_world` of photos from what they have in common, with covariances (left perturbation, rad and world units).

    `read` gives the photo of a name, (h, w) or (h, w, 3) of 8 or 16 bits; it is called from several threads, once for each photo,
    and so is `mask_of`, which gives where the photo is looked at, None for everywhere.
    `cameras` may be a `Calibration`: features beyond the angles that its estimates are supported by are then left out, and where
    it holds a rig and `frame_of` names the instants, the cameras of a frame move as one and lengths are metres. Otherwise the
    scale is open: the root mean square distance of the cameras from their middle is then 1. The world is the frame of the first
    photo that has a pose (of a rig: its rig frame). COLMAP works in `work_folder`/colmap.

    Raises InputError where a photo has not the size of its camera, and GeometryError where no three
    photos (frames) could be joined.
    """
    calibration = cameras if isinstance(cameras, Calibration) else Calibration(dict(cameras))
    rigid = bool(calibration.rig) and frame_of is not None
    frame_names = [frame_of[photo] if rigid and frame_of is not None else photo for photo in photos]
    order = {name: number for number, name in enumerate(dict.fromkeys(frame_names))}
    frame = [order[name] for name in frame_names]
    names = [camera_of[photo] for photo in photos]
    rig = cam_from_rig_of(calibration, names) if rigid else Pose.identity(len(photos))
    features = _features(photos, read, mask_of, calibration, names, progress, options.features)
    matches = _matches(features, seed, progress, options)
    numbers = list(calibration)
    in_rig = {numbers.index(name): calibration.rig[name].cam_from_rig for name in numbers} if rigid else {}
    given = MapperInput(features, matches.clear, [numbers.index(name) for name in names], frame, in_rig)
    work = Path(work_folder)

    def placed(parts: list[dict[int, Pose]], matches: Matches) -> PhotoPoses:
        with one_torch_thread():
            start = start_from(Frames(torch.tensor(frame), rig), parts[0])
            grown = grow(start, features, matches, seed=seed, progress=progress, options=options)
        return _result(photos, names, frame_names if rigid else None, features, grown, parts, options.growth)

    parts, matches, told = _joined(given, matches, work, seed, progress, options)
    found = placed(parts, matches)
    # A rig that stood still sees the world at one bearing, also at an instant that something moving has taken along.
    if not told and rig_that_stood_still(found.poses, options.carried.rig_still) is None:
        poses = {photos.index(name): found.poses.cam_from_world[k] for k, name in enumerate(found.poses.images)}
        share = carried_share(features, matches.clear, given.camera, poses, options)
        if share >= options.carried.least_share:
            # Poses with which only that agrees are wrong, though it be most of what photos have in common.
            without = _others(given, matches, options)
            parts = _mapped(given, without.clear, work, seed, progress, options)
            its = agreeing(features, without.clear, parts[0], options) if parts else 0
            better = its > agreeing(features, without.clear, poses, options)
            found = placed(parts, without) if better else found
            if not better:  # The poses stand: what they explain of that is the world.
                share = carried_share(features, matches.clear, given.camera, poses, options, contradicting=True)
            if share >= options.carried.least_share:
                told = (GOES_ALONG.format(share, WITHOUT_IT if better else ""),)
        if not told:
            told = _from_one_place(at_one_place(features, matches.clear, seed, options), frame)
    return replace(found, notes=(*found.notes, *told))


def _from_one_place(here: Sequence[int], frame: Sequence[int]) -> tuple[str, ...]:
    """What is to be said where photos at one place and every other instant are too few places; `frame` is that of each photo."""
    places = len(set(frame) - {frame[k] for k in here}) + 1
    return (ONE_PLACE.format(len(here), len(frame)),) if here and places < LEAST_PHOTOS else ()


def _joined(
    given: MapperInput, matches: Matches, work: Path, seed: int, progress: ProgressCallback, options: PosingOptions
) -> tuple[list[dict[int, Pose]], Matches, tuple[str, ...]]:
    """The parts that COLMAP joins, by all matches or, where there is none, by those that do not go along with the camera; these
    matches, and what is to be said of them. Raises GeometryError where there is none either way."""

    parts = _mapped(given, matches.clear, work, seed, progress, options)
    if parts:
        return parts, matches, ()
    without = _others(given, matches, options)
    fewer = _number(without.clear) < _number(matches.clear)
    parts = _mapped(given, without.clear, work, seed, progress, options) if fewer else []
    if not parts:
        raise GeometryError(_not_joined(given.features, matches, without, seed, options))
    return parts, without, (LEFT_OUT,)


def _mapped(
    given: MapperInput, clear: PairMatches, work: Path, seed: int, progress: ProgressCallback, options: PosingOptions
) -> list[dict[int, Pose]]:
    """The parts that COLMAP joins by these matches."""
    work.mkdir(parents=True, exist_ok=True)
    with own_folder(work, "colmap.") as folder:
        return map_photos(replace(given, matches=clear), folder / "mapper", seed, progress, options)


def _others(given: MapperInput, matches: Matches, options: PosingOptions) -> Matches:
    """The matches that do not go along with the camera."""
    return Matches(*(without_carried(given.features, one, given.camera, options) for one in (matches.clear, matches.faint)))


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


def _not_joined(features: Sequence[Features], matches: Matches, without: Matches, seed: int, options: PosingOptions) -> str:
    """Why no photos could be joined, and what to do: nothing has a depth from one place, however much photos overlap. `without`
    are the matches that are not at one bearing in both."""
    count = len(features)
    if count < LEAST_PHOTOS:
        return f"{LEAST_PHOTOS} photos of one scene or more were expected to find their poses, found {count}; give more."
    here = len(at_one_place(features, matches.clear, seed, options))
    if 2 * here > count and 2 * _number(without.clear) < _number(matches.clear):
        return (
            f"Photos from different places were expected to find their poses, found that most of what {here} of {count} photos "
            "have in common lies at the same place in each: the camera stood still, or it sees what goes along with it; move the "
            f"camera between photos, and {TO_MASK}"
        )
    if 2 * here > count:
        return (
            f"Photos from different places were expected to find their poses, found {here} of {count} at one place, from where "
            "nothing has a depth: a turn of the camera alone explains what they have in common; move the camera between photos."
        )
    return (
        f"Photos with enough in common to find their poses were expected, found {count} that COLMAP could not join; "
        "take more photos with smaller steps between them, or give poses."
    )


def _number(matches: PairMatches) -> int:
    return sum(map(len, matches.values()))


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
        doubts = rig_doubts(grown, names, options)
        return PhotoPoses(moved_poses(table, 1.0, first), lost, ("Lengths are metres, by the rig.", note, *doubts))
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
