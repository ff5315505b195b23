"""The variance of unit weight: by what the covariance for residuals of unit variance is multiplied, and how well that is known.

Where the noise of the observations is stated and the residuals do not contradict it, the factor is the stated one and intervals
are those of the normal distribution. Where it is not stated, or the chi-square test of the residuals fails, the factor is that of
the residuals, s^2 = squares / freedom, and intervals are those of Student's t. A robust loss has a factor of its own (P. J.
Huber, Robust Statistics, 1981, section 7.6).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from omnilines.least_squares.losses import Loss

DOUBT = 0.01
"""Residuals as large as those found have a smaller chance than this where the noise is as stated: then it is not."""


@dataclass(frozen=True)
class VarianceFactor:
    """The factor of a covariance, and the degrees of freedom that it rests on."""

    value: float
    freedom: float
    """Of Student's t; infinite where the factor was stated and holds."""
    ratio: float | None = None
    """Standard deviation of the residuals over the stated one; None where none was stated."""

    @property
    def holds(self) -> bool:
        """Whether a stated noise was used as it is."""
        return self.ratio is not None and math.isinf(self.freedom)

    def sigmas(self, share: float = 0.95) -> float:
        """How many standard deviations on either side of an estimate hold the truth in this share of cases."""
        if math.isinf(self.freedom):
            return float(stats.norm.ppf(0.5 + 0.5 * share))
        return float(stats.t.ppf(0.5 + 0.5 * share, self.freedom))


def variance_factor(squares: float, freedom: int, stated: float | None = None) -> VarianceFactor:
    """Of a sum of squared residuals with so many degrees of freedom, and the variance of a residual where it is `stated`.

    Residuals larger than stated have their own variance (chi-square test at DOUBT); smaller ones do not shrink what is stated:
    errors that neighbours share do not show in residuals. Without a degree of freedom the stated variance is all there is, and
    the factor is NaN where there is none.
    """
    if freedom <= 0:
        return VarianceFactor(math.nan, 0.0) if stated is None else VarianceFactor(stated, math.inf, math.nan)
    found = squares / freedom
    if stated is None:
        return VarianceFactor(found, float(freedom))
    ratio = math.sqrt(found / stated)
    if stats.chi2.sf(squares / stated, freedom) < DOUBT:
        return VarianceFactor(found, float(freedom), ratio)
    return VarianceFactor(stated, math.inf, ratio)


def robust_variance(squared: Float[Tensor, " n"], loss: Loss, components: int, unknowns: int) -> float:
    """The factor for the inverse of J' W J, W the weights of a robust loss at the solution, from the squared norms of n residuals
    of some `components` each and the number of unknowns:

        k^2  sum w^2 s / (n m - p)  mean(w) / b^2,   b = mean(w + 2 s w' / m),   k = 1 + p / (n m)  var(w + 2 s w' / m) / b^2

    With the loss "none" it is the sum of squares over the degrees of freedom. Needs more residuals than unknowns.
    """
    s = squared.detach().clone().requires_grad_()
    with torch.enable_grad():
        weight = loss(s)[1]
        bend = torch.autograd.grad(weight.sum(), s)[0] if weight.requires_grad else torch.zeros_like(s)
    weight, s = weight.detach(), s.detach()
    slope = weight + 2 / components * s * bend
    total, mean = components * len(s), float(slope.mean())
    correction = 1 + unknowns / total * float(slope.var(correction=0)) / mean**2
    spread = float((weight**2 * s).sum()) / (total - unknowns)
    return correction**2 * spread * float(weight.mean()) / mean**2
