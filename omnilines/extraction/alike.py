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
_MEDIAN = 0.4549
"""Of chi-square of one degree of freedom."""


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

    ratio: Float[np.ndarray, " m"] = np.zeros(0)
    """(Sum of n residuals)^2 / (sum of their squares): chi-square of one degree of freedom where they are independent, and so
    many times that where their mean has so many times the variance."""
    weight: Float[np.ndarray, " m"] = np.zeros(0)
    """The share of chroma in the squares of the residuals: arcs tell nothing of what they have no part of."""

    def with_more(self, noise: ChromaNoise) -> "ToldChroma":
        """And of further arcs. The circle goes after chroma by its share: residuals about it lack that."""
        luma = 1.0 - noise.share
        ratio = noise.total**2 / np.maximum(noise.squares * luma**2, 1e-12)
        weight = np.where(luma >= _LEAST_LUMA, noise.noise_share, 0.0)
        return ToldChroma(np.append(self.ratio, ratio), np.append(self.weight, weight))

    def correlation(self, every: float) -> float:
        """That of chroma, by the median, which edges beside an arc and false ones move least; at least that of `every` residual,
        which counts like one arc of it."""
        ratio, weight = np.append(self.ratio, every * _MEDIAN), np.append(self.weight, 1.0)
        order = np.argsort(ratio, kind="stable")
        below = np.cumsum(weight[order])
        return max(float(ratio[order[np.searchsorted(below, 0.5 * below[-1])]]) / _MEDIAN, every)


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
    """Of each arc, between that of `every` residual and that of chroma, by the share of chroma in its own."""
    return every + noise.noise_share * (told.correlation(every) - every)
