"""Whether poses explain what photos have in common, so that no other way of joining them would place some of them elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.bearing_residual import near_epipolar_arc


@dataclass(frozen=True)
class Rays:
    """The matches of a verified pair."""

    a: Float[Tensor, "m 3"]
    b: Float[Tensor, "m 3"]
    limit_rad: float
    agrees: bool
    """Whether its rotation is that of the others."""
    fits: bool
    """Or may be: matches leave that one possible too."""


def explained_matches(part: Mapping[int, Pose], rays: Mapping[tuple[int, int], Rays]) -> dict[tuple[int, int], int]:
    """Of each pair of photos that are placed, how many verified matches meet in front of both."""
    counts = {}
    for (i, j), pair in rays.items():
        if i in part and j in part:
            near = near_epipolar_arc(pair.a, pair.b, part[j] @ part[i].inverse(), pair.limit_rad)
            counts[i, j] = int(near.sum())
    return counts


def settled(
    photos: int,
    explained: Mapping[tuple[int, int], int],
    rays: Mapping[tuple[int, int], Rays],
    least_share: float,
    least: float,
) -> bool:
    """Whether each photo is placed and explains so large a share of its matches, in pairs that fit the rotations of the others,
    and at least so many, that no other way of adding photos would place it elsewhere: at a wrong place only few meet. And so each
    group of photos, of its matches with the others: those inside are explained wherever it is as a whole."""
    own, all_own = np.zeros(photos), np.zeros(photos)
    for pair, one in rays.items():
        if one.fits:
            own[list(pair)] += explained.get(pair, 0)
            all_own[list(pair)] += len(one.a)
    return bool((own >= np.maximum(least_share * all_own, least)).all()) and least_joined(photos, explained, rays) >= least_share


def least_joined(photos: int, explained: Mapping[tuple[int, int], int], rays: Mapping[tuple[int, int], Rays]) -> float:
    """Of the matches between two groups of photos the share that is explained, the least over the groups that one edge parts of
    the tree along which most are."""
    fitting = [pair for pair, one in rays.items() if one.fits]
    if not fitting:
        return 1.0
    ends = np.array(fitting)
    met, every = (np.array(counts) for counts in zip(*((explained.get(p, 0), len(rays[p].a)) for p in fitting), strict=True))
    joined = coo_array((1.0 / met[met > 0], ends[met > 0].T), shape=(photos, photos))
    tree = minimum_spanning_tree(joined.tocsr()).tocoo()
    shares = [1.0]
    for edge in range(tree.nnz):
        rest = np.arange(tree.nnz) != edge
        whole = coo_array((tree.data[rest], (tree.row[rest], tree.col[rest])), shape=(photos, photos))
        _, side = connected_components(whole, directed=False)
        between = (np.sort(side[ends], 1) == np.sort(side[[tree.row[edge], tree.col[edge]]])).all(1)
        shares.append(float(met[between].sum() / every[between].sum()))
    return min(shares)
