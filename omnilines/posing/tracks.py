"""Features that are one point of the scene, and where it is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.bearing_residual import bearing_residual, placed
from omnilines.posing.features import Features
from omnilines.posing.kernels.join import joined

MAX_PAIRS = 8
"""Pairs of a track, those with most parallax, that a point is tried from."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Features of photos that see points, one row each."""

    photo: Int[Tensor, " n"]
    feature: Int[Tensor, " n"]
    point: Int[Tensor, " n"]
    bearings: Float[Tensor, "n 3"]
    rows: Float[Tensor, "n 2 3"]
    """See `Features.rows`."""

    def __len__(self) -> int:
        return len(self.photo)

    def chosen(self, rows: Tensor) -> "Observations":
        """Some of them; points keep their numbers."""
        return Observations(self.photo[rows], self.feature[rows], self.point[rows], self.bearings[rows], self.rows[rows])


def observations_of(features: Sequence[Features], photo: Tensor, feature: Tensor, point: Tensor) -> Observations:
    """Rows of features gathered from all photos."""
    start = torch.cumsum(torch.tensor([0, *(len(f) for f in features[:-1])]), 0)
    at = start[photo] + feature
    bearings, rows = torch.cat([f.bearings for f in features]), torch.cat([f.rows for f in features])
    return Observations(photo, feature, point, bearings[at], rows[at])


def triangulated_tracks(
    features: Sequence[Features],
    matches: Mapping[tuple[int, int], Int[Tensor, "_ 2"]],
    cam_from_world: Pose,
    limit: float,
    min_parallax_rad: float,
) -> tuple[Observations, Float[Tensor, "p 3"]]:
    """Points of features linked by matches, and the observations that agree with them to `limit` standard deviations.

    A track has one feature of a photo at most: matches join tracks in the order of their likeness, the most alike first, but for
    those that would bring two features of one photo together. Of what all matches connect a few wrong ones make one track that
    most features of a street are in. A point is tried from the pairs of its track with most parallax, and the one that most
    observations agree with is taken (sum min(r^2, limit^2)). Points need two photos and a parallax of `min_parallax_rad`.
    """
    start = torch.cumsum(torch.tensor([0, *(len(f) for f in features)]), 0)
    photo_of = torch.repeat_interleave(torch.arange(len(features)), start.diff())
    links = _links(features, matches, start)
    track = torch.as_tensor(joined(links.numpy(), photo_of.numpy()))
    links = links[track[links[:, 0]] == track[links[:, 1]]]
    used = torch.unique(links)
    tracks, point = torch.unique(track[used], return_inverse=True)
    order = torch.argsort(point, stable=True)
    used, photo = used[order], photo_of[used[order]]
    seen = observations_of(features, photo, used - start[photo], point[order])
    row_of = torch.full((len(photo_of),), -1)
    row_of[used] = torch.arange(len(used))
    points, known = _best_points(seen, row_of[links], cam_from_world, len(tracks), limit, min_parallax_rad)
    square = _residual(seen, points[seen.point], cam_from_world).square().sum(-1)
    return compact(seen.chosen(torch.nonzero(known[seen.point] & (square < limit**2)).flatten()), points)


def _links(
    features: Sequence[Features], matches: Mapping[tuple[int, int], Int[Tensor, "_ 2"]], start: Int[Tensor, " n1"]
) -> Int[Tensor, "l 2"]:
    """Matches as pairs of features of all photos, numbered one after another; those most alike (cosine of descriptors) first."""
    pairs, alike = [torch.zeros(0, 2, dtype=torch.long)], [np.zeros(0)]
    for (i, j), pair in matches.items():
        pairs.append(pair + start[[i, j]])
        (a, b), rows = (features[i], features[j]), pair.numpy().T
        one, other = (f.descriptors.numpy()[row].astype(np.float32) for f, row in zip((a, b), rows, strict=True))
        alike.append(np.einsum("nk,nk->n", one, other) / (a.lengths[rows[0]] * b.lengths[rows[1]]))
    order = np.argsort(-np.concatenate(alike), kind="stable")
    return torch.cat(pairs)[torch.as_tensor(order)]


