"""What goes along with the camera: a vehicle, a mount or a hand that it sees, dirt on the lens.

Its features lie at the same bearings in all photos, as if the camera had neither moved nor turned. Where they are most of what
photos have in common, nothing else is found, or poses with which nothing else agrees. Features of the world do so where the
camera only moved and they are far away, or where it stood still; hence they are told of where the camera turned, and left out
where no photos could be joined with them, or where more of the other matches agree without them.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.bearing_residual import near_epipolar_arc
from omnilines.posing.features import Features
from omnilines.posing.growth import PairMatches
from omnilines.posing.options import PosingOptions


def carried_along(
    features: Sequence[Features], matches: PairMatches, camera: Sequence[int], options: PosingOptions = PosingOptions()
) -> dict[tuple[int, int], Bool[Tensor, " _"]]:
    """Which matches of each two photos of one `camera` are at one bearing, as near as with any geometry of a pair."""
    found = {}
    for (i, j), rows in matches.items():
        a, b, within_rad = _rays(features[i], features[j], rows, options)
        found[i, j] = ((a - b).norm(dim=-1) <= within_rad) & (camera[i] == camera[j])
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
    poses: Mapping[int, Pose],
    options: PosingOptions = PosingOptions(),
    *,
    contradicting: bool = False,
) -> float:
    """Share of the matches that are at one bearing although the camera turned by `turned_rad` and more; 0 where it did not. With
    `contradicting` only those count that the poses do not explain: that do not meet in front of both photos.

    `poses` are cam_from_world of the photos that have one.
    """
    pairs = [pair for pair in matches if pair[0] in poses and pair[1] in poses]
    if not pairs:
        return 0.0
    first, second = (torch.stack([poses[photo].rotation for photo in side]) for side in zip(*pairs, strict=True))
    # The trace of a turn from one to the other is 1 + 2 cos of its angle.
    turned = (first * second).sum((-2, -1)) <= 1.0 + 2.0 * math.cos(options.carried.turned_rad)
    far = {pair: matches[pair] for pair, is_far in zip(pairs, turned.tolist(), strict=True) if is_far}
    along = carried_along(features, far, camera, options)
    if contradicting:
        along = {pair: rows & ~_meeting(features, pair, far[pair], poses, options) for pair, rows in along.items()}
    total = sum(map(len, along.values()))
    return sum(int(one.sum()) for one in along.values()) / total if total else 0.0


def agreeing(
    features: Sequence[Features], matches: PairMatches, poses: Mapping[int, Pose], options: PosingOptions = PosingOptions()
) -> int:
    """How many of the matches meet in front of both photos, by the poses: cam_from_world of the photos that have one."""
    placed = [pair for pair in matches if pair[0] in poses and pair[1] in poses]
    return sum(int(_meeting(features, pair, matches[pair], poses, options).sum()) for pair in placed)


def _meeting(
    features: Sequence[Features],
    pair: tuple[int, int],
    rows: Int[Tensor, "m 2"],
    poses: Mapping[int, Pose],
    options: PosingOptions,
) -> Bool[Tensor, " m"]:
    i, j = pair
    a, b, within_rad = _rays(features[i], features[j], rows, options)
    return near_epipolar_arc(a, b, poses[j] @ poses[i].inverse(), within_rad)


def _rays(
    one: Features, other: Features, rows: Int[Tensor, "m 2"], options: PosingOptions
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, " m"]]:
    """Bearings of matched features in either photo, and the angle within which they agree with the geometry of the pair."""
    first, second = rows.unbind(1)
    limit = options.mapper.epipolar_px / options.features.sigma_px
    return one.bearings[first], other.bearings[second], limit * torch.maximum(one.sigma_rad[first], other.sigma_rad[second])
