"""The whitened cost (design section 5): distances of both arc ends from the projection plane, each over its standard deviation.

    r_i = (V_i . Mh) / sigma_i,  sigma_i^2 = Mh' J_i Sigma_i J_i' Mh

with J_i = d V_i / d pixel and Sigma_i the pixel covariance of end i. It is what whitening the sector residual gives, since the
sector's factor F cancels, and it attains the Cramer-Rao bound. Mh is frozen at each linearisation.
"""

from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import array_function


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


@array_function
def prepare(
    bearings: Float[Tensor, "*batch 2 3"],
    by_pixel: Float[Tensor, "*batch 2 3 2"],
    covariance_px2: Float[Tensor, "*batch 2 2 2"],
    normal: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 2 3"]:
    """The rows V_i' / sigma_i, to be used like the sector's factor: r = rows Mh."""
    return bearings / end_sigmas(by_pixel, covariance_px2, normal)[..., None]
