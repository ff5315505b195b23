"""Matches of features of two photos by their descriptors, with and without the relative pose, and which photos to compare.

A match is the best of either photo for the other, and clearly better than the second best (D. Lowe, IJCV 2004). With the relative
pose known only features near the epipolar half circle count, so that fewer are in competition and fainter ones are matched.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.features import Features
from omnilines.posing.kernels.match import best_near
from omnilines.posing.options import MatchOptions

WORDS, SAMPLED = 256, 20_000
"""Words that descriptors are told by, and descriptors that these are found from."""
_BEHIND = -2.0
SECTORS = 512
"""Of the turn about the direction of the other camera; a half circle is sought in a few of them."""


def pairs_to_compare(features: Sequence[Features], seed: int, options: MatchOptions = MatchOptions()) -> list[tuple[int, int]]:
    """Pairs (i < j) of photos worth comparing: all, or of many photos for each its neighbours most alike, by the frequencies of
    descriptors' words (J. Sivic, A. Zisserman, Video Google, ICCV 2003)."""
    count = len(features)
    if count <= options.max_exhaustive:
        return list(itertools.combinations(range(count), 2))
    alike = _alikeness(features, seed)
    alike.fill_diagonal_(-1.0)
    nearest = alike.topk(options.neighbours, dim=1).indices
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row})


def _alikeness(features: Sequence[Features], seed: int) -> Float[Tensor, "n n"]:
    """Cosine of the word frequencies of every two photos, words weighted by how rare they are."""
    rng = np.random.default_rng(seed)
    every = torch.cat([f.unit_descriptors() for f in features])
    sample = every[torch.as_tensor(rng.choice(len(every), min(SAMPLED, len(every)), replace=False))]
    words = sample[torch.as_tensor(rng.choice(len(sample), min(WORDS, len(sample)), replace=False))]
    for _ in range(5):
        nearest = (sample @ words.mT).argmax(1)
        total = torch.zeros_like(words).index_add_(0, nearest, sample)
        length = total.norm(dim=-1, keepdim=True)
        words = torch.where(length > 0, total / length.clamp_min(1e-12), words)
    counts = torch.stack([torch.bincount((f.unit_descriptors() @ words.mT).argmax(1), minlength=len(words)) for f in features])
    rare = torch.log(len(features) / (counts > 0).sum(0).clamp_min(1))
    weight = counts.to(torch.float64) / counts.sum(1, keepdim=True).clamp_min(1) * rare
    weight = weight / weight.norm(dim=1, keepdim=True).clamp_min(1e-12)
    return weight @ weight.mT


def matched(a: Features, b: Features, options: MatchOptions = MatchOptions()) -> tuple[Int[Tensor, "k 2"], Int[Tensor, "l 2"]]:
    """Rows of matching features of two photos: those that are clear, and also those less so."""
    if len(a) < 2 or len(b) < 2:
        return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, 2, dtype=torch.long)
    alike = (a.unit_descriptors() @ b.unit_descriptors().mT).numpy()
    row = np.arange(len(alike))
    column = alike.argmax(1)
    first = alike[row, column]
    alike[row, column] = _BEHIND
    second = alike.max(1)
    alike[row, column] = first
    good = np.flatnonzero(_clear(first, second, options.faint_ratio))
    good = good[first[good] == alike.max(0)[column[good]]]
    # Of rows that are alike to the last digit the first.
    good = good[np.sort(np.unique(column[good], return_index=True)[1])]
    pairs = torch.as_tensor(np.stack([good, column[good]], 1))
    return pairs[torch.as_tensor(_clear(first[good], second[good], options.clear_ratio))], pairs


