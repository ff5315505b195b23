"""The variance of unit weight: by what the covariance for residuals of unit variance is multiplied, and how well that is known.

Where the noise of the observations is stated and the residuals do not contradict it, the factor is the stated one and intervals
are those of the normal distribution. Where it is not stated, or the chi-square test of the residuals fails, the factor is that of
the residuals, s^2 = squares / freedom, and intervals are those of Student's t. Where photos contradict each other by more than
that, it is the mean square between them.
"""

import math
from dataclasses import dataclass

from scipy import stats

from omnilines.least_squares.groups import Groups

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


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


@dataclass(frozen=True)
class Contradiction:
    """Groups of observations that differ by more than their noise explains."""

    factor: VarianceFactor
    """The mean square between groups, with as many degrees of freedom as there are groups less one."""
    ratio: float
    """Its root over that of the variance within groups."""


def contradiction(
    within: VarianceFactor, squares: float, freedom: int, groups: Groups, significance: float
) -> Contradiction | None:
    """Of groups whose mean square is larger than the noise explains, at this `significance`; None where it is not.

    `squares` are the sum of all squared residuals with so many degrees of freedom, `within` what was made of them. The noise is
    the stated one where that holds (chi-square test), else that of the residuals within groups (F test).
    """
    between, count = groups.between
    rest = freedom - count
    if count <= 0 or (rest <= 0 and not within.holds):
        return None
    mean = between / count
    inside = within.value if within.holds else (squares - between) / rest
    if within.holds:
        chance = stats.chi2.sf(between / inside, count)
    else:
        chance = stats.f.sf(mean / max(inside, 1e-300), count, rest)
    if chance >= significance or mean <= within.value:
        return None
    factor = VarianceFactor(mean, float(len(groups.matrix) - 1), within.ratio)
    return Contradiction(factor, math.sqrt(mean / max(inside, 1e-300)))


def variance_factor(squares: float, freedom: int, stated: float | None, significance: float) -> VarianceFactor:
    """Of a sum of squared residuals with so many degrees of freedom, and the variance of a residual where it is `stated`.

    Residuals larger than stated have their own variance (chi-square test at this `significance`); smaller ones do not shrink what
    is stated: errors that neighbours share do not show in residuals. Without a degree of freedom the stated variance is all there
    is, and the factor is NaN where there is none.
    """
    if freedom <= 0:
        return VarianceFactor(math.nan, 0.0) if stated is None else VarianceFactor(stated, math.inf, math.nan)
    found = squares / freedom
    if stated is None:
        return VarianceFactor(found, float(freedom))
    ratio = math.sqrt(found / stated)
    if stats.chi2.sf(squares / stated, freedom) < significance:
        return VarianceFactor(found, float(freedom), ratio)
    return VarianceFactor(stated, math.inf, ratio)
