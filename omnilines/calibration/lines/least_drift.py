"""The least drift of the image that explains what lines say of a camera.

If the camera is off by e, its scores s have the mean -S e, with the information S, and the covariance V. So e is not contradicted
where (s + S e)' V^-1 (s + S e) is no larger than chance makes it. Of all these, one moves the image least: with the mean square
motion e' M e, (A + lambda M) e = -S V^-1 s with A = S V^-1 S, and lambda where the limit is reached (the trust region problem of
J. J. More and D. C. Sorensen, 1983). What is hardly seen takes no part in it, however uncertain it is.
"""

import math

import torch
from jaxtyping import Float
from scipy.optimize import brentq
from torch import Tensor

_NONE = 1e-12
"""Share of the largest eigenvalue below which nothing is seen, or nothing moves."""
_LOG_LAMBDA = 60.0
"""Either way, of the logarithm: beyond it lambda is 0 or infinite."""


def least_drift(
    score: Float[Tensor, " q"],
    precision: Float[Tensor, "q q"],
    information: Float[Tensor, "q q"],
    motion: Float[Tensor, "q q"],
    limit: float,
) -> float:
    """Root of the least e' M e, M = `motion`, with (s + S e)' V^-1 (s + S e) <= `limit`, V^-1 = `precision`; where no e is so
    good, that of the best."""
    pulled = information @ precision
    ratio, gradient, free = _alike(pulled @ information, motion, pulled @ score)
    whole = float(score @ precision @ score)

    def change(log_lambda: float) -> Float[Tensor, " q"]:
        """e, in the coordinates in which both squares are sums."""
        return -gradient / (ratio + math.exp(log_lambda) * free).clamp_min(_NONE)

    def above(log_lambda: float) -> float:
        """Of the limit."""
        e = change(log_lambda)
        return whole + float((2.0 * gradient * e + ratio * e.square()).sum()) - limit

    if whole <= limit or above(_LOG_LAMBDA) <= 0.0:
        return 0.0
    at = -_LOG_LAMBDA if above(-_LOG_LAMBDA) >= 0.0 else float(brentq(above, -_LOG_LAMBDA, _LOG_LAMBDA))
    return math.sqrt(max(float((free * change(at).square()).sum()), 0.0))


def _alike(
    seen: Float[Tensor, "q q"], motion: Float[Tensor, "q q"], gradient: Float[Tensor, " q"]
) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Diagonals of A and M, and the gradient, where both are diagonal: the coordinates of A over A + M, each by its trace."""
    by_seen, by_motion = seen.trace().clamp_min(1e-300), motion.trace().clamp_min(1e-300)
    values, vectors = torch.linalg.eigh(seen / by_seen + motion / by_motion)
    kept = values > _NONE * values[-1]
    to = vectors[:, kept] * values[kept].rsqrt()
    share, turned = torch.linalg.eigh(to.mT @ (seen / by_seen) @ to)
    share = share.clamp(0.0, 1.0)
    share, free = torch.where(share < _NONE, 0.0, share), torch.where(share > 1.0 - _NONE, 0.0, 1.0 - share)
    own = (to @ turned).mT @ gradient
    return by_seen * share, torch.where(share > 0, own, 0.0), by_motion * free
