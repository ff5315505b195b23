"""Poses of photos that the lines of a scene mend, and photos without a pose that they place."""

from collections.abc import Sequence

import numpy as np

from camera_models import Calibration
from camera_models.pose import Pose
from omnilines.commands._common import ProgressCallback
from omnilines.commands._photo_arcs import FoundArcs
from omnilines.commands._viewed_arcs import viewed_arcs
from omnilines.commands.detect import on_all_cores
from omnilines.matching.match import Matched
from omnilines.matching.placing import explained_share, lines_of_others, lines_of_tracks, mended_pose, placed_anywhere
from omnilines.records import ImagePoses


def poses_by_lines(
    found: Sequence[FoundArcs], poses: ImagePoses, matched: Matched, cameras: Calibration, seed: int, progress: ProgressCallback
) -> ImagePoses | None:
    """The poses with those of photos that were mended or had none; None where no photo moved.

    Every photo is compared with the lines that the others show. Photos of a rig move as one and are left as they are.
    """
    if poses.frames is not None:
        return None
    arcs = matched.arcs.with_poses(poses.cam_from_world)
    known = lines_of_tracks(arcs, matched.tracks.track, len(matched.tracks))

    photos = range(len(poses))
    others = on_all_cores(
        lambda k: lines_of_others(known, arcs, matched.tracks, k), photos, "comparing photos with the lines of others", progress
    )
    typical = float(np.median([explained_share(arcs.of_photo(k), others[k]) for k in photos]))

    def mended(k: int) -> Pose | None:
        better = mended_pose(arcs.of_photo(k), others[k], seed, typical)
        return None if better is None else better.pose

    moved = on_all_cores(mended, photos, "mending poses by lines", progress)

    def placed(photo: FoundArcs) -> Pose | None:
        alone = ImagePoses((photo.photo.name,), Pose.identity(1), (photo.camera,))
        one = placed_anywhere(viewed_arcs([photo], alone, cameras).widened(matched.slack_px), known, seed)
        return None if one is None else one.pose

    lost = [arcs for arcs in found if len(arcs) and arcs.reason is None and arcs.photo.name not in poses.images]
    fresh = on_all_cores(placed, lost, "placing photos by lines", progress)
    if all(pose is None for pose in (*moved, *fresh)):
        return None
    whole = [poses.cam_from_world[k] if pose is None else pose[0] for k, pose in enumerate(moved)]
    added = [(photo, pose[0]) for photo, pose in zip(lost, fresh, strict=True) if pose is not None]
    camera_of = {arcs.photo.name: arcs.camera for arcs in found}
    images = (*poses.images, *(photo.photo.name for photo, _ in added))
    return ImagePoses(images, Pose.stack([*whole, *(pose for _, pose in added)]), tuple(camera_of[name] for name in images))
