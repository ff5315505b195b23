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
from omnilines.posing.kernels.match import best_near
from omnilines.posing.options import MatchOptions

WORDS, SAMPLED = 256, 20_000
"""Words that descriptors are told by, and descriptors that these are found from."""
_BEHIND = -2.0


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
    good = good[alike[:, column[good]].argmax(0) == good]
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
    towards = b_from_a.translation.numpy() / max(float(b_from_a.translation.norm()), 1e-300)
    normal = np.cross(far, towards)
    sine = np.sqrt(np.square(normal).sum(-1))
    normal /= np.maximum(sine, 1e-12)[:, None]
    whole = np.arctan2(sine, np.einsum("nk,k->n", far, towards))
    single = (np.ascontiguousarray(array, dtype=np.float32) for array in (far, normal, whole, b.bearings.numpy().T))
    own, other = (a.descriptors.numpy(), a.lengths), (b.descriptors.numpy(), b.lengths)
    best, first, second, back = best_near(*own, *other, *single, tolerance_rad, options.guided_cosine)
    row = np.flatnonzero((best >= 0) & _clear(first, second, options.guided_ratio))
    row = row[back[best[row]] == row]
    return torch.as_tensor(np.stack([row, best[row]], 1))


def _clear(first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], ratio: float) -> Bool[np.ndarray, " n"]:
    """Whether the best is clearly better than the second best, by the distances of unit vectors."""
    answer: Bool[np.ndarray, " n"] = np.maximum(1.0 - first, 0.0) < ratio**2 * np.maximum(1.0 - second, 0.0)
    return answer
