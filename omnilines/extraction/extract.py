"""Photo and camera model -> arcs of straight lines.

Edge points of the photo (`edgels`) are linked into chains and cut where they leave a great circle; pieces of one edge are
joined (`merging`); each arc is fitted to profiles of colour across it in the photo itself and ends where its edge does (`refit`);
what is texture is dropped (`clutter`); edges that only the profiles of others show are added (`hidden_edges`), and edges near
to each other are fitted together (`neighbours`). No view is resampled: the camera model says which bearing a pixel has, so that
a field of view past 180 degrees, a mirror or the seam of a panorama is nothing special.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt

from camera_models import CameraModel, InputError
from omnilines.extraction.arcs import Arcs, across_px, arcs_of_ends, lengths_px
from omnilines.extraction.bearings import bearings_at
from omnilines.extraction.blocks import Profiled, profiled
from omnilines.extraction.clutter import stands_out
from omnilines.extraction.edgels import find_points, noise_level, numbered, seen_chains
from omnilines.extraction.hidden_edges import hidden_arcs
from omnilines.extraction.image_circle import follows_rim, image_circle, usable_pixels
from omnilines.extraction.kernels.chain import chains, circles, links
from omnilines.extraction.merging import duplicates, merged
from omnilines.extraction.neighbours import fit_together, photo_blur
from omnilines.extraction.refit import Photo, Refitted, joined, refit

LEAST_PX = 25.0
"""Shorter arcs are not given back, unless they are asked for."""
LEAST_EDGELS = 9
"""Edge points on one circle with which an arc begins."""
WITHIN_PX = 0.8
"""Edge points so near to a circle belong to it."""
MOST_MISSED = 3
"""Edge points in a row of a chain that may lie farther off."""
LEAST_PIECE_PX, LEAST_PIECE_SUPPORT = 12.0, 0.5
"""Shorter pieces, and those beside which there are fewer edge points, are dropped before they are joined."""
ROUNDS = 2
"""Refits after which pieces are joined."""
LEAST_SUPPORT = 0.65
LEAST_GREY = 6.5
"""Contrast, in grey levels of 255 over all channels."""
BEYOND_PX = 12.0
"""An arc may grow by so much at either end in each of both refits."""
LAST_BEYOND_PX = 4.0
ALONG_PX = 1.0
"""Standard deviation of an end point along its arc."""
HIDDEN_ROUNDS = 2
"""Times that edges beside known ones are looked for."""
LEAST_NOISE = 0.3
"""Grey levels: rounding to whole ones."""
_SAME_PX = 0.6


@dataclass(frozen=True)
class ExtractedArcs:
    """Arcs of one photo, the longest first."""

    arcs: Arcs
    endpoints_px: Float[np.ndarray, "n 2 2"]
    """(row, end, (u, v)). The arc is the shorter way on the great circle between the bearings of both ends; where the image
    closes it may cross the seam."""
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    """Of each end point: what the fit says across the arc, ALONG_PX along it."""
    length_px: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.arcs)


def extract_arcs(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    mask: Bool[np.ndarray, "h w"] | None = None,
    least_angle_rad: float = 0.0,
    least_px: float = LEAST_PX,
) -> ExtractedArcs:
    """The arcs of a photo of 8 or 16 bits a channel, grey or in colour.

    `mask` is true where arcs are wanted. From `least_angle_rad` off the bearing of the centre pixel on, the photo shows the
    scene, not the mount of a mirror. Arcs shorter than `least_px` are not given back.

    Raises InputError where photo or mask have not the size of the camera's images.
    """
    height, width = image.shape[:2]
    for name, size in (("photo", (width, height)), ("mask", (width, height) if mask is None else mask.shape[::-1])):
        if size != model.image_size:
            raise InputError(
                f"A {name} of {model.image_size[0]}x{model.image_size[1]} px was expected, as the camera has, found "
                f"{size[0]}x{size[1]} px; give the one that the calibration is of."
            )
    photo, arcs, noise = _begun(np.ascontiguousarray(image), model, mask, least_angle_rad)
    arcs = merged(photo, arcs)
    for _ in range(ROUNDS):
        fitted = refit(photo, arcs, BEYOND_PX, LEAST_PIECE_PX)
        good = (fitted.support >= LEAST_PIECE_SUPPORT) & (fitted.contrast >= LEAST_GREY)
        arcs = joined([fitted.arcs.keep(good), fitted.cut])
        arcs = merged(photo, arcs)
    least = min(least_px, LEAST_PIECE_PX)
    fitted = refit(photo, arcs, LAST_BEYOND_PX, least)
    # Arcs that bend, what was cut off others, and what still moves.
    done = fitted.settled & np.isnan(fitted.bend)
    fitted = fitted.keep(done).with_more(refit(photo, fitted.keep(~done).straight(), 0.0, least))
    return _finished(photo, fitted, max(noise, LEAST_NOISE), least_px)


def _begun(
    image: UInt[np.ndarray, "h w *channels"], model: CameraModel, mask: Bool[np.ndarray, "h w"] | None, least_angle_rad: float
) -> tuple[Photo, Arcs, float]:
    """The photo with its edge points, the pieces of circles along their chains, and the noise of the photo."""
    height, width = image.shape[:2]
    circle = image_circle(image, model)
    allowed = usable_pixels((height, width), circle, mask)
    noise = noise_level(image, allowed)
    cells, points = find_points(image, model.PERIODIC, allowed, noise)
    if circle is not None:
        scene = ~follows_rim(image, circle, points.astype(np.float64))
        cells, points = cells[scene], points[scene]
    if least_angle_rad > 0.0:
        axis = model.unproject(model.centre_px.detach().numpy())[0]
        scene = bearings_at(model, points[:, :2].astype(np.float64))[0] @ axis < np.cos(least_angle_rad)
        cells, points = cells[scene], points[scene]
    edgels = numbered(model.image_size, cells, points)
    photo = Photo(image.reshape(height, width, -1), model, edgels)
    order, starts = chains(links(edgels.number, cells, points, model.PERIODIC))
    seen = seen_chains(model, points, order, starts, LEAST_EDGELS)
    pieces = circles(seen.starts, seen.bearings, seen.acrosses, LEAST_EDGELS, WITHIN_PX, MOST_MISSED)
    return photo, arcs_of_ends(*pieces), noise


def _finished(photo: Photo, fitted: Refitted, noise: float, least_px: float) -> ExtractedArcs:
    kept = (fitted.length_px >= least_px) & (fitted.support >= LEAST_SUPPORT) & stands_out(photo, fitted)
    arcs = fitted.arcs.keep(kept)
    known = profiled(photo, arcs, noise)
    blur_px = photo_blur(photo.model, known, fitted.contrast[kept])
    arcs = fit_together(photo.model, _with_hidden(photo, known, blur_px, noise), blur_px)
    length_px = lengths_px(photo.model, arcs)
    single = ~duplicates(photo, arcs, length_px, np.arange(len(arcs)), _SAME_PX) & (length_px >= least_px)
    order = np.flatnonzero(single)[np.argsort(-length_px[single], kind="stable")]
    arcs = arcs.keep(order)
    ends, covariance = _end_points(photo.model, arcs)
    return ExtractedArcs(arcs, ends, covariance, length_px[order])


def _with_hidden(photo: Photo, known: Profiled, blur_px: float, noise: float) -> Profiled:
    """The arcs and those that only the profiles of their neighbours show; again beside what was found."""
    rows = np.arange(len(known.arcs))
    for _ in range(HIDDEN_ROUNDS):
        if not len(rows):
            break
        hidden = hidden_arcs(photo.model, known, rows, blur_px, noise)
        if not len(hidden.arcs):
            break
        before = len(known.arcs)
        known = known.with_more(profiled(photo, hidden.arcs, noise))
        number = np.arange(len(known.arcs))
        # What is known already stays: it counts as the longer one.
        rank = lengths_px(photo.model, known.arcs) + np.where(number < before, 1e6, 0.0)
        single = np.flatnonzero(~duplicates(photo, known.arcs, rank, np.maximum(number - before, -1), _SAME_PX))
        again = np.zeros(len(known.arcs), dtype=bool)
        again[before:], again[hidden.beside] = True, True
        known, rows = known.keep(single), np.flatnonzero(again[single])
    return known


def _end_points(model: CameraModel, arcs: Arcs) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2 2 2"]]:
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
        covariances.append(
            variance[:, None, None] * across[:, :, None] * across[:, None] + ALONG_PX**2 * along[:, :, None] * along[:, None]
        )
        pixels.append(pixel)
    return np.stack(pixels, 1), np.stack(covariances, 1)
