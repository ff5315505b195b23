"""Photo -> smooth curves of edge points, without a camera model.

A line of the world is seen by any lens as a curve that bends slowly. Edge points (`edgels`) are linked as for arcs, but what a
chain is held against is a polynomial of few terms about a circle (`kernels/smooth.py`), not a great circle. The rim of the image
circle is such a curve too, and is left out.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from omnilines.extraction.edgels import find_points, grey_unit, noise_level, numbered
from omnilines.extraction.extract import LEAST_NOISE
from omnilines.extraction.image_circle import circle_around, follows_rim, usable_pixels
from omnilines.extraction.kernels.chain import chains, links
from omnilines.extraction.kernels.smooth import SmoothLimits, smooth_pieces
from omnilines.extraction.options import SmoothChainOptions

RIM_COSINE = 0.97
BESIDE_PX = 2.0
"""From an edge point, where the colours of its sides are read."""
LAGS = 12
"""Edge points along a chain over which residuals are correlated at most."""
POOLED = 20.0
"""Edge points that the scatter of all chains counts for in that of one."""


@dataclass(frozen=True)
class SmoothChains:
    """The chains of one photo, as `Chains` holds them for many."""

    chain: Int[np.ndarray, " points"]
    pixels: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]
    sigma_px: Float[np.ndarray, " points"]
    circle: tuple[float, float, float] | None
    """Centre and radius of the image circle, where all is dark outside one."""

    @property
    def count(self) -> int:
        """Number of chains."""
        return int(self.chain[-1]) + 1 if len(self.chain) else 0


def smooth_chains(
    image: UInt[np.ndarray, "h w *channels"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    options: SmoothChainOptions = SmoothChainOptions(),
) -> SmoothChains:
    """The smooth curves of edge points in a photo of 8 or 16 bits a channel, grey or in colour; `mask` is true where they are
    wanted."""
    height, width = image.shape[:2]
    image = np.ascontiguousarray(image)
    circle = circle_around(image, 0.5 * np.array([width - 1.0, height - 1.0]), options.image_circle)
    allowed = usable_pixels((height, width), circle, mask, options.image_circle)
    noise = max(noise_level(image, allowed), LEAST_NOISE)
    cells, points = find_points(image, False, allowed, noise, options.edges)
    if circle is not None:
        scene = ~follows_rim(image, circle, points.astype(np.float64), RIM_COSINE, options.image_circle)
        cells, points = cells[scene], points[scene]
    edgels = numbered((width, height), False, cells, points)
    order, starts = chains(links(edgels, cells, options.min_cosine))
    pieces, residual, scatter = smooth_pieces(points, order, starts, _limits((width, height), options))
    count = pieces[:, 1] - pieces[:, 0]
    chain = np.repeat(np.arange(len(pieces)), count)
    rows = np.arange(len(chain)) + np.repeat(pieces[:, 0] - np.cumsum(count) + count, count)
    pixels, across = (points[order[rows], k : k + 2].astype(np.float64) for k in (0, 2))
    normals, contrast = _towards_light(image, chain, count, pixels, across)
    kept = (contrast >= options.strong_grey) | (contrast * np.sqrt(count) >= options.min_evidence)
    if circle is not None and len(count):
        kept &= ~_along_rim(circle, count, pixels, normals, options)
    sigma = _sigmas(residual[rows], chain, count, scatter)
    chosen = kept[chain]
    renumbered = np.cumsum(kept) - 1
    return SmoothChains(renumbered[chain[chosen]], pixels[chosen], normals[chosen], sigma[chain[chosen]], circle)


def _along_rim(
    circle: tuple[float, float, float],
    count: Int[np.ndarray, " k"],
    pixels: Float[np.ndarray, "points 2"],
    normals: Float[np.ndarray, "points 2"],
    options: SmoothChainOptions,
) -> Bool[np.ndarray, " k"]:
    """Which chains are part of the slope of light at the rim: near it, along it from end to end, and darker outside."""
    u, v, radius = circle
    outwards = pixels - np.array([u, v])
    distance = np.linalg.norm(outwards, axis=-1)
    inwards = -(outwards * normals).sum(-1) / np.maximum(distance, 1e-9)
    starts = np.cumsum(count) - count
    near = np.minimum.reduceat(distance, starts) > (1.0 - options.image_circle.slope_share) * radius
    return near & (np.minimum.reduceat(inwards, starts) > RIM_COSINE)


def _limits(size: tuple[int, int], options: SmoothChainOptions) -> SmoothLimits:
    smooth, half = options.smooth, 0.5 * math.hypot(*size)
    curvature = 1.0 / (smooth.min_radius_share * half)
    turn = smooth.corner_sigmas * math.sqrt(6.0) * smooth.corner_sigma_px / smooth.corner_points
    return SmoothLimits(
        min_length_px=smooth.min_length_px,
        size_px=half,
        max_curvature=curvature,
        max_scatter_px=smooth.max_scatter_px,
        block=smooth.block_points,
        block_sigmas=smooth.block_sigmas,
        block_floor_px=smooth.block_floor_px,
        corner_points=smooth.corner_points,
        max_turn_rad=turn + smooth.corner_points * curvature,
    )


def _towards_light(
    image: UInt[np.ndarray, "h w *channels"],
    chain: Int[np.ndarray, " points"],
    count: Int[np.ndarray, " k"],
    pixels: Float[np.ndarray, "points 2"],
    across: Float[np.ndarray, "points 2"],
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " k"]]:
    """Directions across turned to the brighter side of each chain, and the contrast of each over all channels."""
    height, width = image.shape[:2]
    starts = np.cumsum(count) - count
    # One side of each chain: left of the way along it.
    along = np.gradient(pixels, axis=0) if len(pixels) > 1 else np.zeros_like(pixels)
    first = starts[1:] if len(starts) else starts
    along[first] = pixels[np.minimum(first + 1, len(pixels) - 1)] - pixels[first]
    along[first - 1] = pixels[first - 1] - pixels[first - 2]
    left = np.where((along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0])[:, None] < 0, -across, across)
    sides = []
    for side in (-1, 1):
        column, row = np.rint(pixels + side * BESIDE_PX * left).astype(np.int64).T
        grey = image.reshape(height * width, -1)[row.clip(0, height - 1) * width + column.clip(0, width - 1)]
        sides.append(grey.astype(np.float64) / grey_unit(image))
    step = np.add.reduceat(sides[1] - sides[0], starts) / count[:, None] if len(starts) else np.zeros((0, 1))
    sign = np.where(step.sum(-1) < 0, -1.0, 1.0)
    return left * sign[chain][:, None], np.linalg.norm(step, axis=-1)


def _sigmas(
    residual: Float[np.ndarray, " points"],
    chain: Int[np.ndarray, " points"],
    count: Int[np.ndarray, " k"],
    scatter: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Of each chain, the standard deviation across of points that are taken as independent: their scatter, and that of all
    chains where they are few, times the correlation along the chains of the photo."""
    if not len(count):
        return np.zeros(0)
    typical = float(np.median(scatter))
    value = residual / scatter[chain]
    value = np.clip(value, -3.0, 3.0)
    variance, factor = float(np.square(value).mean()), 1.0
    for lag in range(1, LAGS + 1):
        same = chain[lag:] == chain[:-lag]
        correlation = float((value[lag:] * value[:-lag])[same].mean()) / variance if same.any() else 0.0
        if correlation <= 0:
            break
        factor += 2.0 * correlation
    pooled = (count * np.square(scatter) + POOLED * typical**2) / (count + POOLED)
    sigma: Float[np.ndarray, " k"] = np.sqrt(factor * pooled)
    return sigma
