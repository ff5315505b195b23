"""Poses that a table gives roughly, brought so near the truth that lines stand out: first turned, then placed anew.

Rotations follow from the directions that the photos' lines share, whatever the places are (`shared_directions`). Where lines
still do not stand out, places come from the photos themselves: structure from motion, brought into the world of the given poses
by all photos together, so that their errors average out. What makes lines stand out most is taken; where the given poses do, they
stay.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from camera_models import Calibration, GeometryError
from camera_models.pose import Pose
from omnilines.matching.match import Evidence, evidence_of_poses
from omnilines.matching.shared_directions import turned_poses
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.pipelines.viewed_arcs import viewed_arcs
from omnilines.posing.photo_poses import PhotoPoses, align_to
from omnilines.progress import ProgressCallback
from omnilines.records import ImagePoses

CLEARLY_MORE = 1.1
"""Times as far that lines have to stand out under other poses for these to be taken."""
ROUGH_PX = 1.6
"""Slack from which on poses are rough: matching among near edges is then beyond telling apart."""
OUTLYING = 3.0
"""Times the median distance from the given places at which a photo has no say in where the others are."""


def better_poses(
    found: Sequence[FoundArcs],
    posed: PhotoPoses,
    cameras: Calibration,
    seed: int,
    from_photos: Callable[[], PhotoPoses],
    progress: ProgressCallback,
) -> PhotoPoses:
    """The given poses, or better ones of the same world with a note that says so; `from_photos` is structure from motion."""
    progress("judging the poses", 0, 0)

    def evidence(poses: ImagePoses) -> Evidence:
        return evidence_of_poses(viewed_arcs(found, poses, cameras), seed)

    def turned(poses: ImagePoses) -> ImagePoses:
        return replace(poses, cam_from_world=turned_poses(viewed_arcs(found, poses, cameras))[0], covariance=None)

    given, notes = posed.poses, list(posed.notes)
    try:
        best, held = given, evidence(given)
    except GeometryError:
        # Too few photos or places: matching says so, with the counts that it has.
        return posed
    trial = turned(given)
    its = evidence(trial)
    if its.gain > CLEARLY_MORE * held.gain:
        degrees = np.degrees(_angles_rad(given.cam_from_world, trial.cam_from_world))
        best, held = trial, its
        notes.append(
            "The given poses were turned by the directions that lines share, by "
            f"{np.median(degrees):.2g} degrees (median), {degrees.max():.2g} at most."
        )
    if held.beyond_chance and held.slack_px < ROUGH_PX:
        return replace(posed, poses=best, notes=tuple(notes))
    try:
        trial, joined = _in_the_world_of(best, from_photos().poses)
    except GeometryError as error:
        notes.append(f"Lines hardly agree under the given poses, and the photos themselves give none: {error}")
        return replace(posed, poses=best, notes=tuple(notes))
    # Features tell places well, and directions tell rotations better.
    trial = turned(trial)
    if evidence(trial).gain > CLEARLY_MORE * held.gain:
        best = trial
        notes.append(
            f"Lines hardly agree under the given poses: {joined} of {len(trial)} photos were placed by features, in the world of "
            "the given poses."
        )
    return replace(posed, poses=best, notes=tuple(notes))


def _angles_rad(one: Pose, other: Pose) -> np.ndarray:
    cosine = ((one.rotation @ other.rotation.mT).diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0) / 2.0
    return torch.arccos(cosine.clamp(-1.0, 1.0)).numpy()


def _in_the_world_of(given: ImagePoses, free: ImagePoses) -> tuple[ImagePoses, int]:
    """The given photos at the places of `free`, moved and scaled to fit the given ones; and how many `free` knows.

    Raises GeometryError where it knows too few of them.
    """
    moved, _, _ = align_to(free, given)
    place = {name: k for k, name in enumerate(moved.images)}
    known = [k for k, name in enumerate(given.images) if name in place]
    own = [place[given.images[k]] for k in known]
    off = (moved.cam_from_world.centre[own] - given.cam_from_world.centre[known]).norm(dim=-1)
    sound = [given.images[k] for k, good in zip(known, (off <= OUTLYING * off.median()).tolist(), strict=True) if good]
    moved, _, _ = align_to(free, _chosen(given, sound))
    poses = [given.cam_from_world[k] for k in range(len(given))]
    for k, row in zip(known, own, strict=True):
        poses[k] = moved.cam_from_world[row]
    return replace(given, cam_from_world=Pose.stack(poses), covariance=None), len(known)


def _chosen(poses: ImagePoses, names: Sequence[str]) -> ImagePoses:
    rows = [poses.images.index(name) for name in names]
    return ImagePoses(tuple(names), poses.cam_from_world[rows], tuple(poses.cameras[k] for k in rows) if poses.cameras else ())
