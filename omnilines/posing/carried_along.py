"""What goes along with the camera: a vehicle, a mount or a hand that it sees, dirt on the lens.

Its features lie at the same bearings in all photos, as if the camera had neither moved nor turned. Where they are most of what
photos have in common, nothing else is found. Features of the world do so where the camera only moved and they are far away, or
where it stood still; hence they are told of where the camera turned, and left out where no photos could be joined with them.
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.features import Features
from omnilines.posing.options import PosingOptions

PairMatches = Mapping[tuple[int, int], Int[Tensor, "_ 2"]]


def carried_along(
    features: Sequence[Features], matches: PairMatches, camera: Sequence[int], options: PosingOptions = PosingOptions()
) -> dict[tuple[int, int], Bool[Tensor, " _"]]:
    """Which matches of each two photos of one `camera` are at one bearing, as near as with any geometry of a pair."""
    limit, found = options.mapper.epipolar_px / options.features.sigma_px, {}
    for (i, j), rows in matches.items():
        a, b = features[i], features[j]
        within_rad = limit * torch.maximum(a.sigma_rad[rows[:, 0]], b.sigma_rad[rows[:, 1]])
        near = (a.bearings[rows[:, 0]] - b.bearings[rows[:, 1]]).norm(dim=-1) <= within_rad
        found[i, j] = near & (camera[i] == camera[j])
    return found


def without_carried(
    features: Sequence[Features], matches: PairMatches, camera: Sequence[int], options: PosingOptions = PosingOptions()
) -> dict[tuple[int, int], Int[Tensor, "_ 2"]]:
    """The other matches."""
    along = carried_along(features, matches, camera, options)
    return {pair: rows[~along[pair]] for pair, rows in matches.items()}


def carried_share(
    features: Sequence[Features],
    matches: PairMatches,
    camera: Sequence[int],
    cam_from_world: Mapping[int, Pose],
    options: PosingOptions = PosingOptions(),
) -> float:
    """Share of the matches that are at one bearing although the camera turned by `turned_rad` and more; 0 where it did not.

    `cam_from_world` are the poses of photos that have one.
    """
    turned = {
        (i, j): rows
        for (i, j), rows in matches.items()
        if i in cam_from_world
        and j in cam_from_world
        and float((cam_from_world[i] @ cam_from_world[j].inverse()).log()[..., :3].norm()) >= options.carried.turned_rad
    }
    total = sum(map(len, turned.values()))
    along = carried_along(features, turned, camera, options)
    return sum(int(one.sum()) for one in along.values()) / total if total else 0.0
