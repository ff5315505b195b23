"""Arcs told from texture: an edge stands out from what lies beside it."""

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.extraction.blocks import pieces
from omnilines.extraction.curves import samples
from omnilines.extraction.kernels.profile import piece_means, profiles
from omnilines.extraction.kernels.tables import Samples
from omnilines.extraction.options import ClutterOptions
from omnilines.extraction.refit import Photo, Refitted

_MOVED = range(4, 11)


def stands_out(photo: Photo, fitted: Refitted, options: ClutterOptions) -> Bool[np.ndarray, " n"]:
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
    wanted = np.minimum(length_px, each).astype(np.int64) // options.block_px
    here = _steps(photo, at, wanted, [0])[0]
    evident = here * np.sqrt(length_px) > options.min_evidence * fitted.blur_px
    result = (here >= options.strong_grey) | (evident & (length_px > options.long_px))
    rows = np.flatnonzero(evident & ~result)
    if len(rows):
        at = samples(photo.model, arcs.keep(rows), 0.0)
        beside = [np.median(_steps(photo, at, wanted[rows], [side * moved for moved in _MOVED]), axis=0) for side in (-1, 1)]
        result[rows] = here[rows] > options.min_ratio * np.minimum(*beside)
    return result


def _steps(photo: Photo, at: Samples, wanted: Int[np.ndarray, " n"], moved: list[int]) -> Float[np.ndarray, "d n"]:
    """Root mean square over blocks of arcs, as many as `wanted`, of the difference in colour between the two pixels on either
    side of each arc moved across."""
    starts = pieces(at, wanted)
    begins, length = starts[:-1], np.diff(starts)
    owner = at.owner[begins]
    arcs = len(at.starts) - 1
    offsets = np.arange(min(moved) - 2.0, max(moved) + 3.0)
    grey, _ = profiles(photo.picture, at.pixel, at.across, offsets)
    mean = piece_means(grey, starts)
    found = []
    for k in np.array(moved) - min(moved) + 2:
        step = 0.5 * (mean[..., k + 1] + mean[..., k + 2] - mean[..., k - 1] - mean[..., k - 2])
        found.append(np.bincount(owner, length * (step**2).sum(-1), arcs) / np.bincount(owner, length, arcs))
    return np.sqrt(np.stack(found))
