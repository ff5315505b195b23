"""Poses that name the instants of a rig, and put its cameras elsewhere than the calibration."""

from camera_models import Calibration
from camera_models.pose import Pose
from camera_models.wording import listed
from omnilines.adjustment.rig import ROUNDED_M, ROUNDED_RAD, rig_of_photos
from omnilines.pipelines.options import SceneOptions
from omnilines.posing.from_rig import cam_from_rig_of, with_rig
from omnilines.posing.rig_offsets import photos_beside, rig_offsets
from omnilines.records import ImagePoses


def rig_by_poses(poses: ImagePoses, cameras: Calibration, options: SceneOptions) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration that lines begin with, and what is to be said where poses contradict its rig by more than they scatter.

    A rig that is refined begins where the median of the instants puts it. One that is not holds the photos of an instant together
    where poses are refined; held poses are as given, and the rig does not count.

    Raises InputError as `rig_of_photos` does.
    """
    mounted, _ = rig_of_photos(poses, list(cameras), cameras.rig, False, options.adjustment.most_turned_deg)
    if mounted is None or poses.cameras is None:
        return cameras, ()
    first, pairs = photos_beside(poses.cameras, mounted.frame.tolist(), [True] * len(poses))
    found = rig_offsets(poses.cam_from_world, cam_from_rig_of(cameras, poses.cameras), poses.cameras, first, pairs)
    if not found.contradict(options.posing.given, ROUNDED_RAD, ROUNDED_M):
        return cameras, ()
    said = f"Poses do not agree with the rig of the calibration: they put {listed(found.places())} from its place there"
    if "rig" in options.refine:
        if not found.tell_all:
            return cameras, (f"{said}. The rig is refined from the calibration: too few instants tell where each camera is.",)
        rig: dict[str, Pose] = {name: one.cam_from_rig for name, one in cameras.rig.items()}
        return with_rig(cameras, {**rig, **found.told}), (f"{said}. The rig is refined from where they put it.",)
    if "poses" in options.refine:
        return cameras, (
            f"{said}. Photos of an instant are held together as the calibration has them. Where poses are right, refine the rig "
            "as well (`refine` lines,poses,rig), or leave out the column frame.",
        )
    return cameras, (f"{said}. Every photo is held where its own pose has it, and the rig does not count.",)