def _best_points(
    seen: Observations, links: Int[Tensor, "l 2"], cam_from_world: Pose, count: int, limit: float, min_parallax_rad: float
) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, " p"]]:
    """The best point of each track among those of its pairs, and whether it has any; rows of `seen` are sorted by track."""
    at, sound, parallax = _midpoints(seen, links, cam_from_world, min_parallax_rad)
    track = seen.point[links[:, 0]]
    # The pairs with most parallax of every track.
    order = torch.argsort(parallax, descending=True, stable=True)
    order = order[torch.argsort(track[order], stable=True)]
    order = order[sound[order]]
    number = torch.arange(len(order)) - torch.searchsorted(track[order], track[order])
    tried = order[number < MAX_PAIRS]
    sizes = torch.bincount(seen.point, minlength=count)
    first = torch.cumsum(sizes, 0) - sizes
    own = sizes[track[tried]]
    trial = torch.repeat_interleave(torch.arange(len(tried)), own)
    row = first[track[tried]][trial] + torch.arange(len(trial)) - (torch.cumsum(own, 0) - own)[trial]
    square = _residual(seen.chosen(row), at[tried][trial], cam_from_world).square().sum(-1)
    cost = torch.zeros(len(tried), dtype=torch.float64).index_add_(0, trial, square.clamp_max(limit**2))
    best = torch.argsort(cost, descending=True, stable=True)
    points, known = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(count, dtype=torch.bool)
    chosen = torch.full((count,), -1)
    chosen[track[tried[best]]] = best
    known = chosen >= 0
    points[known] = at[tried[chosen[known]]]
    return points, known


def _midpoints(
    seen: Observations, links: Int[Tensor, "l 2"], cam_from_world: Pose, min_parallax_rad: float
) -> tuple[Float[Tensor, "l 3"], Bool[Tensor, " l"], Float[Tensor, " l"]]:
    """The points nearest to both rays of pairs of observations, whether they are before both cameras, and the rays' angle."""
    poses = [cam_from_world[seen.photo[links[:, k]]] for k in (0, 1)]
    centre, other = (pose.centre for pose in poses)
    a, b = ((pose.rotation.mT @ seen.bearings[links[:, k], :, None])[..., 0] for k, pose in enumerate(poses))
    normal = torch.linalg.cross(a, b)
    square = normal.square().sum(-1).clamp_min(1e-300)
    between = other - centre
    s = (torch.linalg.cross(between, b) * normal).sum(-1) / square
    t = (torch.linalg.cross(between, a) * normal).sum(-1) / square
    parallax = torch.atan2(square.sqrt(), (a * b).sum(-1))
    sound = (s > 0) & (t > 0) & (parallax > min_parallax_rad) & (links[:, 0] != links[:, 1])
    return 0.5 * (centre + s[:, None] * a + other + t[:, None] * b), sound, parallax


def _residual(seen: Observations, points: Float[Tensor, "n 3"], cam_from_world: Pose) -> Float[Tensor, "n 2"]:
    return bearing_residual(seen.bearings, seen.rows, placed(cam_from_world[seen.photo], points))[0]


def compact(seen: Observations, points: Float[Tensor, "p 3"]) -> tuple[Observations, Float[Tensor, "q 3"]]:
    """Only points that two observations or more see, numbered anew."""
    often = torch.bincount(seen.point, minlength=len(points)) >= 2
    number = torch.cumsum(often.long(), 0) - 1
    kept = seen.chosen(torch.nonzero(often[seen.point]).flatten())
    return Observations(kept.photo, kept.feature, number[kept.point], kept.bearings, kept.rows), points[often]
