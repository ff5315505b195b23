"""In which of the equivalent frames a solution that leaves a gauge open is said to be uncertain.

Of all steps dk that differ by what the residuals do not see, B g, a covariance tells the spread of one. Held by B' dk = 0, a
block that is hardly known counts as much as all others, and takes the whole frame along. With the information A of each block,
what is left open is held by

    B' A dk = 0, which makes (dk - B g)' A (dk - B g) least,

so that a block counts by what is known of it, in whatever units. Shapes are the same in either frame.
"""

import numpy as np
from jaxtyping import Float

LEAST_TOLD = 1e-14
"""Of B'A B scaled to a unit diagonal: below it is rounding."""


def weighed(gauge: Float[np.ndarray, "n g"], information: Float[np.ndarray, "b d d"]) -> Float[np.ndarray, "n g"]:
    """C = A B (B'A B)^-1 for the blocks A of the kept parameters: C' dk is how much of the gauge is in a step. NaN where no block
    tells."""
    count, dim = information.shape[:2]
    by_block = gauge.reshape(count, dim, gauge.shape[1])
    found = np.einsum("bij,bjg->big", information, by_block).reshape(gauge.shape)
    inner = np.einsum("ng,nh->gh", gauge, found)
    if not np.isfinite(inner).all():
        return np.full_like(gauge, np.nan)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(inner), 1e-300))
    values, vectors = np.linalg.eigh(inner * scale[:, None] * scale)
    if not (values > LEAST_TOLD).all():
        return np.full_like(gauge, np.nan)
    return np.einsum("ng,gh->nh", found * scale, (vectors / values) @ vectors.T * scale)
