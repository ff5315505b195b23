"""Two parallel edges a few pixels apart, told from one.

The frame of a picture or the lip of a shelf is often a strip one to three pixels wide. Its two edges blur into each other: a
single step fitted to them lies between them, or is pulled from the one towards the other. Averaged over some pixels along the
arc, the profile across it tells both: it is fitted with one blurred step and with two, of the photo's own blur.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from omnilines.extraction.arcs import Arcs, samples
from omnilines.extraction.circle_kernel import fit_circles
from omnilines.extraction.double_kernel import two_steps
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.profile_kernel import profiles
from omnilines.extraction.refit import FLOOR_PX, Photo, floor_covariance, moved

OFFSETS_PX = np.arange(-9, 10) * 0.5
TAPER_PX = 2.5
BLOCK_PX = 8
"""Length along an arc over which profiles are averaged."""
BETTER = 0.25
"""Two steps must leave less than this share of what one leaves unexplained."""
LEAST_APART_PX = 0.7
STAIRS_APART_PX = 2.0
"""Least distance of two steps to the same side: nearer ones look like one with more blur."""
LEAST_STEP = 0.2
"""Of the weaker of both steps over the stronger."""
LEAST_GREY = 15.0
MOST_SCATTER_PX = 0.14
"""Root mean square of the places about their circle."""
LEAST_BLOCKS = 3
_STARTS = np.array([[a, a + d] for d in (0.75, 1.25, 1.75, 2.25, 3.0) for a in np.arange(-0.5 - d, 0.6, 0.25)])
"""Places of both steps from which a fit may begin: the arc lies between them, or half a pixel beside."""


@dataclass(frozen=True)
class Split:
    """What became of arcs that might be two edges."""

    arcs: Arcs
    """First the arcs that are one edge, then pairs of edges."""
    rows: Int[np.ndarray, " m"]
    """The arc that each comes from."""
    paired: Bool[np.ndarray, " m"]


def split_doubles(photo: Photo, arcs: Arcs, blur_px: float) -> Split:
    """Put two arcs in the place of each that shows two edges; `blur_px` is the photo's own."""
    if not len(arcs):
        return Split(arcs, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool))
    at = samples(photo.model, arcs, 0.0)
    grey, imaged = profiles(photo.image, grey_unit(photo.image), at.pixel, at.across, OFFSETS_PX, photo.model.PERIODIC)
    number = np.arange(len(at.owner)) - at.starts[at.owner]
    size = np.diff(at.starts)[at.owner]
    blocks = np.maximum(size // BLOCK_PX, 1)
    begins = np.flatnonzero(np.diff(at.owner * 1_000_000 + number * blocks // size, prepend=-1))
    length = np.diff(np.append(begins, len(at.owner)))
    mean = np.add.reduceat(grey, begins, axis=0).astype(np.float64) / length[:, None, None]
    whole = np.minimum.reduceat((imaged & at.valid).astype(np.int8), begins) > 0
    owner = at.owner[begins]
    starts = np.searchsorted(owner, np.arange(len(arcs) + 1))
    weight = np.exp(-0.25 * (OFFSETS_PX / TAPER_PX) ** 2)
    place, colour, single, double = two_steps(mean, OFFSETS_PX, weight, starts, _STARTS, blur_px)
    angle = np.add.reduceat(at.angle, begins) / length
    rate = np.add.reduceat(at.rate, begins) / length
    step = np.linalg.norm(colour, axis=-1)
    enough = np.bincount(owner, whole, len(arcs)) >= LEAST_BLOCKS
    mean_step = np.stack([np.bincount(owner, step[:, k], len(arcs)) for k in (0, 1)], -1) / np.diff(starts)[:, None]
    mean_place = np.stack([np.bincount(owner, place[:, k], len(arcs)) for k in (0, 1)], -1) / np.diff(starts)[:, None]
    doubled = enough & (double < BETTER * single) & (mean_step.min(-1) > np.maximum(LEAST_STEP * mean_step.max(-1), LEAST_GREY))
    stairs = np.bincount(owner, (colour[:, 0] * colour[:, 1]).sum(-1), len(arcs)) > 0
    doubled &= mean_place[:, 1] - mean_place[:, 0] > np.where(stairs, STAIRS_APART_PX, LEAST_APART_PX)
    two = []
    for k in (0, 1):
        fit = fit_circles(starts, angle, rate, place[:, k], step[:, k] ** 2, whole & (np.abs(place[:, k]) < 4.0), 4.0)
        change, inverse, variance, used, _ = fit
        doubled &= (used >= LEAST_BLOCKS) & (variance < MOST_SCATTER_PX**2)
        two.append((change, inverse * variance[:, None, None] + floor_covariance(arcs, at, 2.0 * FLOOR_PX)))
    rows = np.flatnonzero(doubled)
    split = [moved(arcs, change, covariance).keep(rows) for change, covariance in two]
    alone = np.flatnonzero(~doubled)
    names = ("normal", "first", "low", "high", "covariance")
    parts = [arcs.keep(alone), *split]
    return Split(
        Arcs(*(np.concatenate([getattr(part, name) for part in parts]) for name in names)),
        np.concatenate([alone, rows, rows]),
        np.repeat([False, True], [len(alone), 2 * len(rows)]),
    )
