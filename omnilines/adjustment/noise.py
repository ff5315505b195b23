"""The noise of the end points: whether what is stated of it holds, and what the residuals say where nothing is.

Without a loss the cost's own squared residuals have, for noise of unit level, the expectation sum tr(W) - tr(H^-1 K), which for
the whitened cost is the number of residuals less that of parameters. With a robust loss those of arcs are taken that do not stand
out.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.special import chdtrc, chdtri, fdtri
from torch import Tensor

from camera_models.repeatable import total
from omnilines.adjustment.options import AdjustmentOptions
from omnilines.least_squares.variance import NORMAL_MAD

COVERED = 0.95
"""Share of truths within the ellipsoids that few residuals leave room for."""
MOST_TURNS = 10
"""Times that the arcs that stand out and the noise of the others are found in turn."""


@dataclass(frozen=True)
class Noise:
    """Of the end points, in units of what is stated, or of 1 px."""

    measured: float
    """What the residuals say; NaN where nothing is left over."""
    redundancy: float
    """Degrees of freedom that it rests on."""
    stated: bool
    significance: float = AdjustmentOptions().significance
    """Probability of residuals as large, or as small, below which the stated noise does not hold."""

    @property
    def holds(self) -> bool:
        """Whether the residuals allow what is stated: they are not too large for it."""
        return self.stated and not (self.redundancy > 0 and self._larger < self.significance)

    @property
    def overstated(self) -> bool:
        """Whether the residuals are too small for what is stated."""
        return self.stated and self.redundancy > 0 and 1 - self._larger < self.significance

    @property
    def _larger(self) -> float:
        """The probability of larger residuals where what is stated holds (chi-square)."""
        return float(chdtrc(self.redundancy, self.redundancy * self.measured**2))

    @property
    def level(self) -> float:
        """What all uncertainty is stated for."""
        return 1.0 if self.holds else self.measured

    def widening(self, dim: int) -> float:
        """Factor on the covariance of `dim` coordinates: 1 where the noise is stated, else that which makes the usual ellipsoid
        of 95 percent hold although the noise is estimated, dim F(dim, redundancy) / chi^2(dim) at 95 percent."""
        if self.holds or not self.redundancy > 0:
            return 1.0
        return dim * float(fdtri(dim, self.redundancy, COVERED)) / float(chdtri(dim, 1 - COVERED))


def largest_square(significance: float) -> float:
    """Squared whitened residual of both ends of an arc that noise of unit variance exceeds with this probability."""
    return float(chdtri(2, significance))


def fitting(whitened: Float[Tensor, "n 2"], taken: float, least: float, significance: float) -> Bool[Tensor, " n"]:
    """Arcs whose residuals are not too large for the noise, `taken` parameters having been fitted.

    The variance is told by the median first, then by the arcs that are within, and is `least` squared at least. Good arcs
    vary by less than the noise, as they have decided the parameters, so that hardly any is cut off.
    """
    square = whitened.square().sum(-1)
    finite = torch.isfinite(square)
    left = 2 * int(finite.sum()) - taken
    if left <= 0:
        return finite
    variance = NORMAL_MAD**2 * float(whitened[finite].square().median()) * 2 * int(finite.sum()) / left
    within, limit = finite, largest_square(significance)
    for _ in range(MOST_TURNS):
        before, within = within, finite & (square <= limit * max(variance, least**2, 1e-24))
        left = 2 * int(within.sum()) - taken
        if left <= 0 or bool((before == within).all()):
            break
        variance = total(square[within]) / left
    return within
