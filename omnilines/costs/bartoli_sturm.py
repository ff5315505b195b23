"""The cost of Bartoli and Sturm on any camera (design section 5): orthogonal distances in pixels of both observed end points.

    h_i = (V_i . M) / |J_i' M|,   J_i = d V_i / d pixel

For a pinhole camera it agrees with the distance of the end points from the line's image (A. Bartoli, P. Sturm, CVIU 100(3), 2005)
to first order; where the noise is isotropic it is the whitened cost but for its unit.
"""

from jaxtyping import Float
from torch import Tensor

from omnilines.costs._cost import Cost, ScaledRows


def spread(by_pixel: Float[Tensor, "n 2 3 2"], covariance_px2: Float[Tensor, "n 2 2 2"]) -> Float[Tensor, "n 2 3 3"]:
    """J J' of both ends: |J' M|^2 = M' J J' M."""
    return by_pixel @ by_pixel.mT


COST = Cost.of_rows(ScaledRows(spread=spread), "px")
