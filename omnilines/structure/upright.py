"""Which way is up: the family of parallel lines that is vertical, told by photos that were taken about upright.

Photos are held upright to some tens of degrees, lines of buildings stand upright to tenths. So photos say which family is
vertical and which of its two directions is up, and the lines say where up is. Each photo has the same say, and half of them
may lie on their side.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.structure.families import Families
from omnilines.structure.options import UprightOptions


@dataclass(frozen=True)
class Upright:
    """The vertical of a scene, or of one photo."""

    family: int | None
    """The vertical one of the directions; None where up is known otherwise."""
    up: Float[np.ndarray, "3"]
    """Unit vector that points up, in the frame of the directions."""
    sigma_rad: float | None = None
    """Standard deviation of it, in each of two directions, where that is known."""


def photos_up(cam_from_world: Pose) -> Float[np.ndarray, "3"]:
    """The direction (unit) that is up in the median photo: -y of its camera."""
    return _median(-cam_from_world.rotation[:, 1].numpy())


def agreed_up(ups: Float[np.ndarray, "m 3"], options: UprightOptions = UprightOptions()) -> Upright | None:
    """What more than half of the photos, and two at least, say is up, with its standard deviation by how far they differ.

    `ups` are the verticals that each shows by itself, brought into the world. None where they do not agree to `horizontal_rad`.
    """
    if len(ups) < 2:
        return None
    near = ups[ups @ _median(ups) >= math.cos(options.horizontal_rad)]
    if len(near) < max(2, len(ups) // 2 + 1):
        return None
    up = _median(near)
    apart2 = float(np.square(near - up).sum()) / (2 * (len(near) - 1))
    return Upright(None, up, math.sqrt(apart2 / len(near)))


def better_known(
    by_lines: Upright | None, by_photos: Upright | None, options: UprightOptions = UprightOptions()
) -> Upright | None:
    """The vertical of the scene: that of the photos where the lines have none, or know it less well and do not contradict."""
    if by_lines is None or by_photos is None:
        return by_photos if by_lines is None else by_lines
    agree = float(by_lines.up @ by_photos.up) >= math.cos(options.horizontal_rad)
    of_photos, of_lines = by_photos.sigma_rad, by_lines.sigma_rad
    surer = of_photos is not None and of_lines is not None and of_photos < of_lines
    return by_photos if agree and surer else by_lines


def _median(ups: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "3"]:
    """Weiszfeld's median of unit vectors, as one."""
    middle = ups.mean(0)
    for _ in range(50):
        weight = 1.0 / np.maximum(np.linalg.norm(ups - middle, axis=-1), 1e-9)
        middle = (weight[:, None] * ups).sum(0) / weight.sum()
    length = float(np.linalg.norm(middle))
    return middle / length if length > 0 else ups[0]


def vertical_family(families: Families, cam_from_world: Pose, options: UprightOptions = UprightOptions()) -> Upright | None:
    """The family that is vertical, and its upper side; None where the photos do not tell (`vertical_direction`)."""
    found = vertical_direction(families.direction, families.members, -cam_from_world.rotation[:, 1].numpy(), options)
    if found is None or found.family is None:
        return found
    return replace(found, sigma_rad=float(families.sigma_rad[found.family]))


def vertical_direction(
    direction: Float[np.ndarray, "k 3"],
    members: Int[np.ndarray, " k"],
    ups: Float[np.ndarray, "m 3"],
    options: UprightOptions = UprightOptions(),
) -> Upright | None:
    """Which of some directions with so many lines is vertical, by what photos have for up (-y of their cameras).

    The angle of a direction to the photos' up is the median over the photos. The vertical one is the nearest within
    `upright_rad`; where others are as near, it is the largest of them, if it has clearly more lines than the next.
    """
    if not len(direction) or not len(ups):
        return None
    cosine = ups @ direction.T
    side = np.where(np.median(cosine, axis=0) < 0, -1.0, 1.0)
    angle = np.median(np.arccos(np.clip(side * cosine, -1.0, 1.0)), axis=0)
    limit = min(options.as_near * float(angle.min()) + options.as_near_rad, options.upright_rad)
    near = np.flatnonzero(angle <= limit)
    near = near[np.argsort(-members[near], kind="stable")]
    if not len(near) or (len(near) > 1 and members[near[0]] < options.clearly_more * members[near[1]]):
        return None
    best = int(near[0])
    return Upright(best, side[best] * direction[best])


def upright_from_world(
    families: Families, upright: Upright, cam_from_world: Pose, options: UprightOptions = UprightOptions()
) -> Float[Tensor, "3 3"]:
    """The rotation to a world with z up and x along the largest horizontal family, on the side to the right of the first photo.

    Without a horizontal family x is where the first photo has its right, along the ground.
    """
    z = upright.up
    right = cam_from_world.rotation[0, 0].numpy()
    sine = math.sin(options.horizontal_rad)
    if float(np.linalg.norm(np.cross(right, z))) < sine:
        right = cam_from_world.rotation[0, 2].numpy()
    level = np.abs(families.direction @ z) <= sine
    # Families are sorted by size.
    x = families.direction[int(np.flatnonzero(level)[0])] if level.any() else right
    return torch.as_tensor(level_axes(x if x @ right >= 0 else -x, z))


def level_axes(right: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """x, y and z as rows, with z up and x as far to the right as is level; up is a unit vector, and not along right."""
    x = right - (right @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
