"""Directions under which the arcs of one photo are most likely, from directions that are near.

With the ratio r_ik of arc i and direction k (`circles.py`) and the shares w_k of the directions, the arcs have the log likelihood

    L = sum_i log(w_0 + sum_k w_k r_ik),    w_0 + sum_k w_k = 1,

over that of arcs turned at random. Expectation maximisation: with h_ik = w_k r_ik / (w_0 + sum_j w_j r_ij), the probability that arc i
is of direction k, the shares are the means of h, and a rotation u of d changes n . d by u . (d x n), so that

    H_k u_k = -sum_i h_ik (n_i . d_k) (d_k x n_i) / s_ik^2,    H_k = sum_i h_ik (d_k x n_i)(d_k x n_i)' / s_ik^2,

for each direction, or one u for all of them from the sums over k where they are a frame. H^-1 is the covariance of u.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from omnilines.structure.circles import Circles

ROUNDS = 100
SETTLED_RAD = 1e-8
STRAYS = (0.5, 0.8, 1.0, 1.25, 2.0)
"""Times the last stray, tried in every round."""
LEAST_STRAY_RAD = 1e-6
FIRST_SHARES = 0.5
"""Of all directions together, before anything is known of them."""
OPEN_RAD = 1.0
"""Standard deviation of a rotation before anything is seen, so that one that nothing fixes is found so."""


@dataclass(frozen=True)
class Mixture:
    """k directions, and how likely each arc is of each."""

    direction: Float[np.ndarray, "k 3"]
    share: Float[np.ndarray, " k"]
    stray_rad: float
    turn_covariance: Float[np.ndarray, "k 3 3"]
    """Of the rotation vector of each direction (camera frame, from the left), or of their frame."""
    log_likelihood: float

    def belongs(self, circles: Circles) -> Float[np.ndarray, "n k"]:
        """Probability that each arc is of each direction."""
        return _probabilities(circles.ratio(self.direction, self.stray_rad), self.share)


def _probabilities(ratio: Float[np.ndarray, "k n"], share: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k"]:
    likely = share[:, None] * ratio
    return (likely / (1.0 - share.sum() + likely.sum(0))).T


def _log_likelihood(ratio: Float[np.ndarray, "k n"], share: Float[np.ndarray, " k"]) -> float:
    return float(np.log(1.0 - share.sum() + share @ ratio).sum())


def fitted(
    circles: Circles, direction: Float[np.ndarray, "k 3"], stray_rad: float, max_stray_rad: float, as_frame: bool
) -> Mixture:
    """The most likely directions, shares and stray near given ones; `as_frame`: their angles to each other stay."""
    count = len(direction)
    share = np.full(count, FIRST_SHARES / count)
    ratio = circles.ratio(direction, stray_rad)
    for _ in range(ROUNDS):
        h = _probabilities(ratio, share)
        share = np.minimum(h.mean(0), (1.0 - 1.0 / len(circles)) * h.mean(0) / max(h.mean(0).sum(), 1e-300))
        turn, _ = _step(circles, direction, h, stray_rad, as_frame)
        direction = direction + np.cross(turn, direction)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        if as_frame:
            direction = _orthogonal(direction)
        tried = [min(max(times * stray_rad, LEAST_STRAY_RAD), max_stray_rad) for times in STRAYS]
        ratios = [circles.ratio(direction, one) for one in tried]
        best = int(np.argmax([_log_likelihood(one, share) for one in ratios]))
        settled = tried[best] == stray_rad and float(np.abs(turn).max()) < SETTLED_RAD
        stray_rad, ratio = tried[best], ratios[best]
        if settled:
            break
    h = _probabilities(ratio, share)
    _, covariance = _step(circles, direction, h, stray_rad, as_frame)
    return Mixture(direction, share, stray_rad, covariance, _log_likelihood(ratio, share))


def _step(
    circles: Circles, direction: Float[np.ndarray, "k 3"], h: Float[np.ndarray, "n k"], stray_rad: float, as_frame: bool
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Rotation vectors of the directions, and their covariances."""
    off, variance = circles.off(direction, stray_rad)
    weight = h.T / variance
    lever = np.cross(direction[:, None], circles.normal)
    gradient = np.einsum("kn,kni->ki", weight * off, lever)
    hessian = np.einsum("kn,kni,knj->kij", weight, lever, lever)
    if as_frame:
        gradient, hessian = gradient.sum(0, keepdims=True), hessian.sum(0, keepdims=True)
    covariance = np.linalg.inv(hessian + np.eye(3) / OPEN_RAD**2)
    turn = -np.einsum("kij,kj->ki", covariance, gradient)
    return np.broadcast_to(turn, direction.shape), np.broadcast_to(covariance, (len(direction), 3, 3))


def _orthogonal(direction: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The frame nearest to three directions that are about at right angles."""
    u, _, v = np.linalg.svd(direction)
    nearest: Float[np.ndarray, "3 3"] = u @ v
    return nearest
