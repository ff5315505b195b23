"""Photo and camera model -> arcs of straight lines.

Edge points of the photo (`edgels`) are linked into chains and cut where they leave a great circle; pieces of one edge are
joined (`merging`); each arc is fitted to profiles of colour across it in the photo itself and ends where its edge does (`refit`);
what is texture is dropped (`clutter`); edges that only the profiles of others show are added (`hidden_edges`), and edges near
to each other are fitted together (`neighbours`). No view is resampled: the camera model says which bearing a pixel has, so that
a field of view past 180 degrees, a mirror or the seam of a panorama is nothing special.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from camera_models import CameraModel, InputError
from omnilines.extraction.arcs import Arcs, across_px, arcs_of_ends, lengths_px, spans
from omnilines.extraction.bearings import bearings_at
from omnilines.extraction.blocks import Profiled, profiled
from omnilines.extraction.clutter import stands_out
from omnilines.extraction.edgels import find_points, noise_level, numbered, seen_chains
from omnilines.extraction.hidden_edges import hidden_arcs
from omnilines.extraction.image_circle import follows_rim, image_circle, usable_pixels
from omnilines.extraction.kernels.chain import chains, circles, links
from omnilines.extraction.merging import duplicates, merged
from omnilines.extraction.mirror import off_mount, within_rim
from omnilines.extraction.neighbours import fit_together, photo_blur
from omnilines.extraction.options import ExtractionOptions
from omnilines.extraction.refit import Photo, Refitted, joined, refit
from omnilines.photo_size import wrong_size

EVERYWHERE = (0.0, math.inf)
"""Angles between which a calibration is known that says nothing of that."""
LEAST_NOISE = 0.3
"""Grey levels: rounding to whole ones."""


@dataclass(frozen=True)
class ExtractedArcs:
    """Arcs of one photo, the longest first."""

    arcs: Arcs
    endpoints_px: Float[np.ndarray, "n 2 2"]
    """(row, end, (u, v)). The arc is the shorter way on the great circle between the bearings of both ends; where the image
    closes it may cross the seam."""
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    """Of each end point: what the fit says across the arc, `along_sigma_px` along it."""
    length_px: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.arcs)


def extract_arcs(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    mask: Bool[np.ndarray, "h w"] | None = None,
    known_rad: tuple[float, float] = EVERYWHERE,
    options: ExtractionOptions = ExtractionOptions(),
) -> ExtractedArcs:
    """The arcs of a photo of 8 or 16 bits a channel, grey or in colour.

    `mask` is true where arcs are wanted. `known_rad` is between which angles off the bearing of the centre pixel the calibration
    is known: nearer to it the photo shows the mount of a mirror, and the rim of the mirror lies farther off.

    Raises InputError where photo or mask have not the size of the camera's images.
    """
    return extracted(image, model, mask, known_rad, options).found


@dataclass(frozen=True)
class Extracted:
    """The arcs of a photo, and what they were found with."""

    photo: Photo
    """With its edge points."""
    found: ExtractedArcs
    noise: float
    """Grey levels of 255."""
    blur_px: float


def extracted(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    mask: Bool[np.ndarray, "h w"] | None,
    known_rad: tuple[float, float],
    options: ExtractionOptions,
) -> Extracted:
    """`extract_arcs`, with all that they come from."""
    height, width = image.shape[:2]
    for name, size in (("photo", (width, height)), ("mask", (width, height) if mask is None else mask.shape[::-1])):
        if (why := wrong_size(name, size, model.image_size)) is not None:
            raise InputError(why)
    photo, arcs, noise = _begun(np.ascontiguousarray(image), model, mask, known_rad, options)
    pieces, join = options.pieces, functools.partial(merged, photo, options=options.merging, support=options.support)
    arcs = join(arcs)
    for _ in range(pieces.rounds):
        fitted = refit(photo, arcs, pieces.max_growth_px, pieces.min_px, options)
        good = (fitted.support >= pieces.min_support) & (fitted.contrast >= pieces.min_grey)
        arcs = joined([fitted.arcs.keep(good), fitted.cut])
        arcs = join(arcs)
    least = min(options.min_length_px, pieces.min_px)
    fitted = refit(photo, arcs, options.refit.max_growth_px, least, options)
    # Arcs that bend, what was cut off others, and what still moves.
    done = fitted.settled & np.isnan(fitted.bend)
    fitted = fitted.keep(done).with_more(
        refit(photo, fitted.keep(~done).straight(), options.refit.max_growth_px, least, options, fitted.told)
    )
    noise = max(noise, LEAST_NOISE)
    found, blur_px = _finished(photo, fitted, noise, options)
    return Extracted(photo, found, noise, blur_px)


def _begun(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    mask: Bool[np.ndarray, "h w"] | None,
    known_rad: tuple[float, float],
    options: ExtractionOptions,
) -> tuple[Photo, Arcs, float]:
    """The photo with its edge points, the pieces of circles along their chains, and the noise of the photo."""
    height, width = image.shape[:2]
    circle = image_circle(image, model, options.image_circle)
    allowed = usable_pixels((height, width), circle, mask, options.image_circle)
    noise = noise_level(image, allowed)
    cells, points = find_points(image, model.PERIODIC, allowed, noise, options.edges)
    if circle is not None:
        scene = ~follows_rim(image, circle, points.astype(np.float64), options.support.min_cosine, options.image_circle)
        cells, points = cells[scene], points[scene]
    scene = within_rim(model, points, known_rad[1], options) & off_mount(model, points, known_rad[0])
    cells, points = cells[scene], points[scene]
    edgels = numbered(model.image_size, model.PERIODIC, cells, points)
    photo = Photo(image.reshape(height, width, -1), model, edgels)
    order, starts = chains(links(edgels, cells, options.chains.min_cosine))
    seen = seen_chains(model, points, order, starts, options.chains.min_points)
    pieces = circles(seen, options.support.within_px, options.chains)
    return photo, arcs_of_ends(*pieces), noise


def _finished(photo: Photo, fitted: Refitted, noise: float, options: ExtractionOptions) -> tuple[ExtractedArcs, float]:
    """The arcs, and the blur of the photo."""
    kept = (fitted.length_px >= options.min_length_px) & (fitted.support >= options.min_support)
    kept &= stands_out(photo, fitted, options.clutter)
    arcs = fitted.arcs.keep(kept)
    known = profiled(photo, arcs, noise, options.neighbours)
    blur_px, beside = photo_blur(photo.model, known, fitted.contrast[kept], options)
    known = _with_hidden(photo, known, blur_px, max(noise, beside), options)
    arcs = fit_together(photo.model, known, blur_px, options.neighbours, options.refit)
    length_px = lengths_px(photo.model, arcs)
    rate = spans(photo.model, arcs)[1]
    single = ~_twice(photo, arcs, length_px, rate, np.arange(len(arcs)), options=options) & (length_px >= options.min_length_px)
    single &= ends_seen(photo.model, arcs)
    order = np.flatnonzero(single)[np.argsort(-length_px[single], kind="stable")]
    arcs = arcs.keep(order)
    ends, covariance = _end_points(photo.model, arcs, options.along_sigma_px)
    return ExtractedArcs(arcs, ends, covariance, length_px[order]), blur_px


def ends_seen(model: CameraModel, arcs: Arcs) -> Bool[np.ndarray, " n"]:
    """Arcs whose ends the camera sees with what lies a pixel to either side of them: along the edge of its domain, where pixels
    no longer change with the bearing, an arc could lie degrees off."""
    row, size = np.arange(len(arcs)), np.array(model.image_size)
    seen = np.ones(len(arcs), dtype=bool)
    for angle in (arcs.low, arcs.high):
        pixel, across, _, valid = across_px(model, arcs, row, angle)
        seen &= valid
        for beside in (pixel - across, pixel + across):
            outside = ((beside < -0.5) | (beside > size - 0.5)).any(-1)
            seen &= outside | bearings_at(model, beside)[1]
    return seen


def _twice(
    photo: Photo,
    arcs: Arcs,
    rank: Float[np.ndarray, " n"],
    rate: Float[np.ndarray, " n"],
    kin: Int[np.ndarray, " n"],
    *,
    options: ExtractionOptions,
) -> Bool[np.ndarray, " n"]:
    """The `duplicates` among arcs that are fitted for good."""
    same_px, max_normal_rad = options.neighbours.same_px, options.merging.max_normal_rad
    return duplicates(photo, arcs, rank, rate, kin, same_px=same_px, max_normal_rad=max_normal_rad)


def _with_hidden(photo: Photo, known: Profiled, blur_px: float, noise: float, options: ExtractionOptions) -> Profiled:
    """The arcs and those that only the profiles of their neighbours show; again beside what was found."""
    rows = np.arange(len(known.arcs))
    for _ in range(options.hidden.rounds):
        if not len(rows):
            break
        hidden = hidden_arcs(photo.model, known, rows, blur_px, noise, options=options.hidden, neighbours=options.neighbours)
        if not len(hidden.arcs):
            break
        before = len(known.arcs)
        every = joined([known.arcs, hidden.arcs])
        number = np.arange(len(every))
        # What is known already stays: it counts as the longer one.
        length_px, rate = spans(photo.model, every)
        rank = length_px + np.where(number < before, 1e6, 0.0)
        single = np.flatnonzero(~_twice(photo, every, rank, rate, np.maximum(number - before, -1), options=options))
        again = np.zeros(len(every), dtype=bool)
        again[before:], again[hidden.beside] = True, True
        known, rows, new = known.keep(single[single < before]), np.flatnonzero(again[single]), single[single >= before]
        if not len(new):
            break
        known = known.with_more(profiled(photo, every.keep(new), noise, options.neighbours))
    return known


def _end_points(
    model: CameraModel, arcs: Arcs, along_sigma_px: float
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2 2 2"]]:
    """Pixels of the ends and their covariances: of the circle at angle t, (cos t, sin t) C (cos t, sin t)' rad^2 across."""
    pixels, covariances = [], []
    row = np.arange(len(arcs))
    for angle in (arcs.low, arcs.high):
        pixel, across, rate, _ = across_px(model, arcs, row, angle)
        if model.PERIODIC:
            pixel[:, 0] = np.mod(pixel[:, 0] + 0.5, model.image_size[0]) - 0.5
        way = np.stack([np.cos(angle), np.sin(angle)], -1)
        variance = np.einsum("ni,nij,nj->n", way, arcs.covariance, way) * rate**2
        along = np.stack([across[:, 1], -across[:, 0]], -1)
        across_px2 = variance[:, None, None] * across[:, :, None] * across[:, None]
        covariances.append(across_px2 + along_sigma_px**2 * along[:, :, None] * along[:, None])
        pixels.append(pixel)
    return np.stack(pixels, 1), np.stack(covariances, 1)
