"""Arcs fitted to the photo itself: profiles of colour across them, the circle through the places of the edge, and their ends."""

import functools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from camera_models import CameraModel
from omnilines.extraction.arcs import Arcs
from omnilines.extraction.bend_kernel import bends
from omnilines.extraction.circle_kernel import fit_circles, reach, trim
from omnilines.extraction.curves import Samples, samples
from omnilines.extraction.edgels import Edgels, grey_unit
from omnilines.extraction.profile_kernel import (
    BLURS_PX,
    OFFSETS_PX,
    TAPER_PX,
    WIDE_TAPER_PX,
    profiles,
    shifts,
    side_differences,
    smoothed,
    step_filters,
    supported,
    unit_steps,
)

WITHIN_PX = 0.8
"""An edge point so near to an arc, and nearly parallel to it, supports it."""
LEAST_COSINE = 0.97
"""Between an arc and an edge point that supports it: 14 degrees."""
MOST_GAP_PX = 5
MOST_SHIFT_PX = 1.5
"""Farther from an arc there is another edge."""
FLOOR_PX = 0.01
"""Standard deviation across the arc that no number of pixels lowers: interpolation, and what the blur's shape hides."""
BIAS = 2.0
"""Standard deviation by what lies beside the edge, over the difference between a wide and a narrow window."""
MOST_OFF_PX = 0.4
"""Mean distance of the last few edge places from an arc that ends there."""
LAST_OFF_PX = 0.25
"""Of the outermost two."""
BEND_PX, BEND_RATIO = 0.8, 20.0
"""An arc bends where the circle through one part passes so far from the end of the other, and two circles gain so much over one:
F of two and n - 4 degrees of freedom, over the correlation of the residuals."""
LEAST_PART = 8
"""Samples on either side of a bend."""
LEAST_CUT = 12
"""Samples cut off an arc that may be one themselves."""
_ARCS = 4_000
"""Refitted at a time."""


@dataclass(frozen=True)
class Photo:
    """A photo, its camera and its edge points."""

    image: Shaped[np.ndarray, "h w c"]
    model: CameraModel
    edgels: Edgels


@dataclass(frozen=True)
class Refitted:
    """Arcs after a refit, with what it tells of them."""

    arcs: Arcs
    rows: Int[np.ndarray, " n"]
    """Of the arcs that went in; some are lost."""
    support: Float[np.ndarray, " n"]
    """Share of the arc beside which there are edge points."""
    length_px: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    """Grey levels of 255, root mean square along the arc; of the sum over the channels."""
    blur_px: Float[np.ndarray, " n"]
    """Standard deviation of the blurred step that explains the mean profile best."""
    bend: Float[np.ndarray, " n"]
    """Angle on the arc where it bends; NaN where it does not."""
    cut: Arcs
    """What was cut off the arcs as they were: beyond a gap, or on another edge."""

    def straight(self) -> Arcs:
        """The arcs, those that bend in two parts, and what was cut off."""
        arcs, bend = self.arcs, self.bend
        bent = bend > arcs.low
        bent &= bend < arcs.high
        before, after = arcs.keep(bent), arcs.keep(bent)
        parts = [replace(before, high=bend[bent]), replace(after, low=bend[bent])]
        return joined([arcs.keep(~bent), *parts, self.cut]).centred()


@functools.cache
def _filters(taper_px: float) -> tuple[np.ndarray, np.ndarray]:
    return step_filters(taper_px)


def refit(photo: Photo, arcs: Arcs, beyond_px: float) -> Refitted:
    """Fit arcs anew and let them end where their edges do, at most `beyond_px` from where they ended."""
    parts = [_refit(photo, arcs, np.arange(k, min(k + _ARCS, len(arcs))), beyond_px) for k in range(0, len(arcs), _ARCS)]
    if not parts:
        nothing = np.zeros(0)
        return Refitted(arcs, np.zeros(0, dtype=np.int64), nothing, nothing, nothing, nothing, nothing, arcs)
    if len(parts) == 1:
        return parts[0]
    names = ("rows", "support", "length_px", "contrast", "blur_px", "bend")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Refitted(arcs=joined([part.arcs for part in parts]), cut=joined([part.cut for part in parts]), **columns)


