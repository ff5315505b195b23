"""Poses of photos that the lines of a scene mend, and photos without a pose that they place."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from camera_models import Calibration
from camera_models.pose import Pose
from omnilines.matching.match import Matched
from omnilines.matching.placing import explained_share, lines_of_others, lines_of_tracks, mended_pose, placed_anywhere
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.pipelines.photo_poses import instants
from omnilines.pipelines.viewed_arcs import viewed_arcs
from omnilines.posing.from_rig import cam_from_rig_of
from omnilines.posing.photo_poses import image_poses
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.records import ImagePoses


def poses_by_lines(
    found: Sequence[FoundArcs], poses: ImagePoses, matched: Matched, cameras: Calibration, seed: int, progress: ProgressCallback
) -> ImagePoses | None:
    """The poses with those of photos that were mended or had none; None where no photo moved.

    Every photo is compared with the lines that the others show. Photos of a rig at one instant move as one.
    """
    arcs = matched.arcs.with_poses(poses.cam_from_world)
    known = lines_of_tracks(arcs, matched.tracks.track, len(matched.tracks))
    bodies = _posed_bodies(poses)

    def against_others(body: Int[np.ndarray, " m"]) -> float:
        return explained_share(arcs.of_photos(body), lines_of_others(known, arcs, matched.tracks, body))

    typical = float(np.median(on_all_cores(against_others, bodies, "comparing photos with the lines of others", progress)))

    def mended(body: Int[np.ndarray, " m"]) -> Pose | None:
        better = mended_pose(arcs.of_photos(body), lines_of_others(known, arcs, matched.tracks, body), seed, typical)
        return None if better is None else better.pose

    moved = on_all_cores(mended, bodies, "mending poses by lines", progress)

    def placed(body: Sequence[FoundArcs]) -> Pose | None:
        names, models = tuple(photo.photo.name for photo in body), tuple(photo.camera for photo in body)
        together = Pose.identity(1) if poses.frames is None else cam_from_rig_of(cameras, models)
        alone = viewed_arcs(body, ImagePoses(names, together, models), cameras)
        one = placed_anywhere(alone.widened(matched.slack_px), known, seed)
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
    instant = instants([arcs.photo.name for arcs in lost])
    return [[arcs for arcs in lost if instant[arcs.photo.name] == one] for one in dict.fromkeys(instant.values())]


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
        frame_of = {**instants(list(whole)), **dict(zip(poses.images, poses.frames, strict=True))}
        frames = [frame_of[name] for name in whole]
    return image_poses(list(whole), list(whole.values()), [camera_of[name] for name in whole], frames)
