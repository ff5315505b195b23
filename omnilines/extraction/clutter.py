"""Arcs told from texture: an edge stands out from what lies beside it."""

import numpy as np
from jaxtyping import Bool, Float

from omnilines.extraction.blocks import pieces
from omnilines.extraction.curves import samples
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.profile_kernel import piece_means, profiles
from omnilines.extraction.refit import Photo, Refitted

STRONG_GREY = 16.0
"""Grey levels of 255, over all channels: an arc of such a contrast counts whatever is beside it."""
LEAST_EVIDENCE = 105.0
"""Of a weaker arc: contrast times the square root of its length (px) over its blur (px). Along an edge the contrast is steady, so
that it outweighs what varies from pixel to pixel the more the longer it is; and an edge is sharper than most texture."""
STANDS_OUT = 3.0
"""Contrast of a weaker arc over that of the same curve moved to the quieter side."""
LONG_PX = 80.0
"""Chance alignments in texture are shorter."""
_OFFSETS_PX = np.arange(-12.0, 13.0)
_MOVED = range(4, 11)
BLOCK_PX = 12
"""Length over which colours are averaged along an arc."""


def stands_out(photo: Photo, fitted: Refitted) -> Bool[np.ndarray, " n"]:
    """Whether the mean step of colour across each arc is strong; or enough for its length and blur, and for a short arc larger
    than across the arc moved by 4 to 10 px.

    Noise averages out along an arc, and so does most texture. What is left is the same, on average, on the arc as beside it
    where the arc is only a chance alignment.
    """
    arcs = fitted.arcs
    if not len(arcs):
        return np.zeros(0, dtype=bool)
    at = samples(photo.model, arcs, 0.0)
    grey, _ = profiles(photo.image, grey_unit(photo.image), at.pixel, at.across, _OFFSETS_PX, photo.model.PERIODIC)
    # Blocks along the arc: an edge between the tiles of a floor changes sides.
    each = np.diff(at.starts)
    # Where the image is stretched along the arc, as at the poles of a panorama, its pixels tell less.
    rate = np.bincount(at.owner, at.rate, len(arcs)) / each
    length_px = np.minimum(fitted.length_px, (arcs.high - arcs.low) * rate)
    starts = pieces(at, np.minimum(length_px, each).astype(np.int64) // BLOCK_PX)
    begins, length = starts[:-1], np.diff(starts)
    mean = piece_means(grey, starts)
    owner = at.owner[begins]
    count = np.bincount(owner, length, len(arcs))

    def step(moved: int) -> Float[np.ndarray, " n"]:
        return np.sqrt(np.bincount(owner, length * _step(mean, moved), len(arcs)) / count)

    beside = [np.median([step(side * moved) for moved in _MOVED], axis=0) for side in (-1, 1)]
    here = step(0)
    evident = here * np.sqrt(length_px) > LEAST_EVIDENCE * fitted.blur_px
    alone = (here > STANDS_OUT * np.minimum(*beside)) | (length_px > LONG_PX)
    return (here >= STRONG_GREY) | (evident & alone)


def _step(mean: Float[np.ndarray, "m c k"], moved: int) -> Float[np.ndarray, " m"]:
    """Squared difference in colour between the two pixels on either side of the arc moved across."""
    k = moved + len(_OFFSETS_PX) // 2
    step = 0.5 * (mean[..., k + 1] + mean[..., k + 2] - mean[..., k - 1] - mean[..., k - 2])
    return (step**2).sum(-1)
