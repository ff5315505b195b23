"""Mean profiles of colour across pieces of arcs, and the blurred steps that explain them: one for each edge beside the arc."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.extraction.arcs import Arcs, Samples, samples
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.profile_kernel import sharp_profiles
from omnilines.extraction.refit import Photo
from omnilines.extraction.step_kernel import crossings, fit_steps

OFFSETS_PX = np.arange(-12, 13) * 0.5
BLOCK_PX = 5
"""Length along an arc over which profiles are averaged."""
REACH_PX = 6.0
LEAST_COSINE = 0.95
"""Between an arc and an edge beside it: 18 degrees."""
BEYOND_PX = 3.0
"""Edges are taken to go on beyond the ends of their arcs."""
STIFF_PX = np.array([1.0, 0.3])
"""Standard deviations of the own step's place and of the others' about where their arcs are."""
LEAST_WEIGHT = 0.03
"""Of the outermost value of a profile in a fit."""
_PIECES = 40_000
"""Whose profiles are read at a time."""


def pieces(at: Samples, wanted: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """First sample and number of samples of the pieces that each arc is cut into, at least one each."""
    number = np.arange(len(at.owner)) - at.starts[at.owner]
    count = np.maximum(wanted, 1)[at.owner]
    piece = number * count // np.diff(at.starts)[at.owner]
    begins = np.flatnonzero((np.diff(at.owner, prepend=-1) != 0) | (np.diff(piece, prepend=-1) != 0))
    return begins, np.diff(np.append(begins, len(at.owner)))


@dataclass(frozen=True)
class Blocks:
    """Pieces of arcs of BLOCK_PX, arc after arc."""

    owner: Int[np.ndarray, " m"]
    starts: Int[np.ndarray, " n1"]
    length: Int[np.ndarray, " m"]
    whole: Bool[np.ndarray, " m"]
    """All of its profiles lie in the image."""
    angle: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    profile: Float[np.ndarray, "m k c"]
    """Mean grey levels of 255 at OFFSETS_PX."""
    place: Float[np.ndarray, "m s"]
    """Where its profile is crossed: by its own arc at 0, then by its neighbours."""
    count: Int[np.ndarray, " m"]
    sigma: Float[np.ndarray, " m"]

    def keep(self, arcs: Int[np.ndarray, " k"]) -> "Blocks":
        """Those of some arcs, in order, numbered anew."""
        number = np.full(len(self.starts) - 1, -1)
        number[arcs] = np.arange(len(arcs))
        rows = np.flatnonzero(number[self.owner] >= 0)
        owner = number[self.owner[rows]]
        names = ("length", "whole", "angle", "rate", "profile", "place", "count", "sigma")
        return Blocks(owner, np.searchsorted(owner, np.arange(len(arcs) + 1)), *(getattr(self, name)[rows] for name in names))

    def mean(self, values: Float[np.ndarray, " m"], arcs: int) -> Float[np.ndarray, " n"]:
        """Of each arc's blocks."""
        return np.bincount(self.owner, values, arcs) / np.maximum(np.diff(self.starts), 1)


def blocks_along(photo: Photo, arcs: Arcs, noise: float) -> Blocks:
    """Profiles across arcs and where other arcs cross them."""
    at = samples(photo.model, arcs, 0.0)
    closed = photo.model.PERIODIC
    begins, length = pieces(at, np.diff(at.starts) // BLOCK_PX)
    mean, whole = _means(photo, at, begins, length)
    owner, middle = at.owner[begins], begins + length // 2
    beside = samples(photo.model, arcs, BEYOND_PX)
    width, height = photo.model.image_size
    place, count = crossings(
        at.pixel[middle],
        at.across[middle],
        owner,
        beside.pixel,
        beside.across,
        beside.owner,
        height,
        width,
        closed,
        REACH_PX,
        LEAST_COSINE,
    )
    return Blocks(
        owner,
        np.searchsorted(owner, np.arange(len(arcs) + 1)),
        length,
        whole,
        np.add.reduceat(at.angle, begins) / length,
        np.add.reduceat(at.rate, begins) / length,
        mean,
        place,
        count,
        noise / np.sqrt(length),
    )


def _means(
    photo: Photo, at: Samples, begins: Int[np.ndarray, " m"], length: Int[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "m k c"], Bool[np.ndarray, " m"]]:
    """Mean profiles of pieces, and whether all of each lies in the image."""
    count, closed = len(begins), photo.model.PERIODIC
    mean, whole = np.zeros((count, len(OFFSETS_PX), photo.image.shape[2])), np.zeros(count, dtype=bool)
    for low in range(0, count, _PIECES):
        part = slice(low, low + _PIECES)
        first, last = begins[low], begins[part][-1] + length[part][-1]
        pixel, across = at.pixel[first:last], at.across[first:last]
        grey, imaged = sharp_profiles(photo.image, grey_unit(photo.image), pixel, across, OFFSETS_PX, closed)
        mean[part] = np.add.reduceat(grey, begins[part] - first, axis=0) / length[part, None, None]
        whole[part] = np.minimum.reduceat((imaged & at.valid[first:last]).astype(np.int8), begins[part] - first) > 0
    return mean, whole


def fit_places(
    blocks: Blocks, start: Float[np.ndarray, "m s"], taper_px: float, blur_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`fit_steps` of the profiles of blocks in a window of `taper_px`, the standard deviation of its weights."""
    weight = np.exp(-0.25 * (OFFSETS_PX / taper_px) ** 2)
    near = weight >= LEAST_WEIGHT
    return fit_steps(
        np.ascontiguousarray(blocks.profile[:, near]),
        OFFSETS_PX[near],
        weight[near],
        start,
        blocks.count,
        STIFF_PX,
        blocks.sigma,
        np.full(len(blocks.owner), blur_px),
    )
