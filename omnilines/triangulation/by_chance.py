"""Whether tracks fit poses and cameras better than segments that were put together at random.

A track stands out where its own segments fit one line better than all random choices of segments of the same photos do: n choices
are as good or better by chance in all but one of n + 1 cases, whatever the noise and the cameras. Poses that are off leave large
residuals, and random choices larger ones: rough poses pass, those of another scene do not.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import bdtrc, ndtr
from torch import Tensor

from camera_models.repeatable import total
from omnilines.triangulation.candidates import candidate_batches
from omnilines.triangulation.consensus import majority
from omnilines.triangulation.observations import PlaneObservations

PAIRS = 16
"""Of planes, whose lines are tried of each track."""
CHOICES = 49
"""Random ones, of each track."""
PLANES = 8
"""Of segments, that are tried for a line at infinity."""
LEAST_SQUARE, LARGEST_SQUARE = 1e-8, 1e8
"""Beyond these a distance is nothing but rounding, or any."""
LEAST_CHOICES = 5
"""With fewer that differ nothing can be said of a track."""
OF_PHOTO, OTHERS, OTHER_CHOICES = 20, 7, 9
"""Segments of a photo that are looked at; of each, segments of its track in other photos, and choices in its place."""


@dataclass(frozen=True)
class StandOut:
    """How many tracks stand out from random choices."""

    tracks: int
    """Of which that can be said."""
    standing_out: int
    share_by_chance: float
    """Of tracks that stand out although segments are put together at random."""
    mean_rank: float
    """Share of the random choices that fit a track better than its own segments: 1/2 by chance."""

    @property
    def chance(self) -> float:
        """Probability that as many or more stand out, or that the mean rank is as low, by chance; 1 where nothing tells.

        Rough poses leave many tracks near the best of the random choices and few beyond it. A mean of uniform numbers is normal.
        """
        if not self.tracks:
            return 1.0
        beyond = float(bdtrc(self.standing_out - 1, self.tracks, self.share_by_chance)) if self.standing_out else 1.0
        low = float(ndtr((self.mean_rank - 0.5) * math.sqrt(12 * self.tracks)))
        return min(1.0, 2 * min(beyond, low))


def misfit(observations: PlaneObservations, seed: int = 0) -> Float[Tensor, " t"]:
    """Geometric mean of the squared distances (both ends, over their noise) of the segments of each track from the best line of
    two of them, near or at infinity; below three segments infinite.

    Few wrong members of a track leave a small one; of segments that were put together at random few are near by chance.
    """
    least = torch.full((observations.tracks,), torch.inf, dtype=torch.float64)
    for tracks, rows in observations.by_count():
        views = rows.shape[1]
        if views < 3:
            continue
        batches = candidate_batches(observations, rows, PAIRS, seed)
        near = torch.cat([_of_others(square, pairs).amin(-1) for pairs, _, _, square in batches])
        first = torch.arange(min(views, PLANES))
        far = _of_others(_at_infinity(observations, rows[:, first], rows), first[:, None]).amin(-1)
        least[tracks] = torch.minimum(near, far).exp()
    return least


def _of_others(square: Float[Tensor, "g p k"], members: Int[Tensor, "p j"]) -> Float[Tensor, "g p"]:
    """Mean logarithm over the rows that are not those that a candidate was found from."""
    logarithm = square.nan_to_num(nan=torch.inf).clamp(LEAST_SQUARE, LARGEST_SQUARE).log()
    others = torch.ones(square.shape[1:], dtype=torch.bool).scatter(1, members, False)
    return (logarithm * others).sum(-1) / others.sum(-1)


def _at_infinity(observations: PlaneObservations, planes: Int[Tensor, "g p"], rows: Int[Tensor, "g k"]) -> Float[Tensor, "g p k"]:
    """Squared distances from one plane through every camera: of a line far away, or of cameras at one place."""
    arcs, noise, normal = observations.arcs, observations.noise, observations.normal[planes]
    assert arcs is not None and noise is not None
    along = torch.einsum("gpx,gkex->gpke", normal, arcs[rows])
    variance = torch.einsum("gpx,gkexq->gpkeq", normal, noise[rows]).square().sum(-1)
    return (along.square() / variance).sum(-1)


def standing_out(observations: PlaneObservations, image: Int[Tensor, " n"], rows: Int[Tensor, " m"], seed: int = 0) -> StandOut:
    """Of the tracks of `rows`, those that stand out from random choices among all observations of the same photos (`image`)."""
    named, track = observations.track[rows].unique(return_inverse=True)
    tracks, photo = len(named), image[rows]
    generator = torch.Generator().manual_seed(seed)
    order = image.argsort(stable=True)
    count = torch.bincount(image)
    start = count.cumsum(0) - count
    place = torch.rand(CHOICES, len(rows), generator=generator, dtype=torch.float64) * count[photo]
    picked = order[start[photo] + place.long().minimum(count[photo] - 1)]
    number = track + tracks * torch.arange(CHOICES)[:, None]
    square = misfit(observations.take(picked.flatten(), number.flatten(), CHOICES * tracks), seed).view(CHOICES, tracks)
    views = torch.bincount(track, minlength=tracks)
    usable = _mixed(observations.track[picked], number, views) & _new(picked, track, tracks, generator)
    choices = usable.sum(0)
    tells = (choices >= LEAST_CHOICES) & (views >= 3)
    own = misfit(observations.take(rows, track, tracks), seed)
    worse = torch.where(usable, (own > square).double() + 0.5 * (own == square), 0.0).sum(0)
    tracks_told = int(tells.sum())
    if not tracks_told:
        return StandOut(0, 0, 1.0, 0.5)
    by_chance = total(1.0 / (1.0 + choices[tells])) / tracks_told
    return StandOut(tracks_told, int((worse[tells] == 0).sum()), by_chance, total(worse[tells] / choices[tells]) / tracks_told)


def photo_standing_out(observations: PlaneObservations, image: Int[Tensor, " n"], photo: int, seed: int = 0) -> StandOut:
    """Of the tracks that a photo shows, those that its own segment fits better than other segments of it do in its place.

    Where its pose, or its name, is of another photo, it is one of them; rough poses, and other photos that are wrong, leave most
    tracks standing out."""
    generator = torch.Generator().manual_seed(seed)

    def some(of: Int[Tensor, " k"], most: int) -> Int[Tensor, " m"]:
        return of[torch.randperm(len(of), generator=generator)[:most]]

    own = torch.nonzero(image == photo).flatten()
    tried = list[Int[Tensor, "c k"]]()
    for row in some(own, OF_PHOTO):
        same = observations.track == observations.track[row]
        others, choices = some(torch.nonzero(same & (image != photo)).flatten(), OTHERS), some(own[~same[own]], OTHER_CHOICES)
        if len(others) >= 2 and len(choices) >= LEAST_CHOICES:
            in_place = torch.cat([row[None], choices])
            tried.append(torch.cat([in_place[:, None], others.expand(len(in_place), -1)], 1))
    if not tried:
        return StandOut(0, 0, 1.0, 0.5)
    number = torch.cat([torch.full((len(one),), one.shape[1]) for one in tried])
    track = torch.arange(len(number)).repeat_interleave(number)
    square = misfit(observations.take(torch.cat([one.flatten() for one in tried]), track, len(number)), seed)
    better = [float(((one[1:] < one[0]) + 0.5 * (one[1:] == one[0])).mean()) for one in square.split([len(one) for one in tried])]
    by_chance = sum(1.0 / len(one) for one in tried) / len(tried)
    return StandOut(len(tried), better.count(0.0), by_chance, sum(better) / len(tried))


def _mixed(track: Int[Tensor, "c m"], number: Int[Tensor, "c m"], views: Int[Tensor, " t"]) -> Bool[Tensor, "c t"]:
    """Choices of which no majority is of one track, so that it would decide."""
    choices, tracks = len(track), len(views)
    pair, times = torch.stack([number.flatten(), track.flatten()]).unique(dim=1, return_counts=True)
    most = torch.zeros(choices * tracks, dtype=times.dtype).scatter_reduce(0, pair[0], times, "amax")
    return most.view(choices, tracks) < torch.tensor([majority(k) for k in views.tolist()])


def _new(picked: Int[Tensor, "c m"], track: Int[Tensor, " m"], tracks: int, generator: torch.Generator) -> Bool[Tensor, "c t"]:
    """Choices that differ, each counted once: equal ones have equal sums of random weights."""
    weighted = picked * torch.rand(picked.shape[1], generator=generator, dtype=torch.float64)
    name = torch.zeros(len(picked), tracks, dtype=torch.float64).index_add_(1, track, weighted)
    name, rank = name.sort(dim=0, stable=True)
    fresh = torch.ones_like(name, dtype=torch.bool)
    fresh[1:] = name[1:] != name[:-1]
    return torch.zeros_like(fresh).scatter(0, rank, fresh)
