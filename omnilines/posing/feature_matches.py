"""Matches of features of two photos by their descriptors, with and without the relative pose, and which photos to compare.

A match is the best of either photo for the other, and clearly better than the second best (D. Lowe, IJCV 2004). With the relative
pose known only features near the epipolar half circle count, so that fewer are in competition and fainter ones are matched.
"""

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.posing.features import Features

RATIO, FAINT_RATIO, GUIDED_RATIO = 0.8, 0.9, 0.85
"""Of the distances of the best and the second best descriptor."""
GUIDED_DISTANCE = 0.9
"""Distance of descriptors (unit vectors) from which two features are no candidates for a guided match."""
LEAST_ALIKE = 1.0 - 0.5 * GUIDED_DISTANCE**2
MOST_EXHAUSTIVE = 60
"""Photos up to which each is compared with every other; of more, each with those that look most alike."""
NEIGHBOURS, WORDS, SAMPLED = 30, 256, 20_000
_BEHIND = -2.0


def pairs_to_compare(features: Sequence[Features], seed: int) -> list[tuple[int, int]]:
    """Pairs (i < j) of photos worth comparing: all, or of many photos for each its NEIGHBOURS most alike, by the frequencies of
    descriptors' words (J. Sivic, A. Zisserman, Video Google, ICCV 2003)."""
    count = len(features)
    if count <= MOST_EXHAUSTIVE:
        return list(itertools.combinations(range(count), 2))
    alike = _alikeness(features, seed)
    alike.fill_diagonal_(-1.0)
    nearest = alike.topk(NEIGHBOURS, dim=1).indices
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


def matched(a: Features, b: Features) -> tuple[Int[Tensor, "k 2"], Int[Tensor, "l 2"]]:
    """Rows of matching features of two photos: those that are clear (RATIO), and also those less so (FAINT_RATIO)."""
    if len(a) < 2 or len(b) < 2:
        return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, 2, dtype=torch.long)
    alike = (a.unit_descriptors() @ b.unit_descriptors().mT).numpy()
    row = np.arange(len(alike))
    column = alike.argmax(1)
    first = alike[row, column]
    alike[row, column] = _BEHIND
    second = alike.max(1)
    alike[row, column] = first
    good = np.flatnonzero(_clear(first, second, FAINT_RATIO))
    good = good[alike[:, column[good]].argmax(0) == good]
    pairs = torch.as_tensor(np.stack([good, column[good]], 1))
    return pairs[torch.as_tensor(_clear(first[good], second[good], RATIO))], pairs


def matched_near(a: Features, b: Features, b_from_a: Pose, tolerance_rad: float) -> Int[Tensor, "k 2"]:
    """The same, of features whose rays meet before both cameras to within an angle."""
    if not len(a) or not len(b):
        return torch.zeros(0, 2, dtype=torch.long)
    alike = (a.unit_descriptors() @ b.unit_descriptors().mT).numpy()
    row, column = _near(a, b, b_from_a, tolerance_rad, alike > LEAST_ALIKE)
    found = alike[row.numpy(), column.numpy()]
    best, clear = _best_of(row.numpy(), found)
    good = best[clear]
    # The same candidates by column: a match is the best of both.
    good = good[np.isin(good, _best_of(column.numpy(), found)[0])]
    return torch.stack([row[good], column[good]], 1)


def _clear(first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], ratio: float) -> Bool[np.ndarray, " n"]:
    """Whether the best is clearly better than the second best, by the distances of unit vectors."""
    answer: Bool[np.ndarray, " n"] = np.maximum(1.0 - first, 0.0) < ratio**2 * np.maximum(1.0 - second, 0.0)
    return answer


def _best_of(
    owner: Int[np.ndarray, " k"], alike: Float32[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """The best candidate of every owner, and whether it is clearly better than the second best, or than what is no candidate."""
    order = np.lexsort((-alike, owner))
    sorted_owner = owner[order]
    fresh = np.ones(len(order), dtype=bool)
    fresh[1:] = sorted_owner[1:] != sorted_owner[:-1]
    at = np.flatnonzero(fresh)
    following = np.minimum(at + 1, len(order) - 1)
    other = (sorted_owner[following] == sorted_owner[at]) & (following > at)
    second = np.where(other, alike[order[following]], np.float32(LEAST_ALIKE))
    return order[at], _clear(alike[order[at]], second, GUIDED_RATIO)


def _near(
    a: Features, b: Features, b_from_a: Pose, tolerance_rad: float, candidates: Bool[np.ndarray, "n m"]
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Rows of a and of b that are candidates, that of b on the half circle from the direction of a's at infinity to the place of
    camera a."""
    far = a.bearings @ b_from_a.rotation.mT
    towards = b_from_a.translation / b_from_a.translation.norm().clamp_min(1e-300)
    normal = torch.linalg.cross(far, towards.expand_as(far))
    sine = normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normal = normal / sine
    off = normal.to(torch.float32).numpy() @ b.bearings.to(torch.float32).numpy().T
    np.abs(off, out=off)
    # One index and not two: much faster than nonzero of a table.
    row, column = (torch.as_tensor(index) for index in np.divmod(np.flatnonzero((off < tolerance_rad) & candidates), len(b)))
    # Along the circle, from `far` at angle 0 to `towards` at the angle between the two.
    ahead = torch.linalg.cross(normal, far)[row]
    angle = torch.atan2((ahead * b.bearings[column]).sum(-1), (far[row] * b.bearings[column]).sum(-1))
    whole = torch.atan2(sine[:, 0], far @ towards)[row]
    between = (angle > -tolerance_rad) & (angle < whole + tolerance_rad)
    return row[between], column[between]
