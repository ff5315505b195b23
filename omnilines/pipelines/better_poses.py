"""Poses brought nearer the truth by lines: rough ones before lines are matched, and all of them by the lines that were found.

Rotations follow from the directions that the photos' lines share, whatever the places are (`shared_directions`). Where lines
still do not stand out, places come from the photos themselves: structure from motion, brought into the world of the given poses
by all photos together, so that their errors average out. What makes lines stand out most is taken; where the given poses do, they
stay. Later, with lines known, every photo is compared with those that the others show.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from camera_models import Calibration, GeometryError
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.matching.match import Matched
from omnilines.matching.placing import explained_share, lines_of_others, lines_of_tracks, mended_pose, placed_anywhere
from omnilines.matching.shared_directions import turned_poses
from omnilines.matching.slack import Evidence, evidence_of_poses, lines_need_poses
from omnilines.pipelines.judged_photos import refuse_reading
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, viewed_arcs
from omnilines.posing.from_rig import cam_from_rig_of
from omnilines.posing.instant_names import instants
from omnilines.posing.photo_poses import PhotoPoses, align_to, image_poses
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.records import ImagePoses


def better_poses(
    found: Sequence[FoundArcs],
    posed: PhotoPoses,
    cameras: Calibration,
    *,
    from_photos: Callable[[], PhotoPoses],
    options: SceneOptions,
    progress: ProgressCallback,
) -> PhotoPoses:
    """The given poses, or better ones of the same world with a note that says so; `from_photos` is structure from motion.

    Raises InputError where lines stand out only if the poses are read in another way.
    """
    progress("judging the poses", 0, 0)
    limits = options.rough_poses

    def evidence(poses: ImagePoses) -> Evidence:
        return evidence_of_poses(viewed_arcs(found, poses, cameras), options.seed, options.matching)

    def turned(poses: ImagePoses) -> ImagePoses:
        return replace(
            poses, cam_from_world=turned_poses(viewed_arcs(found, poses, cameras), options.matching)[0], covariance=None
        )

    given, notes = posed.poses, list(posed.notes)
    try:
        best, held = given, evidence(given)
    except GeometryError:
        # Too few photos or places: matching says so, with the counts that it has.
        return posed
    if not held.beyond_chance:
        refuse_reading(found, posed, cameras, options, progress)
    trial = turned(given)
    its = evidence(trial)
    if its.gain > limits.min_gain * held.gain:
        degrees = np.degrees(_angles_rad(given.cam_from_world, trial.cam_from_world))
        best, held = trial, its
        notes.append(
            "The given poses were turned by the directions that lines share, by "
            f"{rounded(np.median(degrees))} degrees (median), {rounded(degrees.max())} at most."
        )
    if held.beyond_chance and held.tolerance_px < limits.rough_px:
        arcs = viewed_arcs(found, best, cameras)
        if lines_need_poses(arcs, held.tolerance_px, limits.rough_turns * limits.rough_px, options.seed, options.matching):
            return replace(posed, poses=best, notes=tuple(notes))
    try:
        trial, joined = _in_the_world_of(best, from_photos().poses, limits.outlying)
    except GeometryError as error:
        notes.append(f"Lines hardly agree under the given poses, and the photos themselves give none: {error}")
        return replace(posed, poses=best, notes=tuple(notes))
    # Features tell places well, and directions tell rotations better where edges are as parallel as they should be.
    by_features, trial = max(((evidence(one), one) for one in (trial, turned(trial))), key=lambda pair: pair[0].gain)
    if by_features.gain > limits.min_gain * held.gain:
        best = trial
        notes.append(
            f"Lines hardly agree under the given poses: {joined} of {len(trial)} photos were placed by features, in the world of "
            "the given poses."
        )
    return replace(posed, poses=best, notes=tuple(notes))


def _angles_rad(one: Pose, other: Pose) -> np.ndarray:
    cosine = ((one.rotation @ other.rotation.mT).diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0) / 2.0
    return torch.arccos(cosine.clamp(-1.0, 1.0)).numpy()


def _in_the_world_of(given: ImagePoses, free: ImagePoses, outlying: float) -> tuple[ImagePoses, int]:
    """The given photos at the places of `free`, moved and scaled to fit the given ones; and how many `free` knows.

    Raises GeometryError where it knows too few of them.
    """
    moved, _, _ = align_to(free, given)
    place = {name: k for k, name in enumerate(moved.images)}
    known = [k for k, name in enumerate(given.images) if name in place]
    own = [place[given.images[k]] for k in known]
    off = (moved.cam_from_world.centre[own] - given.cam_from_world.centre[known]).norm(dim=-1)
    sound = [given.images[k] for k, good in zip(known, (off <= outlying * off.median()).tolist(), strict=True) if good]
    moved, _, _ = align_to(free, _chosen(given, sound))
    poses = [given.cam_from_world[k] for k in range(len(given))]
    for k, row in zip(known, own, strict=True):
        poses[k] = moved.cam_from_world[row]
    return replace(given, cam_from_world=Pose.stack(poses), covariance=None), len(known)


def _chosen(poses: ImagePoses, names: Sequence[str]) -> ImagePoses:
    rows = [poses.images.index(name) for name in names]
    return ImagePoses(tuple(names), poses.cam_from_world[rows], tuple(poses.cameras[k] for k in rows) if poses.cameras else ())


def poses_by_lines(
    found: Sequence[FoundArcs],
    poses: ImagePoses,
    matched: Matched,
    cameras: Calibration,
    options: SceneOptions,
    progress: ProgressCallback,
) -> ImagePoses | None:
    """The poses with those of photos that were mended or had none; None where no photo moved.

    Every photo is compared with the lines that the others show. Photos of a rig at one instant move as one.
    """
    arcs = matched.arcs.with_poses(poses.cam_from_world)
    known = lines_of_tracks(arcs, matched.tracks.track, len(matched.tracks))
    bodies = _posed_bodies(poses)

    def against_others(body: Int[np.ndarray, " m"]) -> float:
        return explained_share(arcs.of_photos(body), lines_of_others(known, arcs, matched.tracks, body), options.matching)

    typical = float(np.median(on_all_cores(against_others, bodies, "comparing photos with the lines of others", progress)))

    def mended(body: Int[np.ndarray, " m"]) -> Pose | None:
        better = mended_pose(
            arcs.of_photos(body), lines_of_others(known, arcs, matched.tracks, body), options.seed, typical, options.matching
        )
        return None if better is None else better.pose

    moved = on_all_cores(mended, bodies, "mending poses by lines", progress)

    def placed(body: Sequence[FoundArcs]) -> Pose | None:
        names, models = tuple(photo.photo.name for photo in body), tuple(photo.camera for photo in body)
        together = Pose.identity(1) if poses.frames is None else cam_from_rig_of(cameras, models)
        alone = viewed_arcs(body, ImagePoses(names, together, models), cameras)
        one = placed_anywhere(alone.widened(matched.tolerance_px), known, options.seed, options.matching)
        return None if one is None else one.pose

    lost = _lost_bodies(found, poses)
    fresh = on_all_cores(placed, lost, "placing photos by lines", progress)
    if all(pose is None for pose in (*moved, *fresh)):
        return None
    return _with_moved(poses, bodies, moved, lost, fresh, found)


def _posed_bodies(poses: ImagePoses) -> list[Int[np.ndarray, " m"]]:
    """Photos that move as one: those of each instant of a rig, else each alone."""
    if poses.frames is None:
        return [np.array([k]) for k in range(len(poses))]
    _, frame = np.unique(np.array(poses.frames), return_inverse=True)
    return [np.flatnonzero(frame == k) for k in range(int(frame.max()) + 1)]


def _lost_bodies(found: Sequence[FoundArcs], poses: ImagePoses) -> list[list[FoundArcs]]:
    """The photos with arcs that have no pose, those that move as one together."""
    lost = [arcs for arcs in found if len(arcs) and arcs.reason is None and arcs.photo.name not in poses.images]
    if poses.frames is None:
        return [[arcs] for arcs in lost]
    instant = _instants(found)
    return [
        [arcs for arcs in lost if instant[arcs.photo.name] == one]
        for one in dict.fromkeys(instant[arcs.photo.name] for arcs in lost)
    ]


def _instants(found: Sequence[FoundArcs]) -> dict[str, str]:
    return instants([arcs.photo.name for arcs in found], {arcs.photo.name: arcs.camera for arcs in found})


def _with_moved(
    poses: ImagePoses,
    bodies: Sequence[Int[np.ndarray, " m"]],
    moved: Sequence[Pose | None],
    lost: Sequence[Sequence[FoundArcs]],
    fresh: Sequence[Pose | None],
    found: Sequence[FoundArcs],
) -> ImagePoses:
    """The poses with those that moved, and those that were found after them."""
    whole = {name: poses.cam_from_world[k] for k, name in enumerate(poses.images)}
    for body, pose in zip(bodies, moved, strict=True):
        if pose is not None:
            whole |= {poses.images[k]: pose[at] for at, k in enumerate(body.tolist())}
    for photos, pose in zip(lost, fresh, strict=True):
        if pose is not None:
            whole |= {photo.photo.name: pose[at] for at, photo in enumerate(photos)}
    camera_of = {arcs.photo.name: arcs.camera for arcs in found}
    frames = None
    if poses.frames is not None:
        frame_of = {**_instants(found), **dict(zip(poses.images, poses.frames, strict=True))}
        frames = [frame_of[name] for name in whole]
    return image_poses(list(whole), list(whole.values()), [camera_of[name] for name in whole], frames)
