"""Directions in which the lines of one photo meet (vanishing directions on the sphere), with their covariances.

Directions in which pairs of arcs meet are tried; those under which the arcs are most likely are refined (`mixture.py`), and kept
where chance does not make them. By chance the mean of the ratio r of every arc (`circles.py`) is at most 1, so that a direction
has a gain sum_i c_i log(1 - w + w r_i) of x or more with a probability of at most exp(-x) (Markov's inequality). With the pairs,
shares w and strays that are tried, that is the number of directions to be expected by chance (a contrario: Desolneux, Moisan and
Morel, IJCV 2000; for vanishing points Almansa, Desolneux and Vamech, PAMI 2003; here without a gate). The two lines on which a
direction was placed do not count. Fragments of one line, and its other edge, say the same: their weights c add up to 1, and
Hoelder's inequality keeps the bound however they depend on each other.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.structure.circles import Circles
from omnilines.structure.mixture import Mixture, fitted
from omnilines.structure.options import DirectionsOptions

SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7)
"""Of a direction among the arcs, tried for its gain over chance."""
STRAYS_TOLD_APART = 20
SAME_SIGMAS = 3.0
"""Circles nearer to each other, in standard deviations, are those of one line."""
AT_ONCE = 4000
"""Directions compared at a time, which bounds the memory."""


@dataclass(frozen=True)
class Meeting:
    """k directions of one photo, that with the most arcs first, and which of its n arcs belong to each."""

    direction: Float[np.ndarray, "k 3"]
    """Unit, camera frame; either sign is as good, the largest component is positive."""
    covariance: Float[np.ndarray, "k 3 3"]
    """rad^2, zero along each direction."""
    direction_of: Int[np.ndarray, " n"]
    """Of each arc, -1 for none."""
    stray_rad: float
    """Standard deviation by which lines stray from their direction, in each of two."""

    def __len__(self) -> int:
        return len(self.direction)

    @staticmethod
    def none(arcs: int) -> "Meeting":
        """No direction, of so many arcs."""
        return Meeting(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.full(arcs, -1), 0.0)

    def only(self, chosen: int, direction: Float[np.ndarray, "3"]) -> "Meeting":
        """One of the directions, with the sign that is given."""
        its = np.where(self.direction_of == chosen, 0, -1)
        return Meeting(direction[None], self.covariance[[chosen]], its, self.stray_rad)

    @property
    def members(self) -> Int[np.ndarray, " k"]:
        """Arcs of each."""
        return np.bincount(self.direction_of[self.direction_of >= 0], minlength=len(self))

    @property
    def sigma_rad(self) -> Float[np.ndarray, " k"]:
        """Largest standard deviation of each."""
        return largest_sigma(self.covariance)


def largest_sigma(covariance: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, " k"]:
    """Largest standard deviation in any one direction."""
    sigma: Float[np.ndarray, " k"] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., -1], 0.0))
    return sigma


def meeting_directions(circles: Circles, options: DirectionsOptions = DirectionsOptions()) -> Meeting:
    """The directions that are there beyond chance; none where there are none."""
    own = circles.rows(circles.sharpest(options.used_arcs))
    weight = line_weights(own, options.tried_rad)
    found, free = np.zeros((0, 3)), np.ones(len(own), dtype=bool)
    while len(found) < options.max_directions:
        alone = _best(own.rows(free), weight[free], found, options)
        if alone is None:
            break
        found = np.concatenate([found, alone.direction])
        free &= alone.belongs(own)[:, 0] < 0.5
    found = apart(found, options.separation_rad)
    while len(found):
        fit = fitted(own, weight, found, np.array(options.strays_rad), as_frame=False)
        kept = apart(fit.direction[_stand(own, weight, fit, options)], options.separation_rad)
        if len(kept) == len(found):
            return described(circles, _ordered(circles, fit))
        found = kept
    return Meeting.none(len(circles))


def _best(
    circles: Circles, weight: Float[np.ndarray, " n"], found: Float[np.ndarray, "k 3"], options: DirectionsOptions
) -> Mixture | None:
    """The first of the directions tried that stands out from chance, beside those that are found."""
    tried = tried_directions(circles, weight, options.refined, options)
    for start in apart(tried, options.separation_rad, found):
        alone = fitted(circles, weight, start[None], np.array(options.strays_rad), as_frame=False)
        if _stand(circles, weight, alone, options)[0]:
            return alone
    return None


def line_weights(circles: Circles, same_rad: float) -> Float[np.ndarray, " n"]:
    """Of each arc, so that those of one line add up to one: the middle of each lies on the circle of the other, and their normals
    agree, as far as is known and to a standard deviation of `same_rad`."""
    sine2 = np.clip(1.0 - np.square(circles.normal @ circles.normal.T), 0.0, 1.0)
    own = np.square(circles.sigma_rad)
    off, variance = circles.off(circles.middle)
    apart2 = np.square(off) / (variance + same_rad**2)
    apart2 = np.maximum(np.maximum(apart2, apart2.T), sine2 / (own[:, None] + own + same_rad**2))
    np.fill_diagonal(apart2, 0.0)
    return 1.0 / np.exp(-0.5 * apart2).sum(1)


def tried_directions(
    circles: Circles, weight: Float[np.ndarray, " n"], most: int, options: DirectionsOptions
) -> Float[np.ndarray, "m 3"]:
    """Directions in which two arcs meet, `most` of them, those under which the arcs are most likely, none near another."""
    sharpest = circles.sharpest(options.paired_arcs)
    first, second = np.triu_indices(len(sharpest), 1)
    direction = np.cross(circles.normal[sharpest[first]], circles.normal[sharpest[second]])
    length = np.linalg.norm(direction, axis=-1)
    direction = direction[length > options.tried_rad] / length[length > options.tried_rad, None]
    stray = np.array([options.tried_rad])
    blocks = [direction[low : low + AT_ONCE] for low in range(0, len(direction), AT_ONCE)]
    scores = [np.log1p(options.share * circles.ratio(block, stray)[0]) @ weight for block in blocks]
    score = np.concatenate([np.zeros(0), *scores])
    return apart(direction[np.argsort(-score, kind="stable")], options.separation_rad, most=most)


def apart(
    direction: Float[np.ndarray, "m 3"],
    separation_rad: float,
    others: Float[np.ndarray, "k 3"] | None = None,
    most: int | None = None,
) -> Float[np.ndarray, "l 3"]:
    """The directions that are near none before them and none of `others`, the first `most`."""
    cosine = math.cos(separation_rad)
    if others is not None and len(others):
        direction = direction[(np.abs(direction @ others.T) < cosine).all(1)]
    kept: list[np.ndarray] = []
    while len(direction) and (most is None or len(kept) < most):
        kept.append(direction[0])
        direction = direction[1:][np.abs(direction[1:] @ direction[0]) < cosine]
    return np.array(kept).reshape(-1, 3)


def _stand(circles: Circles, weight: Float[np.ndarray, " n"], fit: Mixture, options: DirectionsOptions) -> Bool[np.ndarray, " k"]:
    """Which directions chance does not make, are known well enough, and have enough lines."""
    h, ratio = fit.belongs(circles), fit.ratio(circles)
    sigma = largest_sigma(direction_covariance(fit))
    pairs = 0.5 * len(circles) * (len(circles) - 1)
    stands = (sigma <= options.max_sigma_rad) & (weight @ h >= options.min_lines)
    for k in np.flatnonzero(stands):
        free = np.delete(h, k, 1).sum(1) < 0.5
        gain = gain_over_chance(circles.rows(free), weight[free], ratio[k, free], 2, options.tried_rad)
        stands[k] = gain >= math.log(pairs * STRAYS_TOLD_APART / options.false_directions)
    return stands


def gain_over_chance(
    circles: Circles, weight: Float[np.ndarray, " n"], ratio: Float[np.ndarray, " n"], placed_by: int, same_rad: float
) -> float:
    """log of how much more likely the arcs are with what they have the ratios to than by chance, for the best share and less its
    choice, without the `placed_by` lines that say so most."""
    left = np.ones(len(ratio), dtype=bool)
    for _ in range(placed_by):
        if left.any():
            best = np.flatnonzero(left)[int(np.argmax(ratio[left]))]
            left &= np.abs(circles.normal @ circles.normal[best]) < math.cos(SAME_SIGMAS * same_rad)
    share = np.array(SHARES)[:, None]
    return float((np.log1p(share * (ratio[left] - 1.0)) @ weight[left]).max()) - math.log(len(SHARES))


def direction_covariance(fit: Mixture) -> Float[np.ndarray, "k 3 3"]:
    """Of each direction: a turn u moves it by u x d."""
    moves = np.cross(np.eye(3), fit.direction[:, None])
    return np.einsum("kai,kab,kbj->kij", moves, fit.turn_covariance, moves)


def described(circles: Circles, fit: Mixture) -> Meeting:
    """All arcs with the direction that each belongs to: more likely than to any other or none."""
    h = fit.belongs(circles)
    chosen = np.where(h.max(1) > 0.5, h.argmax(1), -1)
    return Meeting(fit.direction, direction_covariance(fit), chosen, fit.stray_rad)


def _ordered(circles: Circles, fit: Mixture) -> Mixture:
    """That with the most arcs first; largest components positive."""
    order = np.argsort(-(fit.belongs(circles) > 0.5).sum(0), kind="stable")
    direction = fit.direction[order]
    largest = np.take_along_axis(direction, np.abs(direction).argmax(-1)[:, None], -1)
    return replace(
        fit,
        direction=np.where(largest < 0, -1.0, 1.0) * direction,
        share=fit.share[:, order],
        turn_covariance=fit.turn_covariance[order],
    )
