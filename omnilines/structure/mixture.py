"""Directions under which the arcs of one photo are most likely, from directions that are near.

Lines stray from their common direction: with the shares a_c by the standard deviation t_c. With the ratio r_ick of arc i for
stray c and direction k (`circles.py`) and the shares w_k of the directions, the arcs have the log likelihood

    L = sum_i g_i log(w_0 + sum_k w_k sum_c a_c r_ick),    w_0 + sum_k w_k = 1,    sum_c a_c = 1,

over that of arcs turned at random. Shares of all strays lead to the directions; in the end one stray describes the lines, the
most likely one, as with all of them few arcs look sharper than they are. Fragments of one line stray together: their weights g
add up to 1. Expectation maximisation: h_ick, the probability that arc i is of direction k with stray c, is its part of the sum,
and the shares are means of h. A rotation u of d changes e = n . d by u . (d x n), so that with the variances s_ick^2 of e

    H_k u_k = -sum_ic g_i h_ick e_ik / s_ick^2 (d_k x n_i),
    H_k = sum_ic g_i h_ick / s_ick^2 (d_k x n_i)(d_k x n_i)',

for each direction, or one u for all of them from the sums over k where they are a frame. The covariance of u is the inverse of
the observed information, which has the second derivative of log r in place of 1 / s^2:

    q_ik = sum_c h_ick (1 / s_ick^2 - e_ik^2 / s_ick^4) + (sum_c h_ick e_ik / s_ick^2)^2.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from omnilines.structure.circles import Circles

ROUNDS = 100
SETTLED_RAD, NEARLY_RAD = 1e-7, 1e-5
FIRST_SHARES = 0.5
"""Of all directions together, before anything is known of them."""
OPEN_RAD = 1.0
"""Standard deviation of a rotation before anything is seen, so that one that nothing fixes is found so."""
TINY = 1e-300


@dataclass(frozen=True)
class Mixture:
    """k directions, and how likely each arc is of each."""

    direction: Float[np.ndarray, "k 3"]
    share: Float[np.ndarray, "c k"]
    """Of the arcs, by stray."""
    strays_rad: Float[np.ndarray, " c"]
    turn_covariance: Float[np.ndarray, "k 3 3"]
    """Of the rotation vector of each direction (camera frame, from the left), or of their frame."""
    log_likelihood: float

    @property
    def stray_rad(self) -> float:
        """Root mean square over the arcs of all directions."""
        return float(np.sqrt(self._by_stray @ np.square(self.strays_rad)))

    @property
    def _by_stray(self) -> Float[np.ndarray, " c"]:
        return self.share.sum(1) / max(float(self.share.sum()), TINY)

    def ratio(self, circles: Circles) -> Float[np.ndarray, "k n"]:
        """How much more likely each arc is as one of each direction than by chance."""
        return np.einsum("c,ckn->kn", self._by_stray, circles.ratio(self.direction, self.strays_rad))

    def belongs(self, circles: Circles) -> Float[np.ndarray, "n k"]:
        """Probability that each arc is of each direction."""
        return _parts(circles.ratio(self.direction, self.strays_rad), self.share)[0].sum(0).T


def _parts(
    ratio: Float[np.ndarray, "c k n"], share: Float[np.ndarray, "c k"]
) -> tuple[Float[np.ndarray, "c k n"], Float[np.ndarray, " n"]]:
    """The probabilities h, and the likelihood of each arc."""
    likely = share[:, :, None] * ratio
    whole: Float[np.ndarray, " n"] = 1.0 - share.sum() + likely.sum((0, 1))
    return likely / whole, whole


def fitted(
    circles: Circles,
    weight: Float[np.ndarray, " n"],
    direction: Float[np.ndarray, "k 3"],
    strays_rad: Float[np.ndarray, " c"],
    *,
    as_frame: bool,
) -> Mixture:
    """The most likely directions, shares and stray near given directions; `as_frame`: they are at right angles, and stay so.

    From where all strays together lead, and from the given directions, one stray is kept: the better of both counts.
    """
    climb = _Climb(circles, weight, strays_rad, as_frame)
    ends = [climb.with_one_stray(start) for start in (direction, climb.with_all_strays(direction))]
    return max(ends, key=lambda end: end.log_likelihood)


@dataclass(frozen=True)
class _Climb:
    """Expectation maximisation from given directions."""

    circles: Circles
    weight: Float[np.ndarray, " n"]
    strays_rad: Float[np.ndarray, " c"]
    as_frame: bool

    def with_all_strays(self, direction: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Where directions go while the shares of all strays are found."""
        share = np.full((len(self.strays_rad), len(direction)), FIRST_SHARES / (len(direction) * len(self.strays_rad)))
        for _ in range(ROUNDS):
            h = self.weight * _parts(self.circles.ratio(direction, self.strays_rad), share)[0]
            share = self._shares(h)
            direction, moved = self._moved(direction, h, self.strays_rad)
            if moved < NEARLY_RAD:
                break
        return direction

    def with_one_stray(self, direction: Float[np.ndarray, "k 3"]) -> Mixture:
        """Directions and shares with the stray that is most likely."""
        share = np.full((1, len(direction)), FIRST_SHARES / len(direction))
        at, nearby = -1, np.arange(len(self.strays_rad))
        for _ in range(ROUNDS):
            ratio = self.circles.ratio(direction, self.strays_rad[nearby])
            likely = [float(self.weight @ np.log(_parts(one[None], share)[1])) for one in ratio]
            best = int(np.argmax(likely))
            settled, at = at == nearby[best], int(nearby[best])
            h, _ = _parts(ratio[[best]], share)
            share = self._shares(self.weight * h)
            direction, moved = self._moved(direction, self.weight * h, self.strays_rad[[at]])
            nearby = np.arange(max(at - 1, 0), min(at + 2, len(self.strays_rad)))
            if settled and moved < SETTLED_RAD:
                break
        stray = self.strays_rad[[at]]
        h, whole = _parts(self.circles.ratio(direction, stray), share)
        covariance = _covariance(self.circles, direction, self.weight, h, stray, self.as_frame)
        return Mixture(direction, share, stray, covariance, float(self.weight @ np.log(whole)))

    def _shares(self, h: Float[np.ndarray, "c k n"]) -> Float[np.ndarray, "c k"]:
        """By stray and by direction; some arcs are left to chance."""
        share = h.sum((1, 2))[:, None] / max(float(h.sum()), TINY) * h.sum((0, 2)) / self.weight.sum()
        most = 1.0 - 1.0 / len(self.circles)
        return share * min(1.0, most / max(float(share.sum()), TINY))

    def _moved(
        self, direction: Float[np.ndarray, "k 3"], h: Float[np.ndarray, "c k n"], strays_rad: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "k 3"], float]:
        """The directions after a step, and the largest component of their turns."""
        turn = _step(self.circles, direction, h, strays_rad, self.as_frame)
        direction = direction + np.cross(turn, direction)
        norm = np.linalg.norm(direction, axis=-1, keepdims=True)
        return _orthogonal(direction) if self.as_frame else direction / norm, float(np.abs(turn).max())


