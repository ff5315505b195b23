"""The whitened cost (design section 5): distances of both arc ends from the projection plane, each over its standard deviation.

    r_i = (V_i . Mh) / sigma_i,  sigma_i^2 = Mh' J_i Sigma_i J_i' Mh

with J_i = d V_i / d pixel and Sigma_i the pixel covariance of end i. It is what whitening the sector residual gives, since the
sector's factor F cancels, and it attains the Cramer-Rao bound. The derivative includes that of sigma_i, so that the minimum is
that of the sum of squares itself.
"""

from jaxtyping import Float
from torch import Tensor

from omnilines.costs._cost import Cost, ScaledRows


def spread(by_pixel: Float[Tensor, "n 2 3 2"], covariance_px2: Float[Tensor, "n 2 2 2"]) -> Float[Tensor, "n 2 3 3"]:
    """J Sigma J' of both ends."""
    return by_pixel @ covariance_px2 @ by_pixel.mT


COST = Cost.of_rows(ScaledRows(spread=spread), "sigma")
