"""The whitened cost (design section 5): distances of both arc ends from the projection plane, each over its standard deviation.

    r_i = (V_i . Mh) / sigma_i,  sigma_i^2 = Mh' J_i Sigma_i J_i' Mh

with J_i = d V_i / d pixel and Sigma_i the pixel covariance of end i. It is what whitening the sector residual gives, since the
sector's factor F cancels, and it attains the Cramer-Rao bound. The derivative includes that of sigma_i, so that the minimum is
that of the sum of squares itself.
"""

from torch import Tensor

from omnilines.costs._cost import CostFunction, ObservedArcs, scaled_distance


def of_arcs(arcs: ObservedArcs) -> CostFunction:
    """The cost of observed arcs, two residuals each, in standard deviations."""
    spread = arcs.by_pixel @ arcs.covariance_px2 @ arcs.by_pixel.mT

    def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        return scaled_distance(bearings, spread, normal)

    return evaluate
