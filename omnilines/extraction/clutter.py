"""Arcs told from texture: an edge stands out from what lies beside it."""

import numpy as np
from jaxtyping import Bool, Float

from omnilines.extraction.arcs import Arcs, samples
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.profile_kernel import profiles
from omnilines.extraction.refit import Photo

STRONG_GREY = 16.0
"""Grey levels of 255, over all channels: an arc of such a contrast counts whatever is beside it."""
STANDS_OUT = 5.0
"""Contrast of a weaker arc over that of the same curve moved to the quieter side."""
_OFFSETS_PX = np.arange(-12.0, 13.0)
_MOVED = range(4, 11)
BLOCK_PX = 24
"""Length over which colours are averaged along an arc."""


def stands_out(photo: Photo, arcs: Arcs) -> Bool[np.ndarray, " n"]:
    """Whether the mean step of colour across each arc is strong, or stronger than across the arc moved by 4 to 10 px.

    Noise averages out along an arc, and so does most texture. What is left is the same, on average, on the arc as beside it
    where the arc is only a chance alignment.
    """
    if not len(arcs):
        return np.zeros(0, dtype=bool)
    at = samples(photo.model, arcs, 0.0)
    grey, _ = profiles(photo.image, grey_unit(photo.image), at.pixel, at.across, _OFFSETS_PX, photo.model.PERIODIC)
    # Blocks along the arc: an edge between the tiles of a floor changes sides.
    number = np.arange(len(at.owner)) - at.starts[at.owner]
    size = np.diff(at.starts)[at.owner]
    blocks = np.maximum(size // BLOCK_PX, 1)
    begins = np.flatnonzero(np.diff(at.owner * 1_000_000 + number * blocks // size, prepend=-1))
    length = np.diff(np.append(begins, len(at.owner)))
    mean = np.add.reduceat(grey, begins, axis=0).astype(np.float64) / length[:, None, None]
    owner = at.owner[begins]
    count = np.bincount(owner, length, len(arcs))

    def step(moved: int) -> Float[np.ndarray, " n"]:
        return np.bincount(owner, length * _step(mean, moved), len(arcs)) / count

    beside = [np.mean([step(side * moved) for moved in _MOVED], axis=0) for side in (-1, 1)]
    here = step(0)
    return (here >= STRONG_GREY**2) | (here >= STANDS_OUT**2 * np.minimum(*beside))


def _step(mean: Float[np.ndarray, "m k c"], moved: int) -> Float[np.ndarray, " m"]:
    """Squared difference in colour between the two pixels on either side of the arc moved across."""
    k = moved + len(_OFFSETS_PX) // 2
    step = 0.5 * (mean[:, k + 1] + mean[:, k + 2] - mean[:, k - 1] - mean[:, k - 2])
    return (step**2).sum(-1)
