"""Poses under which the arcs of photos agree by chance only: refused, where the same numbers read in another way explain them."""

from collections.abc import Sequence
from dataclasses import replace

from camera_models import Calibration, GeometryError, InputError
from camera_models.pose import Pose
from omnilines.matching.slack import Evidence, evidence_of_poses
from omnilines.pipelines.options import SceneOptions
from omnilines.pipelines.photo_arcs import FoundArcs, viewed_arcs
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.readings import other_readings
from omnilines.progress import ProgressCallback

READ = ("table", "colmap")
"""Sources of poses whose numbers may be of another convention."""


def refuse_reading(
    found: Sequence[FoundArcs], posed: PhotoPoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> None:
    """Raises InputError where lines stand out by chance only under the poses as given, and clearly under another reading of them.

    Few photos with few arcs may agree under poses that are none of theirs: the reading has to stand out from all others.
    """
    if posed.source not in READ or posed.poses.frames is not None:
        return

    def evidence(cam_from_world: Pose, seed: int = options.seed) -> Evidence:
        poses = replace(posed.poses, cam_from_world=cam_from_world, covariance=None)
        return evidence_of_poses(viewed_arcs(found, poses, cameras), seed, options.matching)

    readings = list(other_readings(posed.poses.cam_from_world))
    sigmas = []
    try:
        as_given = evidence(posed.poses.cam_from_world)
        if as_given.beyond_chance:
            return
        for done, reading in enumerate(readings):
            progress("reading the poses in other ways", done, len(readings))
            sigmas.append(evidence(reading.poses).sigmas)
    except GeometryError:
        return
    best = max(range(len(readings)), key=lambda k: sigmas[k])
    rival = max([as_given.sigmas, *(other for k, other in enumerate(sigmas) if k != best)])
    least = max(options.matching.tolerance.chance_sigmas, options.judge.stands_out * rival)
    # Other arcs, and another chance, have to say the same.
    if sigmas[best] > least and evidence(readings[best].poses, options.seed + 1).sigmas > least:
        raise InputError(
            f"The poses look {readings[best].looks}: as given the lines of the photos agree by chance only, read so they stand "
            f"out. X_cam = R X_world + t and qw,qx,qy,qz were expected; {readings[best].remedy}."
        )
