"""How far lines pass what they may meet (another line at a corner, a plane that others lie in), and what a line learns from it.

A gap g was measured with the variance v. With the standard deviations t_c that gaps may have,

    p(g) = sum_c a_c N(g; 0, v + t_c^2),    sum_c a_c = 1,

and the shares a_c are found from the gaps of the scene's own lines by expectation maximisation; one further gap, that may be any,
is counted along, so that few gaps say little.

What a gap says of a line is a Kalman update of its four parameters for each of the t_c, joined by their probabilities w_c; the
covariance holds how much they differ. With P the covariance of the line, h the derivative of its gaps by it, and s_c = h'Ph + r_c
+ t_c^2, r_c the variance of what the gap g_c is measured to,

    step = -P h sum_c w_c g_c / s_c,    P - P h h'P (sum_c w_c / s_c - sum_c w_c (g_c / s_c)^2 + (sum_c w_c g_c / s_c)^2),

the mean and the covariance of the mixture (assumed density filtering: Minka, Expectation propagation for approximate Bayesian
inference, UAI 2001).
"""

import numpy as np
from jaxtyping import Float, Int

ROUNDS = 200
TINY = 1e-300


def log_density(gap_m: Float[np.ndarray, "*gaps"], variance_m2: Float[np.ndarray, "*gaps c"]) -> Float[np.ndarray, "*gaps c"]:
    """log N(g; 0, s) of each gap and each of its variances, but for a constant."""
    density: Float[np.ndarray, "*gaps c"] = -0.5 * (np.square(gap_m)[..., None] / variance_m2 + np.log(variance_m2))
    return density


def likely_shares(likelihood: Float[np.ndarray, "k c"], group: Int[np.ndarray, " k"]) -> Float[np.ndarray, "g c"]:
    """The shares, in each group, under which the gaps are most likely; `likelihood` of each gap is known but for a factor."""
    count = likelihood.shape[1]
    share = np.full((int(group.max(initial=-1)) + 1, count), 1.0 / count)
    # Cells of the table, first all of them for the further gap.
    cell = np.concatenate([np.arange(share.size), (group[:, None] * count + np.arange(count)).ravel()])
    weight = np.full(len(cell), 1.0 / count)
    for _ in range(ROUNDS):
        part = share[group] * likelihood
        weight[share.size :] = (part / np.maximum(part.sum(-1, keepdims=True), TINY)).ravel()
        total = np.bincount(cell, weight).reshape(share.shape)
        share = total / total.sum(-1, keepdims=True)
    return share


def learned(
    covariance: Float[np.ndarray, "k 4 4"],
    by_line: Float[np.ndarray, "k 4"],
    gap_m: Float[np.ndarray, "k c"],
    spread_m2: Float[np.ndarray, "k c"],
    weight: Float[np.ndarray, "k c"],
) -> tuple[Float[np.ndarray, "k 4"], Float[np.ndarray, "k 4 4"]]:
    """The steps of lines and the covariances after them; `spread_m2` are s_c, and the weights of each line add up to 1."""
    moved = (covariance @ by_line[..., None])[..., 0]
    pull = gap_m / spread_m2
    mean = (weight * pull).sum(-1)
    told = (weight / spread_m2).sum(-1) - (weight * pull**2).sum(-1) + mean**2
    return -moved * mean[:, None], covariance - told[:, None, None] * moved[:, :, None] * moved[:, None, :]
