"""Directions of the camera along which photos scatter more than their chains explain.

One factor for all directions hides what photos have in common along one of them, such as a centre that image stabilisation moves,
or panoramas that were stitched anew each time. With V the covariance of the sum of all scores by independent chains, and the
scores g_p of n photos about their mean, the eigenvalues of

    V^-1 n / (n - 1) sum_p g_p g_p'

are those of a Wishart matrix of n - 1 degrees of freedom over n - 1. Chance leaves the largest of q below a known limit
(I. M. Johnstone, 2001; the law of Tracy and Widom as M. Chiani, 2014, has it). One beyond is of a direction that stands out; what
chance adds to such a one is taken off (J. Baik and J. W. Silverstein, 2006). Photos that say little count little: n is the
number of photos of equal shares that would scatter as much.
"""

import math

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

CHANCE = 0.01
"""With which a direction seems to stand out where chains err independently."""
TRACY_WIDOM = (46.446, 0.186054, 9.84801)
"""Shape and scale of the gamma distribution, less this, that is the law of the largest eigenvalue to a thousandth."""


def raised_along(
    of_chains: Float[Tensor, "q q"], by_photo: Float[Tensor, "v q"], shares: Float[Tensor, " v"], least_share: float
) -> Float[Tensor, "q q"]:
    """`of_chains`, V, times the factor by which photos scatter more over all directions; along those that stand out by as much as
    photos do. `by_photo` are the scores, `shares` what each photo says, in any unit; photos without a share say nothing. Along
    eigenvalues of the scaled V below `least_share` nothing is seen."""
    seen = shares > 0
    photos, shares = by_photo[seen], shares[seen]
    if len(photos) < 2 or not of_chains.any():
        return of_chains
    unit = torch.where(of_chains.diagonal() > 0, of_chains.diagonal().clamp_min(1e-300).rsqrt(), 0.0)
    size, axis = torch.linalg.eigh(of_chains * unit[:, None] * unit)
    known = size > least_share * size[-1]
    # Columns in which V is the identity.
    white = unit[:, None] * axis[:, known] / size[known].sqrt()
    off = (photos - photos.mean(0)) @ white
    count = len(photos)
    values, along = torch.linalg.eigh(off.mT @ off * count / (count - 1))
    equal = float(shares.sum().square() / shares.square().sum())
    factor = max(1.0, float(values.mean()))
    raised = of_chains * factor
    for k in range(len(values) - 1, 0, -1):
        rest = max(1.0, float(values[:k].mean()))
        variance = rest * _without_chance(float(values[k]) / rest, len(values), equal - 1.0)
        if variance <= factor:
            break
        moved = of_chains @ white @ along[:, k]
        raised = raised + (variance - factor) * moved[:, None] * moved
    return raised


def _without_chance(value: float, size: int, freedom: float) -> float:
    """Variance, in units of that of the other directions, of the one of the largest eigenvalue; 1 where chance makes so much."""
    if freedom <= 1.0:
        return 1.0
    roots = math.sqrt(freedom - 1.0), math.sqrt(size)
    spread = sum(roots) * (1.0 / roots[0] + 1.0 / roots[1]) ** (1.0 / 3.0)
    shape, scale, less = TRACY_WIDOM
    limit = sum(roots) ** 2 + spread * (float(stats.gamma.isf(CHANCE, shape, scale=scale)) - less)
    if value * freedom <= limit:
        return 1.0
    share = size / freedom
    half = 0.5 * (value + 1.0 - share)
    return half + math.sqrt(max(half * half - value, 0.0))
