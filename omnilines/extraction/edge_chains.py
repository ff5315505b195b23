"""Edge points of a photo along the arcs that a camera finds in it: the chains from which that camera is adjusted, or checked."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from camera_models import CameraModel
from omnilines.extraction.curves import samples
from omnilines.extraction.extract import extracted
from omnilines.extraction.kernels.tables import Edgels, Samples
from omnilines.extraction.options import ExtractionOptions, SupportOptions
from omnilines.geometry.chains import Chains

_BESIDE = (0, 1, -1)
"""Pixels across an arc at which its edge point is looked for."""


def arc_chains(
    image: UInt[np.ndarray, "h w *channels"],
    model: CameraModel,
    name: str,
    mask: Bool[np.ndarray, "h w"] | None = None,
    least_angle_rad: float = 0.0,
    options: ExtractionOptions = ExtractionOptions(),
) -> Chains:
    """The edge points of each arc of a photo, in their order along it. Arguments and errors are those of `extract_arcs`.

    The standard deviation of a point is that of its chain: by how much points differ from the line through their neighbours.
    """
    photo, found = extracted(image, model, mask, least_angle_rad, options)
    at = samples(model, found.arcs, 0.0)
    chain, point = _points_beside(photo.edgels, at, options.support)
    pixels, normals = (photo.edgels.points[point, k : k + 2].astype(np.float64) for k in (0, 2))
    count = np.bincount(chain, minlength=len(found))
    long = count >= options.chains.min_points
    rows = long[chain]
    chain = (np.cumsum(long) - 1)[chain[rows]]
    pixels, normals = pixels[rows], normals[rows]
    sigma = scatter_px(chain, pixels, normals)[chain]
    return Chains((name,), model.image_size, np.zeros(int(long.sum()), dtype=np.int64), chain, pixels, normals, sigma)


def _points_beside(edgels: Edgels, at: Samples, options: SupportOptions) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(arc, edge point) of every edge point on an arc, in their order along it."""
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
    return at.owner[rows][first].astype(np.int64), best[rows][first]


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
