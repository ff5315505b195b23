"""Arcs told from texture: an edge stands out from what lies beside it."""

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.extraction.blocks import pieces
from omnilines.extraction.curves import Samples, samples
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.kernels.profile import piece_means, profiles
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
    # Blocks along the arc: an edge between the tiles of a floor changes sides.
    at = samples(photo.model, arcs, 0.0)
    each = np.diff(at.starts)
    # Where the image is stretched along the arc, as at the poles of a panorama, its pixels tell less.
    rate = np.bincount(at.owner, at.rate, len(arcs)) / each
    length_px = np.minimum(fitted.length_px, (arcs.high - arcs.low) * rate)
    wanted = np.minimum(length_px, each).astype(np.int64) // BLOCK_PX
    here = _steps(photo, at, wanted, [0])[0]
    evident = here * np.sqrt(length_px) > LEAST_EVIDENCE * fitted.blur_px
    result = (here >= STRONG_GREY) | (evident & (length_px > LONG_PX))
    rows = np.flatnonzero(evident & ~result)
    if len(rows):
        at = samples(photo.model, arcs.keep(rows), 0.0)
        beside = [np.median(_steps(photo, at, wanted[rows], [side * moved for moved in _MOVED]), axis=0) for side in (-1, 1)]
        result[rows] = here[rows] > STANDS_OUT * np.minimum(*beside)
    return result


def _steps(photo: Photo, at: Samples, wanted: Int[np.ndarray, " n"], moved: list[int]) -> Float[np.ndarray, "d n"]:
    """Root mean square over blocks of arcs, as many as `wanted`, of the difference in colour between the two pixels on either
    side of each arc moved across."""
    starts = pieces(at, wanted)
    begins, length = starts[:-1], np.diff(starts)
    owner = at.owner[begins]
    arcs = len(at.starts) - 1
    offsets = np.arange(min(moved) - 2.0, max(moved) + 3.0)
    grey, _ = profiles(photo.image, grey_unit(photo.image), at.pixel, at.across, offsets, photo.model.PERIODIC)
    mean = piece_means(grey, starts)
    found = []
    for k in np.array(moved) - min(moved) + 2:
        step = 0.5 * (mean[..., k + 1] + mean[..., k + 2] - mean[..., k - 1] - mean[..., k - 2])
        found.append(np.bincount(owner, length * (step**2).sum(-1), arcs) / np.bincount(owner, length, arcs))
    return np.sqrt(np.stack(found))
