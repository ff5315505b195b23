"""Arcs fitted to the photo itself: profiles of colour across them, the circle through the places of the edge, and their ends."""

import functools
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from camera_models import CameraModel
from omnilines.extraction.alike import ChromaNoise, ToldChroma, correlation, correlations
from omnilines.extraction.arcs import Arcs, inverse_2x2
from omnilines.extraction.curves import samples
from omnilines.extraction.edgels import grey_unit
from omnilines.extraction.kernels.profile import along_weights, step_filters, supported
from omnilines.extraction.kernels.refit import FIGURES, LAGS, Filters, Limits, refit_arcs
from omnilines.extraction.kernels.tables import Edgels, Picture, Samples
from omnilines.extraction.options import ExtractionOptions, RefitOptions, SupportOptions

SETTLED = 0.25
_ARCS = 4_000
"""Refitted at a time."""


@dataclass(frozen=True)
class Photo:
    """A photo, its camera and its edge points."""

    image: Shaped[np.ndarray, "h w c"]
    model: CameraModel
    edgels: Edgels

    @property
    def picture(self) -> Picture:
        """As compiled loops read it."""
        return Picture(self.image, grey_unit(self.image), self.model.PERIODIC)


@dataclass(frozen=True)
class Refitted:
    """Arcs after a refit, with what it tells of them."""

    arcs: Arcs
    support: Float[np.ndarray, " n"]
    """Share of the arc beside which there are edge points."""
    length_px: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    """Grey levels of 255, root mean square along the arc; of the sum over the channels."""
    blur_px: Float[np.ndarray, " n"]
    """Standard deviation of the blurred step that explains the mean profile best."""
    bend: Float[np.ndarray, " n"]
    """Angle on the arc where it bends; NaN where it does not."""
    settled: Bool[np.ndarray, " n"]
    """Whether the arc moved by less than SETTLED of its standard deviation across it."""
    cut: Arcs
    """What was cut off the arcs as they were: beyond a gap, or on another edge."""
    told: ToldChroma
    """What the arcs, and those of which a refit was told, say of chroma."""

    def keep(self, rows: Bool[np.ndarray, " n"]) -> "Refitted":
        """Some of the arcs; what was cut off and what is told of chroma is that of all."""
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return Refitted(arcs=self.arcs.keep(rows), cut=self.cut, told=self.told, **columns)

    def with_more(self, more: "Refitted") -> "Refitted":
        """These arcs, and others after them; what was cut off the others, and what those were told and tell of chroma."""
        columns = {name: np.concatenate([getattr(self, name), getattr(more, name)]) for name in _COLUMNS}
        return Refitted(arcs=joined([self.arcs, more.arcs]), cut=more.cut, told=more.told, **columns)

    def straight(self) -> Arcs:
        """The arcs, those that bend in two parts, and what was cut off."""
        arcs, bend = self.arcs, self.bend
        bent = bend > arcs.low
        bent &= bend < arcs.high
        before, after = arcs.keep(bent), arcs.keep(bent)
        parts = [replace(before, high=bend[bent]), replace(after, low=bend[bent])]
        return joined([arcs.keep(~bent), *parts, self.cut]).centred()


_COLUMNS = tuple(field.name for field in fields(Refitted) if field.name not in ("arcs", "cut", "told"))


@functools.cache
def _filters(options: RefitOptions) -> Filters:
    windows = np.stack([step_filters(options.taper_px), step_filters(options.wide_taper_px)])
    return Filters(windows, along_weights(options.along_px))


def refit(
    photo: Photo, arcs: Arcs, growth_px: float, min_px: float, options: ExtractionOptions, told: ToldChroma = ToldChroma()
) -> Refitted:
    """Fit arcs anew and let them end where their edges do, at most `growth_px` from where they ended; those that do not come out
    at `min_px` are lost. `told` is what other arcs of the photo say of chroma."""
    limits = Limits(min_px, options.pieces.min_px, options.support, options.refit)
    found, products = np.zeros(len(arcs), dtype=FIGURES), np.zeros((LAGS, 2))
    for k in range(0, len(arcs), _ARCS):
        rows = slice(k, k + _ARCS)
        part = arcs.keep(np.arange(len(arcs))[rows])
        at = samples(photo.model, part, growth_px)
        refit_arcs(
            photo.picture,
            photo.edgels,
            at,
            ends=np.stack([part.low, part.high], -1),
            limits=limits,
            filters=_filters(options.refit),
            table=found[rows],
            products=products,
        )
    return _refitted(arcs, found, correlation(products), told, options.refit)


