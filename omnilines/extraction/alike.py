"""How far the places of an edge are alike along it: the variance of their mean over that of the mean of independent ones.

JPEG, HEIC and videos keep brightness (luma) at every pixel, and what is left of the colours (chroma) mostly at a quarter of them,
quantised in blocks twice as wide; lenses shift colours against each other. What chroma says of the place of an edge is wrong by
nearly as much over many pixels. Residuals about the circle that was fitted through such places hide that: it goes where they go.
Where luma says where the edge is, the places that chroma alone would have are off that circle, and show it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_LEAST_PAIRS = 50
"""Residuals so many px apart, from which on their correlation is known."""
_LEAST_LUMA = 0.5
"""Share of luma in what tells the places of an arc, from which on it tells how far those of chroma are alike."""


class ChromaNoise(NamedTuple):
    """Of each arc, what `chroma_noise` says."""

    share: Float[np.ndarray, " n"]
    """Of chroma in what tells its places."""
    total: Float[np.ndarray, " n"]
    """Sum of what chroma adds to the residuals, px."""
    squares: Float[np.ndarray, " n"]
    every: Float[np.ndarray, " n"]
    """Sums of the squares of these parts, and of the residuals, px^2."""

    @property
    def noise_share(self) -> Float[np.ndarray, " n"]:
        """Of chroma in the squares of the residuals."""
        return np.minimum(self.squares / np.maximum(self.every, 1e-12), 1.0)


class ToldChroma(NamedTuple):
    """What arcs that luma places have told of how far places of chroma are alike."""

    total: float = 0.0
    arcs: float = 0.0
    """As many as that; those count less in whose residuals chroma has less of a share."""

    def with_more(self, noise: ChromaNoise) -> "ToldChroma":
        """And of further arcs. The mean over arcs of (sum of n residuals)^2 / (sum of their squares) is 1 where they are
        independent. The circle goes after chroma by its share: residuals about it lack that."""
        luma = 1.0 - noise.share
        weight = np.where(luma >= _LEAST_LUMA, noise.noise_share, 0.0)
        ratio = noise.total**2 / np.maximum(noise.squares * luma**2, 1e-12)
        return ToldChroma(self.total + float((weight * ratio).sum()), self.arcs + float(weight.sum()))


def correlation(products: Float[np.ndarray, "lags 2"]) -> float:
    """1 + 2 sum of the correlations of residuals 1, 2, ... px apart, over all arcs, from the sums of their products and the
    numbers of these."""
    mean, total = products[:, 0] / np.maximum(products[:, 1], 1.0), 1.0
    for lag in range(1, len(products)):
        if products[lag, 1] < _LEAST_PAIRS or mean[lag] <= 0.0:
            break
        total += 2.0 * float(mean[lag] / max(mean[0], 1e-12))
    return total


def correlations(noise: ChromaNoise, told: ToldChroma, every: float) -> Float[np.ndarray, " n"]:
    """Of each arc, between that of `every` residual and that of chroma, by the share of chroma in its own. `every` counts for
    that of chroma like one arc that tells it."""
    chroma = (every + told.total) / (1.0 + told.arcs)
    return every + noise.noise_share * max(chroma - every, 0.0)
