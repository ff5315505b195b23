"""Which lines run along the same planes (walls, floors, fronts), and which of them are near each other.

Two families of parallel lines span planes of one normal. What is built has many lines in few of these planes: the gap across the
planes between a line and one of those beside it is a millimetre, or anything. A line of which the place across the planes is not
known well then lies in the plane of one of its neighbours, or in none; how often there is which gap is found from the lines
themselves (`gaps.py`). With m neighbours j,

    p(c) = sum_k a_k / m sum_j N(c - c_j; 0, v + v_j + t_k^2),

c the place of the line across the planes, v its variance.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from omnilines.structure.gaps import TINY, likely_shares, log_density
from omnilines.structure.options import PlaneOptions

PLACES = 5
"""Points of each line from which, and to which, neighbours are sought."""
SOUGHT = 6
"""Times as many points as neighbours are looked at: several may be of one line, or of the line itself."""


def plane_normals(
    direction: Float[np.ndarray, "k 3"], separation_rad: float, options: PlaneOptions = PlaneOptions()
) -> Float[np.ndarray, "p 3"]:
    """Unit normals of the planes that two directions each span, of families with the largest first; none within `separation_rad`
    of one before it."""
    largest = direction[: options.most_families]
    one, other = np.triu_indices(len(largest), 1)
    # Those with the largest second family first.
    order = np.lexsort((one, other))
    across = np.cross(largest[one[order]], largest[other[order]])
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    normals = (across / np.maximum(sine, TINY))[sine[:, 0] >= math.sin(options.min_angle_rad)]
    kept = np.zeros((0, 3))
    for normal in normals:
        if (np.abs(kept @ normal) < math.cos(separation_rad)).all():
            kept = np.append(kept, normal[None], axis=0)
    return kept


@dataclass(frozen=True)
class PlaneGaps:
    """How far each of r lines lies from the planes of m neighbours, with c standard deviations that gaps may have."""

    gap_m: Float[np.ndarray, "r m"]
    variance_m2: Float[np.ndarray, "r m"]
    """Of what was measured of both."""
    there: Bool[np.ndarray, "r m"]
    """Whether a line has so many neighbours."""
    gaps_m: Float[np.ndarray, " c"]

    @property
    def spread_m2(self) -> Float[np.ndarray, "r m c"]:
        """Variance of each gap with each standard deviation."""
        return self.variance_m2[..., None] + self.gaps_m**2

    @property
    def density(self) -> Float[np.ndarray, "r m c"]:
        """Of each gap, over the largest of its line; 0 where there is no neighbour."""
        log = np.where(self.there[..., None], log_density(self.gap_m, self.spread_m2), -np.inf)
        return np.exp(log - log.max((1, 2), keepdims=True))

    def shares(self) -> Float[np.ndarray, "r c"]:
        """Of the standard deviations, under which the gaps of lines about as uncertain are most likely."""
        _, group = np.unique(np.searchsorted(self.gaps_m, np.sqrt(np.median(self.variance_m2, axis=1))), return_inverse=True)
        return likely_shares(self.density.mean(1), group)[group]

    def weights(self, share: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r m c"]:
        """Probability of each neighbour and standard deviation; those of one line add up to 1."""
        weight = share[:, None] * self.density
        return weight / weight.sum((1, 2), keepdims=True)


def lines_beside(
    ends: Float[np.ndarray, "k 2 3"], asked: Bool[np.ndarray, " k"], options: PlaneOptions = PlaneOptions()
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Pairs of a line and one of those `asked` near it, by the first line, and those of one line by their distance."""
    parts = np.linspace(0.0, 1.0, PLACES)[:, None]
    points = (1.0 - parts) * ends[:, :1] + parts * ends[:, 1:]
    own = np.flatnonzero(asked)
    count = min(SOUGHT * options.neighbours, PLACES * len(own))
    if not count:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    found = cKDTree(points[own].reshape(-1, 3)).query(points.reshape(-1, 3), k=np.arange(1, count + 1))
    distance, place = (np.asarray(values).ravel() for values in found)
    one, other = np.repeat(np.arange(len(ends)), PLACES * count), own[place // PLACES]
    order = np.lexsort((distance, other, one))
    order = order[np.diff(one[order] * len(ends) + other[order], prepend=-1) != 0]
    order = order[one[order] != other[order]]
    order = order[np.lexsort((distance[order], one[order]))]
    return one[order], other[order]


def nearest(
    one: Int[np.ndarray, " n"], other: Int[np.ndarray, " n"], lines: int, options: PlaneOptions = PlaneOptions()
) -> Int[np.ndarray, "lines m"]:
    """The first of the pairs of each line (`lines_beside`), -1 where there are fewer than `options.neighbours`."""
    turn = np.arange(len(one)) - np.searchsorted(one, one)
    table = np.full((lines, options.neighbours), -1)
    first = turn < options.neighbours
    table[one[first], turn[first]] = other[first]
    return table
