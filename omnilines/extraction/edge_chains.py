"""Edge points of a photo along the arcs that a camera finds in it: the chains from which that camera is adjusted, or checked."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from camera_models import CameraModel
from omnilines.extraction.blocks import fit_places, pieces, profiled
from omnilines.extraction.curves import samples
from omnilines.extraction.extract import EVERYWHERE, Extracted, extracted
from omnilines.extraction.kernels.tables import Edgels, Samples
from omnilines.extraction.neighbours import step_fit
from omnilines.extraction.options import ExtractionOptions, SupportOptions
from omnilines.geometry.chains import Chains

_BESIDE = (0, 1, -1)
"""Pixels across an arc at which its edge point is looked for."""


def arc_chains(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    name: str,
    mask: Bool[np.ndarray, "h w"] | None = None,
    known_rad: tuple[float, float] = EVERYWHERE,
    options: ExtractionOptions = ExtractionOptions(),
) -> Chains:
    """The edge points of each arc of a photo, in their order along it. Arguments and errors are those of `extract_arcs`.

    The standard deviation of a point is that of its chain: by how much points differ from the line through their neighbours.
    Where other edges lie beside, which draw edge points away or to themselves, points are moved to where all edges are that
    together make the profile across; by how much that is uncertain is in their standard deviation.
    """
    done = extracted(image, model, mask, known_rad, options)
    at = samples(model, done.found.arcs, 0.0)
    sample, point = _points_beside(done.photo.edgels, at, options.support)
    long = np.bincount(at.owner[sample], minlength=len(done.found)) >= options.chains.min_points
    sample, point = (one[long[at.owner[sample]]] for one in (sample, point))
    chain = (np.cumsum(long) - 1)[at.owner[sample]]
    pixels, normals = (done.photo.edgels.points[point, k : k + 2].astype(np.float64) for k in (0, 2))
    sigma = scatter_px(chain, pixels, normals)[chain]
    shift, variance = _off_neighbours(done, at, sample, pixels, options)
    pixels = pixels + shift[:, None] * at.across[sample]
    sigma = np.sqrt(sigma**2 + variance)
    return Chains((name,), model.image_size, np.zeros(int(long.sum()), dtype=np.int64), chain, pixels, normals, sigma)


def _off_neighbours(
    done: Extracted,
    at: Samples,
    sample: Int[np.ndarray, " n"],
    pixels: Float[np.ndarray, "n 2"],
    options: ExtractionOptions,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How far edge points are to be moved across their arcs, and the variance of that: the points of a piece of an arc with other
    arcs beside it, from their mean to where its own step is in the profile across, where all steps are fitted together."""
    beside, model = options.neighbours, done.photo.model
    known = profiled(done.photo, done.found.arcs, done.noise, beside)
    blocks = known.crossed(model, np.arange(len(done.found)), beside.min_cosine)
    place, variance, _, _ = fit_places(blocks, blocks.place, step_fit(beside, options.refit.taper_px, done.blur_px))
    block = np.searchsorted(pieces(at, np.diff(at.starts) // beside.block_px), sample, side="right") - 1
    off = ((pixels - at.pixel[sample]) * at.across[sample]).sum(-1)
    count = np.maximum(np.bincount(block, minlength=len(place)), 1)
    shift = place[:, 0] - np.bincount(block, off, minlength=len(place)) / count
    moved = blocks.whole & (blocks.count > 1) & (np.abs(shift) < beside.max_shift_px)
    # Points of a piece move together.
    return np.where(moved, shift, 0.0)[block], np.where(moved, variance * count, 0.0)[block]


def _points_beside(edgels: Edgels, at: Samples, options: SupportOptions) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(sample, edge point) of every edge point on an arc, in their order along it."""
    height, width = edgels.number.shape
    best = np.full(len(at.owner), -1)
    least = np.full(len(at.owner), options.within_px)
    for beside in _BESIDE:
        cell = np.round(at.pixel + beside * at.across).astype(np.int64)
        if edgels.closed:
            cell[:, 0] %= width
        inside = at.valid & (cell >= 0).all(-1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        number = np.full(len(cell), -1)
        number[inside] = edgels.number[cell[inside, 1], cell[inside, 0]]
        point = edgels.points[number]
        off = np.abs(((point[:, :2] - at.pixel) * at.across).sum(-1))
        along = np.abs((point[:, 2:] * at.across).sum(-1))
        nearer = (number >= 0) & (along >= options.min_cosine) & (off < least)
        best[nearer], least[nearer] = number[nearer], off[nearer]
    rows = np.flatnonzero(best >= 0)
    key = at.owner[rows] * (len(edgels.points) + 1) + best[rows]
    first = np.sort(np.unique(key, return_index=True)[1])
    return rows[first], best[rows][first]


def scatter_px(
    chain: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " c"]:
    """Standard deviation of the points of each chain across it, from second differences three points apart: a curve has none,
    and points that share their smoothing are not compared."""
    step = 3
    off = ((pixels[2 * step :] - 2 * pixels[step:-step] + pixels[: -2 * step]) * normals[step:-step]).sum(-1)
    same = chain[2 * step :] == chain[: -2 * step]
    count = np.bincount(chain[step:-step][same], minlength=chain.max(initial=-1) + 1)
    total = np.bincount(chain[step:-step][same], np.square(off[same]), minlength=chain.max(initial=-1) + 1)
    return np.sqrt(total / 6.0 / np.maximum(count, 1))
