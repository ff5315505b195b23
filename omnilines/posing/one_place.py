"""Photos that were taken from one place: a turn of the camera alone explains what they have in common, so nothing has a depth."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from camera_models.rotations import nearest_rotation
from omnilines.posing.features import Features
from omnilines.posing.options import PosingOptions

TURNS = 100
"""Tried of a pair of photos: where half of the matches are right, one of 1e12 pairs has none that both matches agree with."""


def at_one_place(
    features: Sequence[Features],
    matches: Mapping[tuple[int, int], Int[Tensor, "_ 2"]],
    seed: int = 0,
    options: PosingOptions = PosingOptions(),
) -> list[int]:
    """The largest group of photos, by number, each of which is joined to another by a turn alone: that explains most of the
    matches of the two, and as many as a pair needs to be verified. It has to explain most matches of the whole group too: small
    steps in a row lead elsewhere. A match agrees as near as with any geometry of a pair. Empty where there is no such group."""
    limit = options.mapper.epipolar_px / options.features.sigma_px
    pairs, total = np.array(list(matches)).reshape(-1, 2), np.array([len(rows) for rows in matches.values()])
    agree = np.zeros(len(pairs))
    for k, ((i, j), rows) in enumerate(matches.items()):
        a, b = features[i], features[j]
        sigma = torch.maximum(a.sigma_rad[rows[:, 0]], b.sigma_rad[rows[:, 1]])
        agree[k] = by_a_turn(a.bearings[rows[:, 0]], b.bearings[rows[:, 1]], limit * sigma, seed).sum()
    turned = (2 * agree > total) & (agree >= options.mapper.min_pair_inliers)
    if not turned.any():
        return []
    joined = coo_array((turned[turned], pairs[turned].T), shape=(len(features), len(features)))
    group = connected_components(joined, directed=False)[1]
    here = group == np.bincount(group).argmax()
    within = here[pairs].all(1)
    return np.flatnonzero(here).tolist() if 2 * agree[within].sum() > total[within].sum() else []


def by_a_turn(a: Float[Tensor, "m 3"], b: Float[Tensor, "m 3"], within_rad: Float[Tensor, " m"], seed: int) -> Bool[Tensor, " m"]:
    """Which bearings of a second photo are those of a first, but for a turn that as many as possible agree with."""
    if len(a) < 2:
        return torch.zeros(len(a), dtype=torch.bool)
    generator = torch.Generator().manual_seed(seed)
    two = torch.rand(TURNS, len(a), generator=generator).topk(2, dim=1).indices
    best = max((_agreeing(turn, a, b, within_rad) for turn in nearest_rotation(_correlation(a[two], b[two]))), key=_count)
    refined = _agreeing(nearest_rotation(_correlation(a[best], b[best])), a, b, within_rad)
    return max(best, refined, key=_count)


def _correlation(a: Float[Tensor, "*batch k 3"], b: Float[Tensor, "*batch k 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The turn from a to b is the rotation nearest to it."""
    return b.mT @ a


def _agreeing(
    b_from_a: Float[Tensor, "3 3"], a: Float[Tensor, "m 3"], b: Float[Tensor, "m 3"], within_rad: Float[Tensor, " m"]
) -> Bool[Tensor, " m"]:
    return (a @ b_from_a.mT - b).norm(dim=-1) <= within_rad


def _count(agree: Bool[Tensor, " m"]) -> int:
    return int(agree.sum())
