"""Where lines end together in photos, and how far lines that do so pass each other.

Two arcs of one photo end together where an end of each lies near the point that both circles share. Such lines meet, or
something hides where they go on: then there is a gap between them. Which share of the corners has which gap is found from the
lines themselves (`gaps.py`), for corners that two, three, and more photos show each.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from omnilines.structure.gaps import TINY, likely_shares, log_density
from omnilines.structure.options import CornerOptions

FARTHEST, APART = 2.0, 3.0
"""Distance of opposite bearings, and of two photos in the search for arcs that end together."""


@dataclass(frozen=True)
class Corners:
    """k pairs of lines that end together in several photos."""

    line: Int[np.ndarray, "k 2"]
    """Both lines, the lower number first."""
    photos: Int[np.ndarray, " k"]
    """In which they end together."""

    def __len__(self) -> int:
        return len(self.line)

    def rows(self, chosen: Bool[np.ndarray, " k"]) -> "Corners":
        """Some of them."""
        return Corners(self.line[chosen], self.photos[chosen])


def corners_seen(
    image: Int[np.ndarray, " n"],
    line: Int[np.ndarray, " n"],
    ends: Float[np.ndarray, "n 2 3"],
    normal: Float[np.ndarray, "n 3"],
    px_rad: Float[np.ndarray, " n"],
    options: CornerOptions = CornerOptions(),
) -> Corners:
    """The corners of arcs of photos (`image`) and lines (`line`), of end bearings and normals (unit, world); `px_rad` a pixel."""
    one, other = _together(image, line, ends, normal, px_rad, options)
    seen = np.unique(np.column_stack([np.sort(np.stack([line[one], line[other]], -1), axis=-1), image[one]]), axis=0)
    lines, photos = np.unique(seen[:, :2], axis=0, return_counts=True)
    enough = photos >= options.min_photos
    return Corners(lines[enough], photos[enough])


def _together(
    image: Int[np.ndarray, " n"],
    line: Int[np.ndarray, " n"],
    ends: Float[np.ndarray, "n 2 3"],
    normal: Float[np.ndarray, "n 3"],
    px_rad: Float[np.ndarray, " n"],
    options: CornerOptions,
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Pairs of arcs of one photo and two lines that end together."""
    end, reach = ends.reshape(-1, 3), options.reach_px * px_rad
    # One search for all photos: in a fourth direction they are farther from each other than any two bearings.
    apart = np.column_stack([end, np.repeat(APART * image, 2)])
    one, other = cKDTree(apart).query_pairs(min(2.0 * float(reach.max(initial=0.0)), FARTHEST), output_type="ndarray").T
    one, other = (pair[line[one // 2] != line[other // 2]] for pair in (one, other))
    point = np.cross(normal[one // 2], normal[other // 2])
    sine = np.linalg.norm(point, axis=-1)
    point *= (np.sign((point * (end[one] + end[other])).sum(-1)) / np.maximum(sine, TINY))[:, None]
    near: Bool[np.ndarray, " p"] = sine > options.min_sine
    for k in (one, other):
        near &= np.linalg.norm(end[k] - point, axis=-1) <= reach[k // 2]
    return one[near] // 2, other[near] // 2


@dataclass(frozen=True)
class GapShares:
    """How far lines that end together pass each other."""

    gaps_m: Float[np.ndarray, " c"]
    """Standard deviations of the gap."""
    share: Float[np.ndarray, "g c"]
    """Of the corners of each number of photos, those of each gap."""
    group: Int[np.ndarray, " k"]
    """The row of `share` of each corner."""


def gap_shares(
    gap_m: Float[np.ndarray, " k"],
    variance_m2: Float[np.ndarray, " k"],
    photos: Int[np.ndarray, " k"],
    distance_m: float,
    options: CornerOptions = CornerOptions(),
) -> GapShares:
    """The shares under which the gaps of corners are most likely; `distance_m` is what `options.gaps` are shares of."""
    gaps = distance_m * np.array(options.gaps)
    _, group = np.unique(np.minimum(photos, options.most_photos), return_inverse=True)
    return GapShares(gaps, likely_shares(likelihood(gap_m, variance_m2, gaps), group), group)


def meeting_share(
    gap_m: Float[np.ndarray, " k"],
    variance_m2: Float[np.ndarray, " k"],
    photos: Int[np.ndarray, " k"],
    distance_m: float,
    options: CornerOptions = CornerOptions(),
) -> Float[np.ndarray, " k"]:
    """The probability that the lines of each corner meet, under the shares that `gap_shares` finds of these corners."""
    shares = gap_shares(gap_m, variance_m2, photos, distance_m, options)
    weight = shares.share[shares.group] * likelihood(gap_m, variance_m2, shares.gaps_m)
    return weight[:, np.array(options.gaps) <= options.meeting_gap].sum(-1) / weight.sum(-1)


def likelihood(
    gap_m: Float[np.ndarray, " k"], variance_m2: Float[np.ndarray, " k"], gaps_m: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "k c"]:
    """N(g; 0, v + t^2) of each gap and each standard deviation t, over the largest of the gap."""
    log = log_density(gap_m, variance_m2[:, None] + gaps_m**2)
    return np.exp(log - log.max(-1, keepdims=True))