def matched_near(
    a: Features, b: Features, b_from_a: Pose, tolerance_rad: float, options: MatchOptions = MatchOptions()
) -> Int[Tensor, "k 2"]:
    """The same, of features whose rays meet before both cameras to within an angle: that of b lies on the half circle from the
    direction of a's at infinity to the place of camera a."""
    if not len(a) or not len(b):
        return torch.zeros(0, 2, dtype=torch.long)
    # Not by BLAS, whose threads take longer to start than products so small.
    far = np.einsum("nk,ik->ni", a.bearings.numpy(), b_from_a.rotation.numpy())
    length = float(b_from_a.translation.norm())
    # Of cameras at one place only the direction at infinity counts, whichever way a circle goes through it.
    towards = b_from_a.translation.numpy() / length if length > 0 else np.array([0.0, 0.0, 1.0])
    normal = np.cross(far, towards)
    sine = np.sqrt(np.square(normal).sum(-1))
    normal /= np.maximum(sine, 1e-12)[:, None]
    whole = np.arctan2(sine, np.einsum("nk,k->n", far, towards)) if length > 0 else np.zeros(len(a))
    rings = _rings(b.bearings.numpy(), towards, tolerance_rad)
    single = (np.ascontiguousarray(array, dtype=np.float32) for array in (far, normal, whole))
    own, other = (a.descriptors.numpy(), a.lengths), (b.descriptors.numpy()[rings.order], b.lengths[rings.order])
    seen = np.ascontiguousarray(b.bearings.numpy()[rings.order], dtype=np.float32)
    best, first, second, back = best_near(
        *own, *other, *single, _sector(far, towards), seen, rings.start, rings.reach, tolerance_rad, options.guided_cosine
    )
    row = np.flatnonzero((best >= 0) & _clear(first, second, options.guided_ratio))
    row = row[back[best[row]] == row]
    return torch.as_tensor(np.stack([row, rings.order[best[row]]], 1))


class _Rings(NamedTuple):
    """Features in the order of rings about a direction, and of sectors in them."""

    order: Int[np.ndarray, " m"]
    start: Int[np.ndarray, "rings sectors+1"]
    """Where each sector of a ring begins in that order."""
    reach: Int[np.ndarray, " rings"]
    """Sectors beside its own that what is near a half circle from the direction may lie in."""


def _rings(bearings: Float[np.ndarray, "m 3"], towards: Float[np.ndarray, "3"], tolerance_rad: float) -> _Rings:
    """Each ring ends where the sine of the angle from the direction is half of where it began: what is near a half circle there
    is turned from it by an angle of sine <= tolerance / sine. In the last ring, about the direction or its opposite, all is."""
    count = max(0, math.floor(-math.log2(2.0 * tolerance_rad)))
    sine = np.sqrt(np.square(np.cross(bearings, towards)).sum(-1))
    ring = np.minimum(np.floor(-np.log2(np.clip(sine, 1e-12, 1.0))).astype(np.int64), count)
    place = ring * SECTORS + _sector(bearings, towards)
    starts = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=(count + 1) * SECTORS))])
    within = np.arange(SECTORS + 1) + SECTORS * np.arange(count + 1)[:, None]
    turned = np.arcsin(tolerance_rad * 2.0 ** np.arange(1, count + 1))
    # One more, for what rounding puts on the other side of a border.
    reach = np.append(np.ceil(turned * SECTORS / (2.0 * np.pi)).astype(np.int64) + 1, SECTORS)
    return _Rings(np.argsort(place, kind="stable"), starts[within], reach)


def _sector(bearings: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "3"]) -> Int[np.ndarray, " n"]:
    """Which of the equal sectors about a direction each bearing lies in."""
    # The axis that the direction is farthest from is one to count from.
    first = np.cross(towards, np.eye(3)[np.abs(towards).argmin()])
    x, y = bearings @ first, bearings @ np.cross(towards, first)
    turn = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
    return np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)


def _clear(first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], ratio: float) -> Bool[np.ndarray, " n"]:
    """Whether the best is clearly better than the second best, by the distances of unit vectors."""
    answer: Bool[np.ndarray, " n"] = np.maximum(1.0 - first, 0.0) < ratio**2 * np.maximum(1.0 - second, 0.0)
    return answer