def _step(
    circles: Circles,
    direction: Float[np.ndarray, "k 3"],
    h: Float[np.ndarray, "c k n"],
    strays_rad: Float[np.ndarray, " c"],
    as_frame: bool,
) -> Float[np.ndarray, "k 3"]:
    """Rotation vectors of the directions; h is weighted."""
    off, variance = circles.off(direction)
    weight = (h / (variance + np.square(strays_rad)[:, None, None])).sum(0)
    lever = np.cross(direction[:, None], circles.normal)
    gradient, information = np.einsum("kn,kni->ki", weight * off, lever), _summed(weight, lever, as_frame)
    if as_frame:
        gradient = np.broadcast_to(gradient.sum(0), gradient.shape)
    return -np.linalg.solve(information, gradient[..., None])[..., 0]


def _summed(weight: Float[np.ndarray, "k n"], lever: Float[np.ndarray, "k n 3"], as_frame: bool) -> Float[np.ndarray, "k 3 3"]:
    """Sums of lever lever', over the directions too where they are a frame, with what is known of a rotation beforehand."""
    summed = (lever * weight[..., None]).swapaxes(-1, -2) @ lever
    if as_frame:
        summed = np.broadcast_to(summed.sum(0), summed.shape)
    return summed + np.eye(3) / OPEN_RAD**2


def _covariance(
    circles: Circles,
    direction: Float[np.ndarray, "k 3"],
    weight: Float[np.ndarray, " n"],
    h: Float[np.ndarray, "c k n"],
    strays_rad: Float[np.ndarray, " c"],
    as_frame: bool,
) -> Float[np.ndarray, "k 3 3"]:
    """Of the rotation vectors; where the observed information does not bound one, as that of few arcs may not, by the step's."""
    off, variance = circles.off(direction)
    per_variance = 1.0 / (variance + np.square(strays_rad)[:, None, None])
    slope = (h * per_variance).sum(0) * off
    curvature = (h * per_variance * (1.0 - np.square(off) * per_variance)).sum(0) + np.square(slope)
    lever = np.cross(direction[:, None], circles.normal)
    observed = _summed(weight * curvature, lever, as_frame)
    expected = _summed(weight * (h * per_variance).sum(0), lever, as_frame)
    bounded = np.linalg.eigvalsh(observed)[:, 0] > 0
    return np.linalg.inv(np.where(bounded[:, None, None], observed, expected))


def _orthogonal(direction: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The frame nearest to three directions that are about at right angles."""
    u, _, v = np.linalg.svd(direction)
    nearest: Float[np.ndarray, "3 3"] = u @ v
    return nearest
