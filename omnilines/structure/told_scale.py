"""Whether right angles tell the scale of a camera: the probability of all other explanations beside that one.

Directions of lines were found with a camera that is known but for a factor q on z (`right_angles.py`). What pairs of directions
of one photo show is explained in one of two ways, as likely before anything is seen:

- R: pairs are at right angles, or at any angle by chance;
- A: one direction of a photo at most, the vertical, is at right angles to the others; these, the walls, are at an angle t to one
  another that all photos share, or 180 degrees - t (the cosine of t uniform, beyond what strays make of a right angle); or pairs
  are at any angle by chance. Either all photos show t from the same side, or each pair any side, as likely.

Which direction is the vertical is what explains a photo best, and costs A nothing: photos are mostly held upright, and show it.
So the odds of R over A are those by which what is seen makes right angles of walls more likely than any other: they do not grow
with what both explain, as walls that are always seen from the same side, at one angle, which is a right one at some scale.

Of neither q is known, but that its logarithm is between two bounds, nor the standard deviation s by which things built stray from
their directions, but that it is one of a few. So the likelihood of R at a scale, L_R(q), is the mean over s, that of A, L_A(q),
the mean over s and t. Right angles tell q where the sum of L_R over the scales about its top is `decisive` times the sum of L_R
over all others and of L_A over all. Where A has the same scale, within its standard deviation, it does not speak against it: so
much of that as R has itself counts with R.

Where right angles do not tell it, L_R and L_A may still agree on it, as where walls are nearly at right angles and photos are
tilted: each by itself tells about the same scale. Then it is that of both together, the mean over their sum, and as uncertain.

Any one pair is at right angles at some scale, and explains itself. What tells is agreement: of walls seen from several sides, or
of verticals and horizontals in photos that are tilted.

Cosines of t are tried in steps: the uniform distribution within a step is in the variance of each cosine.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from omnilines.structure.meeting import Meeting
from omnilines.structure.options import RightAngleOptions
from omnilines.structure.right_angles import Pairs, over_chance


@dataclass(frozen=True)
class ToldScale:
    """The factor on z that right angles tell best, and whether they tell it."""

    factor: float
    sigma: float
    """Standard deviation of its logarithm."""
    reach: float
    """Scales whose logarithms differ from its own by less are the same one."""
    odds: float
    """Of right angles at this scale, over all other explanations."""
    rival_factor: float
    """The factor of the most likely other explanation."""
    rival_angle_rad: float | None
    """Of its walls; None where right angles explain it."""
    decisive: bool
    """Whether right angles tell the scale."""
    either: float
    """The factor that right angles and walls at other angles tell together: by the mean logarithm about the most likely one."""
    either_sigma: float
    """Standard deviation of that logarithm."""
    told: bool
    """Whether these tell the scale, though not whether angles are right ones: by each of both, scales about that one are
    `decisive` times as likely as all others."""

    @property
    def here(self) -> bool:
        """Whether it is the scale with which directions were found."""
        return abs(math.log(self.factor)) <= self.reach


def told_scale(
    photos: Sequence[Meeting], weights: Float[np.ndarray, " photos"], options: RightAngleOptions = RightAngleOptions()
) -> ToldScale:
    """What the directions of photos, found with the factor 1, tell. Photos that show the same have weights that add up to 1.
    Where no photo shows a pair nothing is told."""
    far = math.log(options.max_factor)
    places = np.linspace(-far, far, options.told_factors)
    least = math.sqrt(2.0) * options.right_sigmas * max(options.told_strays_rad)
    cosines = least + (1.0 - least) * (np.arange(options.angles) + 0.5) / options.angles
    right, other = _log_likelihoods(photos, weights, places, cosines, options)
    most = max(right.max(), other.max())
    right, other = np.exp(right - most).mean(0), np.exp(other - most).mean(0)
    top, sigma = _top(places, right, options)
    reach = min(max(options.same_sigmas * sigma, float(places[1] - places[0])), options.same_scale)
    own = np.abs(places - top) <= reach
    rest, of_walls = np.where(own, 0.0, right), other.mean(0)
    found = right[own].sum()
    agreed = min(of_walls[np.abs(places - top) <= sigma].sum(), found)
    odds = float((found + agreed) / (rest.sum() + of_walls.sum() - agreed))
    by_right = bool(rest.max() >= of_walls.max())
    rival = int(np.argmax(rest if by_right else of_walls))
    angle = None if by_right else math.acos(float(cosines[int(np.argmax(other[:, rival]))]))
    both = right + of_walls
    mean, spread = _top(places, both, options)
    about = np.abs(places - places[int(np.argmax(both))]) <= options.same_scale
    told = all(bool(one[about].sum() >= options.decisive * one[~about].sum()) for one in (right, of_walls))
    decisive = odds >= options.decisive
    return ToldScale(math.exp(top), sigma, reach, odds, math.exp(places[rival]), angle, decisive, math.exp(mean), spread, told)


@dataclass(frozen=True)
class _Verticals:
    """What photos gain where one direction of each is at right angles to the others."""

    pairs: Float[np.ndarray, "p d"]
    """1 for each of the two directions of a pair."""
    first: Int[np.ndarray, " photos"]
    """The first direction of each photo that has one."""

    @staticmethod
    def of(photos: Sequence[Meeting], pairs: Pairs) -> "_Verticals":
        """Of all photos."""
        counts = np.array([len(one) for one in photos], dtype=np.int64)
        holds = np.zeros((len(pairs.pair), int(counts.sum())), dtype=np.float32)
        np.put_along_axis(holds, pairs.pair, 1.0, 1)
        return _Verticals(holds, (np.cumsum(counts) - counts)[counts > 0])

    def gain(self, gains: Float[np.ndarray, "a p"]) -> Float[np.ndarray, " a"]:
        """The sum over photos of the most that a vertical gains, 0 where none does."""
        if not len(self.first):
            return np.zeros(len(gains))
        most: Float[np.ndarray, "a photos"] = np.maximum.reduceat(gains @ self.pairs, self.first, axis=1)
        return np.maximum(most, 0.0).sum(1)


def _log_likelihoods(
    photos: Sequence[Meeting],
    weights: Float[np.ndarray, " photos"],
    places: Float[np.ndarray, " f"],
    others: Float[np.ndarray, " a"],
    options: RightAngleOptions,
) -> tuple[Float[np.ndarray, "s f"], Float[np.ndarray, "s a f"]]:
    """Over those of chance: of R for each stray and logarithm of q, of A for each cosine of t beside."""
    pairs = Pairs.all_of(photos, weights)
    vertical = _Verticals.of(photos, pairs)
    shape = len(options.told_strays_rad), len(others), len(places)
    right, other = np.zeros((shape[0], shape[2])), np.zeros(shape, dtype=np.float32)
    # Single precision, as it is of many.
    share, chance, weight = np.float32(options.share), np.float32(1.0 - options.share), pairs.weight.astype(np.float32)
    step = float(others[1] - others[0])
    for k, place in enumerate(places):
        cosine, known = pairs.cosines(math.exp(place))
        cosine = np.where(pairs.first[:, 2] * pairs.second[:, 2] < 0, -cosine, cosine)
        off = np.square(cosine - np.stack([others, -others])[..., None]).astype(np.float32)
        for j, stray in enumerate(options.told_strays_rad):
            variance = known + 2.0 * stray**2
            at_right = over_chance(cosine, variance)
            alone = np.log1p(options.share * (at_right - 1.0)) * pairs.weight
            right[j, k] = alone.sum()
            spread = (variance + step**2 / 12.0).astype(np.float32)
            at_other = np.sqrt(np.float32(2.0 / np.pi) / spread) * np.exp(off * (np.float32(-0.5) / spread))
            # From one side, from the other, and from either.
            sides = np.stack([at_other[0], at_other[1], at_other.mean(0)])
            walls = np.log(chance + share * sides).reshape(3 * len(others), len(weight)) * weight
            found = walls.sum(1) + vertical.gain(alone.astype(np.float32) - walls)
            one, opposite, either = found.reshape(3, len(others))
            other[j, :, k] = np.logaddexp(np.logaddexp(one, opposite) - math.log(2.0), either) - math.log(2.0)
    return right, other


def _top(places: Float[np.ndarray, " f"], likelihood: Float[np.ndarray, " f"], options: RightAngleOptions) -> tuple[float, float]:
    """Mean and standard deviation of the scales about the most likely one."""
    own = np.abs(places - places[int(np.argmax(likelihood))]) <= options.same_scale
    weight = np.where(own, likelihood, 0.0) / likelihood[own].sum()
    mean, step = float(weight @ places), float(places[1] - places[0])
    return mean, math.sqrt(float(weight @ np.square(places - mean)) + step**2 / 12.0)
