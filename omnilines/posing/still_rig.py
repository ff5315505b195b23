"""Whether a rig stood still while photos were taken, as on stands around a board that a person moves."""

from dataclasses import dataclass

import numpy as np

from omnilines.records import ImagePoses


@dataclass(frozen=True)
class StillRig:
    """A rig of which half of the instants or more are at one place."""

    off: float
    """How far half of its instants are from their middle at most."""
    apart: float
    """How far apart its cameras are."""
    cameras: int
    elsewhere: tuple[str, ...]
    """Its other instants: where it was not moved, things that moved before it have taken their poses along."""


def rig_that_stood_still(poses: ImagePoses, most_share: float) -> StillRig | None:
    """The rig, where half of its instants are within this share of the distance between its cameras from their middle: lines are
    seen from the places of one instant then. None elsewhere."""
    centres, frames = poses.cam_from_world.centre.numpy(), np.array(poses.frames or ())
    cameras = np.array(poses.cameras or ())
    if not len(frames) or not len(cameras):
        return None
    names, count = np.unique(cameras, return_counts=True)
    own = np.flatnonzero(cameras == names[count.argmax()])
    apart = max(
        float(np.linalg.norm(at[:, None] - at, axis=-1).max()) for at in (centres[frames == one] for one in np.unique(frames))
    )
    from_middle = np.linalg.norm(centres[own] - np.median(centres[own], axis=0), axis=-1)
    off = float(np.median(from_middle))
    if len(own) <= 2 or not off < most_share * apart:
        return None
    return StillRig(off, apart, len(names), tuple(frames[own[from_middle >= most_share * apart]].tolist()))
