"""In which of the equivalent frames a solution that leaves a gauge open is said to be uncertain.

Of all steps dk that differ by what the residuals do not see, B g, a covariance tells the spread of one. Held by B' dk = 0, a
block that is hardly known counts as much as all others, and takes the whole frame along. With the information A of each block,
what is left open is held by

    B' A dk = 0, which makes (dk - B g)' A (dk - B g) least,

so that a block counts by what is known of it, in whatever units. Shapes are the same in either frame.
"""

import numpy as np
from jaxtyping import Float

from omnilines.least_squares.dense import LEAST_EIGENVALUE

LEAST_TOLD = 1e-14
"""Of B'A B scaled to a unit diagonal: below it is rounding."""


def pose_weights(information: Float[np.ndarray, "b 6 6"], distance_m: float) -> Float[np.ndarray, "b 6 6"]:
    """How much each pose counts, from the information U of its left perturbation while what it sees stays: 1 / tr U^-1, turns in
    radians and shifts over the distance of what is seen, alike for all turns and shifts; nothing where U does not tell the pose.

    Poses that are known equally well count alike, as they do where somebody compares camera centres.
    """
    unit = np.repeat([1.0, distance_m if distance_m > 0 else 1.0], 3)
    finite = np.isfinite(information).all((1, 2))
    values = np.linalg.eigvalsh(unit[:, None] * np.where(finite[:, None, None], information, 0.0) * unit)
    told = values[:, 0] > LEAST_EIGENVALUE * values[:, -1]
    trace = np.divide(1.0, values, out=np.zeros_like(values), where=told[:, None]).sum(-1)
    weight = np.divide(1.0, trace, out=np.zeros_like(trace), where=told)
    return weight[:, None, None] * np.diag(unit**-2)


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
