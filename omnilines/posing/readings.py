"""What a table of poses may hold in place of `cam_from_world`: its numbers read as other tools write them."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models.pose import Pose, rotation_from_quaternion

AXES = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Of a camera that looks along -z with y up (OpenGL, Blender), in ours."""
MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
"""Of a left-handed world, to a right-handed one."""


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
    """The other ways to read n poses that are usual, the commonest mistakes first."""
    yield from _all_kinds(given, None)
    yield from _all_kinds(given, _Axes("to be of cameras with y up and z back (OpenGL, Blender)", AXES))


def rarer_readings(given: Pose, kinds: int | None = None) -> Iterator[Reading]:
    """Slips of a sign; then with any other axes of the cameras (robots, aircraft, photos that were turned), also left-handed
    ones (Unity, Unreal); so many ways to write each, the commonest first: as they are, inverted."""
    yield from _slips(given)
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = torch.zeros(3, 3, dtype=torch.float64)
            axes[torch.arange(3), torch.tensor(order)] = torch.tensor(signs, dtype=torch.float64)
            if not (torch.equal(axes, AXES) or torch.equal(axes, torch.eye(3, dtype=torch.float64))):
                named = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs, strict=True))
                hand = "" if torch.linalg.det(axes) > 0 else "left-handed and "
                of_axes = _Axes(f"to be {hand}of cameras whose right, down and forward are {named}", axes)
                yield from itertools.islice(_all_kinds(given, of_axes), kinds)


def _slips(given: Pose) -> Iterator[Reading]:
    """Signs of t."""
    for signs, named in (((1, 1, -1), "tz"), ((1, -1, 1), "ty"), ((-1, 1, 1), "tx"), ((-1, -1, -1), "tx, ty and tz")):
        negated = Pose(given.rotation, given.translation * given.translation.new_tensor(signs))
        yield Reading(f"to hold {named} with the other sign", f"negate {named}", negated)


@dataclass(frozen=True)
class _Axes:
    """Of other cameras."""

    looks: str
    ours: Float[Tensor, "3 3"]
    """x of our camera from x of theirs; where it mirrors, the world is mirrored too."""

    def read(self, poses: Pose) -> Pose:
        left_handed = float(torch.linalg.det(self.ours)) < 0
        turned = self.ours @ poses.rotation @ (MIRROR if left_handed else torch.eye(3, dtype=torch.float64))
        return Pose(turned, poses.translation @ self.ours.T)


def _all_kinds(given: Pose, axes: _Axes | None) -> Iterator[Reading]:
    """All ways to write a pose, of cameras with such axes; but for the one that is expected."""
    w, x, y, z = given.quaternion.unbind(-1)
    reordered = Pose(rotation_from_quaternion(torch.stack([z, w, x, y], -1)), given.translation)
    for order, written in (("", given), ("to have quaternions in the order x, y, z, w", reordered)):
        for kind, remedy, poses in _kinds(written):
            looks = [part for part in (kind, order, "" if axes is None else axes.looks) if part]
            if looks:
                todo = [remedy] * bool(kind) + ["write qw,qx,qy,qz"] * bool(order)
                todo += ["give them for cameras with x right, y down and z forward"] * (axes is not None)
                yield Reading(" and ".join(looks), " and ".join(todo), poses if axes is None else axes.read(poses))


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
