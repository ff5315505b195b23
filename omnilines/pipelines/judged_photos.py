"""Poses under which the arcs of photos agree by chance only: refused, where the same numbers read in another way explain them."""

from collections.abc import Sequence
from dataclasses import replace

from camera_models import Calibration, GeometryError, InputError
from omnilines.matching.match import evidence_of_poses
from omnilines.pipelines.arcs import FoundArcs, viewed_arcs
from omnilines.pipelines.options import SceneOptions
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.posing.readings import other_readings
from omnilines.progress import ProgressCallback

READ = ("table", "colmap")
"""Sources of poses whose numbers may be of another convention."""


def refuse_reading(
    found: Sequence[FoundArcs], posed: PhotoPoses, cameras: Calibration, options: SceneOptions, progress: ProgressCallback
) -> None:
    """Raises InputError where lines stand out under another reading of the poses; to be asked where they do not as given."""
    if posed.source not in READ or posed.poses.frames is not None:
        return
    readings = list(other_readings(posed.poses.cam_from_world))
    for done, reading in enumerate(readings):
        progress("reading the poses in other ways", done, len(readings))
        poses = replace(posed.poses, cam_from_world=reading.poses, covariance=None)
        try:
            its = evidence_of_poses(viewed_arcs(found, poses, cameras), options.seed, options.matching)
        except GeometryError:
            return
        if its.beyond_chance:
            raise InputError(
                f"The poses look {reading.looks}: as given the lines of the photos agree by chance only, read so they stand out. "
                f"X_cam = R X_world + t and qw,qx,qy,qz were expected; {reading.remedy}."
            )
