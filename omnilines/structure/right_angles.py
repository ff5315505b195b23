"""The scale of a camera from right angles between directions in which the lines of its photos meet.

A camera that is known but for a factor q on z sees a direction d of the world as diag(1, 1, q) d. Lines stay straight and meet
whatever q is; that two directions are at right angles depends on it:

    cos(q) = d' diag(1, 1, q^2) e / (|diag(1, 1, q) d| |diag(1, 1, q) e|).

Each pair of directions of one photo may be at right angles, then cos(q) is zero but for its variance (that of both directions,
and a stray), or at any other angle, with cos(q) uniform from -1 to 1. The sum over all pairs of the log likelihood over that of
chance is compared for all q; by chance it is x or more with a probability of at most exp(-x) for each q (Markov's inequality).

Whether right angles tell it is another question: `told_scale.py`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from omnilines.structure.meeting import Meeting
from omnilines.structure.options import RightAngleOptions

FINER = 41
"""Steps of the finer grid about a top."""


@dataclass(frozen=True)
class ScalePeak:
    """A factor on z under which directions are at right angles."""

    factor: float
    sigma: float
    """Standard deviation of its logarithm."""
    gain: float
    """log likelihood over that of chance."""
    stands: bool
    """Whether chance does not make it."""


@dataclass(frozen=True)
class Pairs:
    """Two directions of one photo each, and their covariances."""

    first: Float[np.ndarray, "p 3"]
    second: Float[np.ndarray, "p 3"]
    of_first: Float[np.ndarray, "p 3 3"]
    of_second: Float[np.ndarray, "p 3 3"]
    weight: Float[np.ndarray, " p"]
    pair: Int[np.ndarray, "p 2"]
    """The two, by their place among the directions of all photos."""

    @staticmethod
    def all_of(photos: Sequence[Meeting], weights: Float[np.ndarray, " photos"]) -> "Pairs":
        """All pairs of each photo."""
        directions, covariances = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3, 3))]
        of, before = [np.zeros((0, 2), dtype=np.int64)], 0
        for one in photos:
            both = np.stack(np.triu_indices(len(one), 1), -1)
            directions.append(one.direction[both])
            covariances.append(one.covariance[both])
            of.append(both + before)
            before += len(one)
        direction, covariance = np.concatenate(directions), np.concatenate(covariances)
        weight = np.repeat(weights, [len(one) * (len(one) - 1) // 2 for one in photos])
        return Pairs(direction[:, 0], direction[:, 1], covariance[:, 0], covariance[:, 1], weight, np.concatenate(of))

    def cosines(self, q: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Of the angle of each pair at a factor on z, and the variances that directions make."""
        scale = np.array([1.0, 1.0, q])
        x, y = self.first * scale, self.second * scale
        long_x, long_y = (np.linalg.norm(z, axis=-1, keepdims=True) for z in (x, y))
        x, y = x / long_x, y / long_y
        cosine = (x * y).sum(-1, keepdims=True)
        by_first, by_second = scale * (y - cosine * x) / long_x, scale * (x - cosine * y) / long_y
        variance = np.einsum("pi,pij,pj->p", by_first, self.of_first, by_first)
        variance += np.einsum("pi,pij,pj->p", by_second, self.of_second, by_second)
        return cosine[:, 0], variance


def scale_peaks(
    photos: Sequence[Meeting], weights: Float[np.ndarray, " photos"], options: RightAngleOptions = RightAngleOptions()
) -> list[ScalePeak]:
    """Factors on z, the most likely first, from the directions of photos that were found with the factor 1. Photos that show the
    same have weights that add up to 1."""
    pairs = Pairs.all_of(photos, weights)
    if not len(pairs.first):
        return []
    far = math.log(options.max_factor)
    places = np.linspace(-far, far, options.factors)
    gains = np.array([_gain(pairs, math.exp(place), options) for place in places])
    tops = 1 + np.flatnonzero((gains[1:-1] >= gains[:-2]) & (gains[1:-1] > gains[2:]))
    tops = tops[np.argsort(-gains[tops], kind="stable")][: options.most_peaks]
    return sorted((_refined(pairs, places[top], places[1] - places[0], options) for top in tops), key=lambda peak: -peak.gain)


def _beyond_chance(options: RightAngleOptions) -> float:
    """Gain that the best of all scales tried has by chance with a probability of `false_scales` at most."""
    return math.log(options.factors / options.false_scales)


def _gain(pairs: Pairs, q: float, options: RightAngleOptions) -> float:
    """log likelihood of all pairs over that of chance."""
    cosine, variance = pairs.cosines(q)
    ratio = over_chance(cosine, variance + 2.0 * options.stray_rad**2)
    return float(pairs.weight @ np.log1p(options.share * (ratio - 1.0)))


def over_chance(cosine: Float[np.ndarray, " p"], variance: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Of pairs at right angles: a normal distribution cut off at -1 and 1, over a density of 1/2."""
    inside = torch.erf(torch.as_tensor(np.sqrt(0.5 / variance))).numpy()
    ratio: Float[np.ndarray, " p"] = 2.0 * np.exp(-0.5 * np.square(cosine) / variance)
    return ratio / (np.sqrt(2.0 * np.pi * variance) * inside)


def _refined(pairs: Pairs, place: float, step: float, options: RightAngleOptions) -> ScalePeak:
    """The top near log q on a finer grid, and the curvature there."""
    near = place + step * np.linspace(-1.0, 1.0, FINER)
    gains = np.array([_gain(pairs, math.exp(one), options) for one in near])
    top = int(np.argmax(gains[1:-1])) + 1
    bend = max(2.0 * gains[top] - gains[top - 1] - gains[top + 1], 1e-9)
    gain = float(gains[top])
    sigma = float((near[1] - near[0]) / math.sqrt(bend))
    return ScalePeak(math.exp(near[top]), sigma, gain, gain >= _beyond_chance(options))
