"""Whether photos put the cameras of a rig where its calibration has them, and where else, by points that several of them see."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from camera_models import GeometryError
from camera_models.pose import Pose
from camera_models.wording import listed, rounded
from omnilines.posing.growth import Grown
from omnilines.posing.options import GrowthOptions
from omnilines.posing.point_adjustment import Frames, PosesAndPoints, adjust_points
from omnilines.posing.rig_offsets import RigOffsets, photos_beside, rig_offsets, second_from_first


@dataclass(frozen=True)
class PhotosAlone:
    """What points tell with each photo free to move by itself."""

    converged: bool
    scale: float
    """As that of `Grown`."""
    cam_from_world: Pose
    """Of every photo, in metres as far as the rig tells them."""
    rig: RigOffsets


@dataclass(frozen=True)
class BetterRig:
    """Photos placed with the rig that points tell."""

    grown: Grown
    note: str
    """What is to be said of it."""


def photos_alone(grown: Grown, cameras: Sequence[str]) -> PhotosAlone:
    """Points adjusted once more with photos that no rig holds together; `cameras` are those of the photos."""
    photos = len(cameras)
    each = Frames(torch.arange(photos), Pose.identity(photos))
    free = adjust_points(grown.seen, each, PosesAndPoints(grown.cam_from_world, grown.points))
    first, pairs = _beside(grown, cameras)
    poses, given = free.state.rig_from_world, grown.frames.cam_from_rig
    scale = _scale(given, poses, [pair for own in pairs.values() for pair in own])
    poses = Pose(poses.rotation, scale * poses.translation)
    return PhotosAlone(free.converged, free.scale, poses, rig_offsets(poses, given, cameras, first, pairs))


def rig_doubts(
    grown: Grown, alone: PhotosAlone, *, refined: bool = False, options: GrowthOptions = GrowthOptions()
) -> tuple[str, ...]:
    """What is to be said of the rig where points scatter far less once each photo moves by itself; `refined` if lines refine it.
    Matches were chosen with the rig as given, so that it may be farther off than is said."""
    if not alone.converged or not _doubted(grown, alone, options):
        return ()
    scatter = (
        "The photos do not agree with the rig of the calibration: with its cameras where it has them points scatter "
        f"{grown.scale:.2f} times as much as was assumed, with each photo free {alone.scale:.2f} times."
    )
    remedy = (
        f"{'Calibrate the rig anew' if refined else 'Refine the rig (`refine` lines,poses,rig), calibrate it anew'}, or give a "
        "calibration of its cameras without their places (lengths are then open); where the photos of one instant were taken one "
        "after another, the rig did not stand still between them."
    )
    told = alone.rig.places()
    return (" ".join((scatter, *((f"They put {listed(told)} from there.",) if told else ()), remedy)),)


def with_rig_of_points(
    grown: Grown,
    alone: PhotosAlone,
    cameras: Sequence[str],
    matched_again: Callable[[Grown], Grown],
    grown_again: Callable[[Grown], Grown],
    options: GrowthOptions = GrowthOptions(),
) -> BetterRig | None:
    """Photos grown again with the rig that points tell where that of the calibration is doubted, from `grown` and what it says
    `alone`; None where it is not, where it remains as doubtful as it was, and where points do not tell the place of each camera.

    Matches are chosen with a rig and hold it near where it was, so it is found and they are chosen in turn (`matched_again`),
    until points no longer doubt it.
    """
    given, found, beside = grown.frames.cam_from_rig, grown, alone
    try:
        for _ in range(options.rig_rounds):
            if not _doubted(found, beside, options) or not beside.rig.tell_all:
                break
            found = matched_again(_moved(found, beside, cameras))
            beside = photos_alone(found, cameras)
        if found is grown:
            return None
        found = grown_again(found)
    except GeometryError:
        # With a rig that is no better no points are left.
        return None
    beside = photos_alone(found, cameras)
    if not found.scale / beside.scale < grown.scale / alone.scale:
        return None
    their = rig_offsets(beside.cam_from_world, given, cameras, *_beside(found, cameras))
    told = listed(their.places())
    return BetterRig(
        found,
        f"The rig is as photos tell, which did not agree with that of the calibration: they put {told} from there, and points "
        f"scatter {found.scale:.2f} times as much as was assumed; with the rig of the calibration {grown.scale:.2f} times."
        + _of_scale(given, found.frames.cam_from_rig, cameras),
    )


def _of_scale(given: Pose, found: Pose, cameras: Sequence[str]) -> str:
    """How well the rig of the calibration tells lengths, by how far the distances of its cameras are off each other."""
    rows = [cameras.index(name) for name in dict.fromkeys(cameras)]
    first, second = torch.combinations(torch.tensor(rows)).T
    stated, seen = ((rig.centre[first] - rig.centre[second]).norm(dim=-1) for rig in (given, found))
    apart = stated > 0
    if int(apart.sum()) < 2:
        return " Lengths rest on the distance of its cameras in the calibration."
    off = float((seen[apart] / stated[apart] - 1.0).square().mean().sqrt())
    return (
        " Lengths rest on the distances of its cameras in the calibration, which differ from those found by "
        f"{rounded(100.0 * off)} percent (RMS): lengths are uncertain by about as much."
    )


def _beside(grown: Grown, cameras: Sequence[str]) -> tuple[str, dict[str, list[tuple[int, int]]]]:
    """Of the photos that see points."""
    seen = torch.bincount(grown.seen.photo, minlength=len(cameras)) > 0
    return photos_beside(cameras, grown.frames.of_photo.tolist(), seen.tolist())


def _doubted(grown: Grown, alone: PhotosAlone, options: GrowthOptions) -> bool:
    return grown.scale > options.rig_doubt * alone.scale


def _moved(grown: Grown, alone: PhotosAlone, cameras: Sequence[str]) -> Grown:
    """With the cameras of the rig where they are in the median of the instants, and the instants where their photos are."""
    cam_from_rig, frame = alone.rig.told, grown.frames.of_photo
    poses = [grown.rig_from_world[k] for k in range(len(grown.known))]
    # The first camera's last: an instant is where its photo is.
    for photo in sorted(torch.unique(grown.seen.photo).tolist(), key=lambda photo: cameras[photo] == alone.rig.first):
        poses[int(frame[photo])] = cam_from_rig[cameras[photo]].inverse() @ alone.cam_from_world[photo]
    frames = Frames(frame, Pose.stack([cam_from_rig[name] for name in cameras]))
    return replace(grown, frames=frames, rig_from_world=Pose.stack(poses))


def _scale(given: Pose, found: Pose, pairs: Sequence[tuple[int, int]]) -> float:
    """Metres of the unit of poses that move by themselves: the median of what the distances of cameras tell; 1 without any."""
    if not pairs:
        return 1.0
    stated, seen = (second_from_first(poses, pairs).translation.norm(dim=-1) for poses in (given, found))
    apart = (stated > 0) & (seen > 0)
    return float((stated[apart] / seen[apart]).median()) if bool(apart.any()) else 1.0
