"""What a table of poses may hold in place of `cam_from_world`: its numbers read as other tools write them."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from camera_models.pose import Pose, rotation_from_quaternion

AXES = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
"""Of a camera that looks along -z with y up (OpenGL, Blender), in ours."""


@dataclass(frozen=True)
class Reading:
    """The same numbers, read in another way."""

    looks: str
    """What they seem to be, behind "the poses look"."""
    remedy: str
    """What to do, one imperative."""
    poses: Pose
    """`cam_from_world`, if they are to be read so."""


def other_readings(given: Pose) -> Iterator[Reading]:
    """The other ways to read n poses, the usual mistakes first."""
    w, x, y, z = given.quaternion.unbind(-1)
    reordered = Pose(rotation_from_quaternion(torch.stack([z, w, x, y], -1)), given.translation)
    for axes, turned in (("", False), ("to be of cameras with y up and z back (OpenGL, Blender)", True)):
        for order, written in (("", given), ("to have quaternions in the order x, y, z, w", reordered)):
            for kind, remedy, poses in _kinds(written):
                looks = " and ".join(part for part in (kind, order, axes) if part)
                if not looks:
                    continue
                todo = (
                    [remedy] * bool(kind)
                    + ["write qw,qx,qy,qz"] * bool(order)
                    + ["turn the cameras about x by 180 degrees"] * turned
                )
                yield Reading(looks, " and ".join(todo), _turned(poses) if turned else poses)


def _kinds(poses: Pose) -> Iterator[tuple[str, str, Pose]]:
    """As they are; as `world_from_cam`; with the camera's centre for t; with the rotation alone the other way round."""
    yield "", "", poses
    yield "inverted (world_from_cam)", "invert them", poses.inverse()
    places = -(poses.rotation @ poses.translation[..., None])[..., 0]
    yield "to hold the camera's centre for t", "give t = -R C", Pose(poses.rotation, places)
    yield (
        "to hold rotations that are transposed",
        "transpose them (negate qx, qy and qz)",
        Pose(poses.rotation.mT, poses.translation),
    )


def _turned(poses: Pose) -> Pose:
    return Pose(AXES[:, None] * poses.rotation, AXES * poses.translation)