def joined(parts: list[Arcs]) -> Arcs:
    """Arcs of several tables in one."""
    names = ("normal", "first", "low", "high", "covariance")
    return Arcs(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def support_of(photo: Photo, at: Samples) -> Shaped[np.ndarray, " m"]:
    """Which samples have an edge point of the arc's direction beside them."""
    closed = photo.model.PERIODIC
    edgels = photo.edgels
    return supported(edgels.number, edgels.points, at.pixel, at.across, WITHIN_PX, LEAST_COSINE, closed) & at.valid


def _refit(photo: Photo, whole: Arcs, rows: Int[np.ndarray, " n"], beyond_px: float) -> Refitted:
    arcs = whole.keep(rows)
    at = samples(photo.model, arcs, beyond_px)
    grey, imaged = profiles(photo.image, grey_unit(photo.image), at.pixel, at.across, OFFSETS_PX, photo.model.PERIODIC)
    support = support_of(photo, at) & imaged
    inside = (at.angle >= arcs.low[at.owner]) & (at.angle <= arcs.high[at.owner])
    difference = side_differences(grey, OFFSETS_PX)
    steady = smoothed(difference, support, at.starts)
    found, place, share = reach(at.starts, inside, support & at.valid, difference, steady, MOST_GAP_PX)
    index = np.arange(len(at.owner))
    covered = (found[at.owner, 0] >= 0) & (index >= found[at.owner, 0]) & (index <= found[at.owner, 1])
    usable = support & covered
    steady = smoothed(difference, usable, at.starts)
    step, strength = unit_steps(grey, steady)
    shift, blur = shifts(step, strength, usable, at.starts, *_filters(TAPER_PX))
    change, inverse, variance, used, residual = fit_circles(at.starts, at.angle, at.rate, shift, strength, usable, MOST_SHIFT_PX)
    wide, _ = shifts(step, strength, usable, at.starts, *_filters(WIDE_TAPER_PX))
    bias = fit_circles(at.starts, at.angle, at.rate, wide, strength, usable, MOST_SHIFT_PX)[0] - change
    kept = (used >= 6) & (found[:, 0] >= 0) & (found[:, 1] > found[:, 0])
    correlation = _correlation(residual, at.owner)
    where, ratio, off = bends(at.starts, found, at.angle, at.rate, shift, strength, usable, MOST_SHIFT_PX, LEAST_PART)
    bend = np.where((ratio > BEND_RATIO * correlation) & (off > BEND_PX), at.angle[where], np.nan)
    covariance = inverse * (variance * correlation)[:, None, None]
    covariance += floor_covariance(arcs, at.owner, at.rate, FLOOR_PX)
    # What lies beside the edge pulls a wide window more than a narrow one.
    covariance += BIAS**2 * bias[:, :, None] * bias[:, None]
    on_circle = at.rate * (change[at.owner] * np.stack([np.cos(at.angle), np.sin(at.angle)], -1)).sum(-1)
    trim(found, place, residual, shift + on_circle, MOST_OFF_PX, LAST_OFF_PX)
    cut = _cut(arcs, at, support & at.valid & inside, found)
    low, high = _ends(at, place)
    contrast = np.sqrt(np.bincount(at.owner, strength * usable, len(arcs)) / np.maximum(used, 1))
    refitted = replace(moved(arcs, change, covariance), low=low, high=high).keep(kept).centred()
    # Angles are counted from the middle of the arc, which has moved.
    bend = bend[kept] - 0.5 * (low + high)[kept]
    return Refitted(
        refitted,
        rows[kept],
        share[kept],
        (found[:, 1] - found[:, 0] + 1.0)[kept],
        contrast[kept],
        BLURS_PX[blur.astype(np.int64)][kept],
        bend,
        cut,
    )


def _cut(arcs: Arcs, at: Samples, edge: Bool[np.ndarray, " m"], found: Int[np.ndarray, "n 2"]) -> Arcs:
    """What of the arcs as they were lies before and after the samples found, where that is mostly an edge and long enough."""
    index, total = np.arange(len(edge)), np.concatenate([[0], np.cumsum(edge)])
    first = np.minimum.reduceat(np.where(edge, index, len(edge)), at.starts[:-1])
    last = np.maximum.reduceat(np.where(edge, index, -1), at.starts[:-1])
    begin = np.concatenate([first, found[:, 1] + 1])
    end = np.concatenate([found[:, 0] - 1, last])
    owner = np.tile(np.arange(len(arcs)), 2)
    rows = np.flatnonzero((found[owner, 0] >= 0) & (end - begin >= LEAST_CUT))
    begin, end = begin[rows], end[rows]
    mostly = 2 * (total[end + 1] - total[begin]) > end - begin
    return replace(arcs.keep(owner[rows]), low=at.angle[begin], high=at.angle[end]).keep(mostly).centred()


def moved(arcs: Arcs, change: Float[np.ndarray, "n 2"], covariance: Float[np.ndarray, "n 2 2"]) -> Arcs:
    """Arcs whose normals have changed by a first + b second."""
    normal = arcs.normal + change[:, :1] * arcs.first + change[:, 1:] * arcs.second
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    first = arcs.first - (arcs.first * normal).sum(-1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return Arcs(normal, first, arcs.low, arcs.high, covariance)


def _ends(at: Samples, place: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Angles at fractions of samples; half a sample beyond the outermost ones at most."""
    ends = []
    for side in (0, 1):
        below = np.clip(np.floor(place[:, side]).astype(np.int64), at.starts[:-1], at.starts[1:] - 2)
        share = np.clip(place[:, side] - below, -0.5, 1.5)
        ends.append(at.angle[below] + share * (at.angle[below + 1] - at.angle[below]))
    return ends[0], ends[1]


def _correlation(residual: Float[np.ndarray, " m"], owner: Int[np.ndarray, " m"]) -> float:
    """1 + 2 sum of the correlations of residuals 1, 2, ... px apart, over all arcs: the mean of n of them has that many times
    the variance of independent ones."""
    square = float(np.nanmean(residual**2)) if np.isfinite(residual).any() else 1.0
    total = 1.0
    for lag in range(1, 9):
        product = np.where(owner[lag:] == owner[:-lag], residual[lag:] * residual[:-lag], np.nan)
        known = np.isfinite(product)
        if known.sum() < 50:
            break
        correlation = float(product[known].mean()) / max(square, 1e-12)
        if correlation <= 0.0:
            break
        total += 2.0 * correlation
    return total


def floor_covariance(
    arcs: Arcs, owner: Int[np.ndarray, " m"], rate: Float[np.ndarray, " m"], floor_px: float
) -> Float[np.ndarray, "n 2 2"]:
    """Covariance of a shift of the whole arc and of a turn about its middle that moves its ends by that much; `rate` is in px
    per radian at points of the arcs `owner`."""
    count = np.bincount(owner, minlength=len(arcs))
    mean = np.bincount(owner, rate, len(arcs)) / np.maximum(count, 1)
    half = np.maximum(0.5 * (arcs.high - arcs.low), 1e-6)
    variance = (floor_px / np.maximum(mean, 1e-9)) ** 2
    result = np.zeros((len(arcs), 2, 2))
    result[:, 0, 0] = variance
    result[:, 1, 1] = variance / np.minimum(np.sin(np.minimum(half, 0.5 * np.pi)), 1.0) ** 2
    return result
