"""How much noise the arcs of each line show of their own, where lines differ in it.

Arcs of photos are not alike: those of near edges pull at each other, and some lines hold an arc of another edge. One noise for
all says too little of such lines and too much of the others, while the residuals of one line alone, which are few, tell its noise
badly. Hence both: the variances of the lines are taken to scatter as an inverse gamma distribution of d0 degrees of freedom about
s0^2, which all lines together tell, and of a line whose residuals have the variance s^2 with d degrees of freedom there remains

    (d0 s0^2 + d s^2) / (d0 + d),   with d0 + d degrees of freedom

(G. K. Smyth, Linear models and empirical Bayes methods, 2004). What refined poses leave uncertain is multiplied along with it.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import chdtri, digamma, fdtri, polygamma

from omnilines.adjustment.adjusted import Adjusted
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.noise import COVERED
from omnilines.costs import WHITENED, cost_function

LEAST_LINES = 10
"""Fewer do not tell how their variances scatter."""
LEAST_FREEDOM, MOST_FREEDOM = 1e-3, 1e4
"""Of the scatter; with more all lines have the same noise."""


def with_own_noise(found: Adjusted, arcs: MatchedArcs) -> Adjusted:
    """With the covariance of each line for its own noise; `arcs` are those of the adjustment, as the cameras see them."""
    whitened = cost_function(WHITENED, arcs)(arcs.bearings, found.state.normals(arcs))[0].detach()
    square = torch.zeros(arcs.tracks, dtype=torch.float64).index_add_(0, arcs.track, whitened.square().sum(-1)).numpy()
    freedom = (2.0 * torch.bincount(arcs.track, minlength=arcs.tracks) - 4.0).clamp_min(0.0).numpy()
    level, left = found.noise.level, found.noise.redundancy
    if not (math.isfinite(level) and level > 0.0 and left > 0.0 and freedom.any()):
        return found
    # Poses that were refined took some of it.
    factor = torch.as_tensor(line_factors(square, freedom * min(left / float(freedom.sum()), 1.0), level))
    return replace(found, line_covariance=factor[:, None, None] * found.line_covariance, line_factor=factor)


def line_factors(square: Float[np.ndarray, " t"], freedom: Float[np.ndarray, " t"], level: float) -> Float[np.ndarray, " t"]:
    """By what the covariance of each line, which is for noise of the standard deviation `level`, is to be multiplied, so that the
    usual ellipsoid of 95 percent holds for the noise of the line.

    `square` are sums of squared residuals with so many degrees of freedom, which may be none; 1 where lines do not tell.
    """
    tell = (freedom > 0.0) & (square > 0.0)
    if tell.sum() < LEAST_LINES:
        return np.ones(len(square))
    own, usual = scattered_variances(square[tell] / freedom[tell], freedom[tell])
    if math.isinf(own):
        return np.ones(len(square))
    total = own + freedom
    wider = 4.0 * fdtri(4, total, COVERED) / chdtri(4, 1.0 - COVERED)
    factor: Float[np.ndarray, " t"] = (own * usual + np.where(freedom > 0.0, square, 0.0)) / total * wider / level**2
    return factor


def scattered_variances(variance: Float[np.ndarray, " n"], freedom: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """(d0, s0^2) of lines whose residuals have these variances, above 0, with so many degrees of freedom each; d0 is infinite
    where they scatter no more than by chance.

    log s^2 has the mean log s0^2 + psi(d/2) - log(d/2) - psi(d0/2) + log(d0/2) and the variance psi'(d/2) + psi'(d0/2).
    """
    half = 0.5 * freedom
    of_usual = np.log(variance) - digamma(half) + np.log(half)
    beyond = float(of_usual.var(ddof=1) - polygamma(1, half).mean())
    least, most = 0.5 * LEAST_FREEDOM, 0.5 * MOST_FREEDOM
    if beyond <= float(polygamma(1, most)):
        return math.inf, math.exp(float(of_usual.mean()))
    own = brentq(lambda at: float(polygamma(1, at)) - beyond, least, most) if beyond < float(polygamma(1, least)) else least
    return 2.0 * own, math.exp(float(of_usual.mean() + digamma(own) - math.log(own)))
