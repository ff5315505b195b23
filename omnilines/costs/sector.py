"""The sector cost (Srestasathiern 2012, 4.9 to 4.17; design section 5).

    g(M) = M' D M / (M' M)

is the integral, over the boundary of the sector between camera centre and observed arc, of the squared distance to the projection
plane of the line, whose normal is M. With D = F'F the residual is r = F M / |M|, r'r = g: nothing is singular at g = 0.
"""

from jaxtyping import Float
from torch import Tensor

from camera_models._arrays import array_function
from omnilines.costs._cost import Cost, ScaledRows
from omnilines.geometry.sphere import sector_moment_factor


@array_function
def prepare(v1: Float[Tensor, "*batch 3"], v2: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """F of each observed arc from its end bearings (unit, camera frame); phi below pi."""
    return sector_moment_factor(v1, v2)


@array_function
def residual(factor: Float[Tensor, "*batch 2 3"], normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """r = F M / |M|; M (camera frame) of any length above zero."""
    return (factor @ (normal / normal.norm(dim=-1, keepdim=True))[..., None]).squeeze(-1)


@array_function
def jacobian(factor: Float[Tensor, "*batch 2 3"], normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """d r / d M = (F - r Mh') / |M| with Mh = M / |M|."""
    length = normal.norm(dim=-1, keepdim=True)
    unit = normal / length
    r = (factor @ unit[..., None]).squeeze(-1)
    return (factor - r[..., :, None] * unit[..., None, :]) / length[..., None]


def rows(bearings: Float[Tensor, "n 2 3"]) -> Float[Tensor, "n 2 3"]:
    """F of each arc; residuals are in radians to the power of 3/2."""
    return prepare(bearings[:, 0], bearings[:, 1])


COST = Cost.of_rows(ScaledRows(rows))
