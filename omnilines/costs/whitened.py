"""The whitened cost (design section 5): distances of both arc ends from the projection plane, each over its standard deviation.

    r_i = (V_i . Mh) / sigma_i,  sigma_i^2 = Mh' J_i Sigma_i J_i' Mh

with J_i = d V_i / d pixel and Sigma_i the pixel covariance of end i. It is what whitening the sector residual gives, since the
sector's factor F cancels, and it attains the Cramer-Rao bound. The derivative includes that of sigma_i, so that the minimum is
that of the sum of squares itself.
"""

from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import array_function
from omnilines.costs._cost import CostFunction, ObservedArcs, scaled_distance


@array_function
def end_sigmas(
    by_pixel: Float[Tensor, "*batch 2 3 2"],
    covariance_px2: Float[Tensor, "*batch 2 2 2"],
    normal: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 2"]:
    """Standard deviation (rad) of both ends of each arc across the plane with normal M (camera frame, any length)."""
    unit = (normal / normal.norm(dim=-1, keepdim=True))[..., None, :, None]
    across = by_pixel.mT @ unit
    return (across.mT @ covariance_px2 @ across)[..., 0, 0].sqrt()


def of_arcs(arcs: ObservedArcs) -> CostFunction:
    """The cost of observed arcs, two residuals each, in standard deviations."""
    spread = arcs.by_pixel @ arcs.covariance_px2 @ arcs.by_pixel.mT

    def evaluate(bearings: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
        return scaled_distance(bearings, spread, normal)

    return evaluate