def joined(parts: list[Arcs]) -> Arcs:
    """Arcs of several tables in one."""
    names = ("normal", "first", "low", "high", "covariance")
    return Arcs(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def support_of(photo: Photo, at: Samples, options: SupportOptions) -> Shaped[np.ndarray, " m"]:
    """Which samples have an edge point of the arc's direction beside them."""
    return supported(photo.edgels, at.pixel, at.across, options) & at.valid


def _refitted(arcs: Arcs, found: Shaped[np.ndarray, " n"], every: float, told: ToldChroma, options: RefitOptions) -> Refitted:
    """Of what `refit_arcs` found; `every` is the correlation of the residuals of all arcs."""
    rows = np.flatnonzero(found["used"] > 0)
    kept, own = arcs.keep(rows), found[rows]
    change = np.stack([own["a"], own["b"]], -1)
    bias = np.stack([own["wide_a"], own["wide_b"]], -1) - change
    matrix = np.stack([np.stack([own["m00"], own["m01"]], -1), np.stack([own["m01"], own["m11"]], -1)], -2)
    noise = ChromaNoise(own["chroma_share"], own["chroma_sum"], own["chroma_squares"], own["squares"])
    told = told.with_more(noise)
    covariance = inverse_2x2(matrix) * (own["variance"] * correlations(noise, told, every))[:, None, None] + _floor(
        kept, own["rate"], options.floor_px
    )
    # What lies beside the edge pulls a wide window more than a narrow one.
    covariance += options.bias_sigmas**2 * bias[:, :, None] * bias[:, None]
    low, high = own["low"], own["high"]
    # Angles are counted from the middle of the arc, which has moved.
    bend = np.where(own["bend_ratio"] > options.min_bend_ratio * every, own["bend"] - 0.5 * (low + high), np.nan)
    cut, settled = [], np.ones(len(rows), dtype=bool)
    for angle in (low, high):
        way = np.stack([np.cos(angle), np.sin(angle)], -1)
        variance = np.einsum("ni,nij,nj->n", way, covariance, way)
        settled &= (way * change).sum(-1) ** 2 < SETTLED**2 * variance
    for side in ("before", "after"):
        ends = found[side + "_low"], found[side + "_high"]
        cut.append(replace(arcs, low=ends[0], high=ends[1]).keep(ends[0] < ends[1]))
    refitted = replace(moved(kept, change, covariance), low=low, high=high).centred()
    return Refitted(
        arcs=refitted,
        support=own["support"],
        length_px=own["length_px"],
        contrast=own["contrast"],
        blur_px=own["blur_px"],
        bend=bend,
        settled=settled,
        cut=joined(cut).centred(),
        told=told,
    )


def moved(arcs: Arcs, change: Float[np.ndarray, "n 2"], covariance: Float[np.ndarray, "n 2 2"]) -> Arcs:
    """Arcs whose normals have changed by a first + b second."""
    normal = arcs.normal + change[:, :1] * arcs.first + change[:, 1:] * arcs.second
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    first = arcs.first - (arcs.first * normal).sum(-1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return Arcs(normal, first, arcs.low, arcs.high, covariance)


def floor_covariance(
    arcs: Arcs, owner: Int[np.ndarray, " m"], rate: Float[np.ndarray, " m"], floor_px: float
) -> Float[np.ndarray, "n 2 2"]:
    """Covariance of a shift of the whole arc and of a turn about its middle that moves its ends by that much; `rate` is in px
    per radian at points of the arcs `owner`."""
    count = np.bincount(owner, minlength=len(arcs))
    return _floor(arcs, np.bincount(owner, rate, len(arcs)) / np.maximum(count, 1), floor_px)


def _floor(arcs: Arcs, rate: Float[np.ndarray, " n"], floor_px: float) -> Float[np.ndarray, "n 2 2"]:
    """As `floor_covariance`, for one rate for each arc."""
    half = np.maximum(0.5 * (arcs.high - arcs.low), 1e-6)
    variance = (floor_px / np.maximum(rate, 1e-9)) ** 2
    result = np.zeros((len(arcs), 2, 2))
    result[:, 0, 0] = variance
    result[:, 1, 1] = variance / np.minimum(np.sin(np.minimum(half, 0.5 * np.pi)), 1.0) ** 2
    return result
