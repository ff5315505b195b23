"""Whether photos put the cameras of a rig where its calibration has them, by points that several of them see."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose
from camera_models.wording import listed, rounded
from omnilines.posing.growth import Grown
from omnilines.posing.options import GrowthOptions
from omnilines.posing.point_adjustment import Frames, PosesAndPoints, adjust_points

LEAST_INSTANTS = 3
"""From which a camera's place in the rig is told, and how well."""


def rig_doubts(grown: Grown, cameras: Sequence[str], options: GrowthOptions = GrowthOptions()) -> tuple[str, ...]:
    """What is to be said of the rig where points scatter far less once each photo moves by itself; `cameras` are those of the
    photos. Matches were chosen with the rig as given, so that it may be farther off than is said."""
    photos = len(cameras)
    alone = Frames(torch.arange(photos), Pose.identity(photos))
    free = adjust_points(grown.seen, alone, PosesAndPoints(grown.cam_from_world, grown.points))
    if not free.converged or grown.scale <= options.rig_doubt * free.scale:
        return ()
    scatter = (
        "The photos do not agree with the rig of the calibration: with its cameras where it has them points scatter "
        f"{grown.scale:.2f} times as much as was assumed, with each photo free {free.scale:.2f} times."
    )
    remedy = (
        "Calibrate the rig anew, or give a calibration of its cameras without their places (lengths are then open); where the "
        "photos of one instant were taken one after another, the rig did not stand still between them."
    )
    told = _places(grown, free.state.rig_from_world, cameras)
    return (" ".join((scatter, *((f"They put {listed(told)} from there.",) if told else ()), remedy)),)


def _places(grown: Grown, cam_from_world: Pose, cameras: Sequence[str]) -> list[str]:
    """How far photos put each camera from its place beside that which most photos are of, in the median of the instants, and how
    uncertain that is by their spread."""
    seen = torch.bincount(grown.seen.photo, minlength=len(cameras)) > 0
    at = {(cameras[k], int(grown.frames.of_photo[k])): k for k in range(len(cameras)) if seen[k]}
    count = {name: sum(camera == name for camera, _ in at) for name in dict.fromkeys(cameras)}
    first = max(count, key=lambda name: count[name])
    pairs = {
        name: [(at[name, frame], own) for (camera, frame), own in at.items() if camera == first and (name, frame) in at]
        for name in count
        if name != first
    }
    scale, told = _scale(grown.frames.cam_from_rig, cam_from_world, [pair for own in pairs.values() for pair in own]), []
    for name, own in pairs.items():
        if len(own) < LEAST_INSTANTS:
            continue
        given, found = (_beside(poses, own) for poses in (grown.frames.cam_from_rig, cam_from_world))
        off = (Pose(found.rotation, scale * found.translation) @ given.inverse()).log()
        turn, shift = (_with_sigma(part) for part in (off[:, :3].rad2deg(), 1e3 * off[:, 3:]))
        told.append(f"{name} {turn} degrees and {shift} mm")
    return told


def _beside(poses: Pose, pairs: Sequence[tuple[int, int]]) -> Pose:
    """The first camera of each pair in the frame of the second."""
    first, second = (list(rows) for rows in zip(*pairs, strict=True))
    return poses[first] @ poses[second].inverse()


def _scale(given: Pose, found: Pose, pairs: Sequence[tuple[int, int]]) -> float:
    """Metres of the unit of poses that move by themselves: the median of what the distances of cameras tell; 1 without any."""
    if not pairs:
        return 1.0
    stated, seen = (_beside(poses, pairs).translation.norm(dim=-1) for poses in (given, found))
    apart = (stated > 0) & (seen > 0)
    return float((stated[apart] / seen[apart]).median()) if bool(apart.any()) else 1.0


def _with_sigma(off: Float[Tensor, "n 3"]) -> str:
    """Length of the median of some vectors, and its standard deviation."""
    sigma = float(off.std(0).norm()) / math.sqrt(len(off))
    return f"{rounded(float(off.median(0).values.norm()))} (± {rounded(sigma, 1)})"
