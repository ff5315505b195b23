"""Photo -> smooth curves of edge points, without a camera model.

A line of the world is seen by any lens as a curve that bends slowly. Edge points (`edgels`) are linked as for arcs, but what a
chain is held against is a polynomial of few terms about a circle (`kernels/smooth.py`), not a great circle. The rim of the image
circle is such a curve too, and is left out.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt

from omnilines.extraction.edgels import find_points, grey_unit, noise_level, numbered
from omnilines.extraction.extract import LEAST_NOISE
from omnilines.extraction.image_circle import circle_around, follows_rim, usable_pixels
from omnilines.extraction.joining import joined_pieces
from omnilines.extraction.kernels.chain import chains, links
from omnilines.extraction.kernels.partner import PartnerLimits
from omnilines.extraction.kernels.smooth import SmoothLimits, smooth_pieces
from omnilines.extraction.options import SmoothChainOptions, SmoothOptions

RIM_COSINE = 0.97
BESIDE_PX = 2.0
"""From an edge point, where the colours of its sides are read."""
LAGS = 8
"""Edge points along a chain over which residuals are correlated at most: a piece has more."""
MOST_SIGMAS = 3.0
"""Of a residual, in that correlation."""
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
    limits = _limits((width, height), options)
    begun = _cut(points, order, starts, limits)
    smooth = options.smooth
    joints = PartnerLimits(smooth.max_gap_share, limits.max_curvature, _turn_sigma(smooth))
    side = _towards_light(image, points, begun)[2]
    joined = joined_pieces(points, begun.split(), side, smooth=limits, partner=joints, rounds=smooth.joining_rounds)
    curves = _cut(points, *joined, limits)
    normals, contrast, _ = _towards_light(image, points, curves)
    kept = (contrast >= options.strong_grey) | (contrast * np.sqrt(curves.count) >= options.min_evidence)
    pixels = points[curves.order, :2].astype(np.float64)
    if circle is not None and len(kept):
        kept &= ~_along_rim(circle, curves.count, pixels, normals, options)
    chosen = kept[curves.chain]
    chain = (np.cumsum(kept) - 1)[curves.chain[chosen]]
    return SmoothChains(chain, pixels[chosen], normals[chosen], _sigmas(curves)[curves.chain[chosen]], circle)


@dataclass(frozen=True)
class _Curves:
    """Edge points curve by curve."""

    order: Int[np.ndarray, " points"]
    count: Int[np.ndarray, " k"]
    residual: Float[np.ndarray, " points"]
    scatter: Float[np.ndarray, " k"]

    @property
    def chain(self) -> Int[np.ndarray, " points"]:
        """The curve of each point."""
        return np.repeat(np.arange(len(self.count)), self.count)

    @property
    def starts(self) -> Int[np.ndarray, " k"]:
        """Where each begins."""
        return np.cumsum(self.count) - self.count

    def split(self) -> list[Int[np.ndarray, " _"]]:
        """The points of each."""
        return np.split(self.order, self.starts[1:]) if len(self.count) else []


def _cut(
    points: Float32[np.ndarray, "n 4"], order: Int[np.ndarray, " m"], starts: Int[np.ndarray, " k1"], limits: SmoothLimits
) -> _Curves:
    """Chains cut into smooth curves."""
    pieces, residual, scatter = smooth_pieces(points, order.astype(np.int32), starts, limits)
    count = pieces[:, 1] - pieces[:, 0]
    rows = np.arange(int(count.sum())) + np.repeat(pieces[:, 0] - np.cumsum(count) + count, count)
    return _Curves(order[rows], count, residual[rows], scatter)


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
    return SmoothLimits(
        min_length_px=smooth.min_length_px,
        size_px=half,
        max_curvature=curvature,
        max_scatter_px=smooth.max_scatter_px,
        block=smooth.block_points,
        block_sigmas=smooth.block_sigmas,
        block_floor_px=smooth.block_floor_px,
        corner_points=smooth.corner_points,
        max_turn_rad=smooth.corner_sigmas * _turn_sigma(smooth) + smooth.corner_points * curvature,
    )


def _turn_sigma(smooth: SmoothOptions) -> float:
    """Standard deviation (rad) of the angle at an edge point between two others, `corner_points` to either side."""
    return math.sqrt(6.0) * smooth.corner_sigma_px / smooth.corner_points


def _towards_light(
    image: UInt[np.ndarray, "h w *channels"], points: Float32[np.ndarray, "n 4"], curves: _Curves
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Directions across turned to the brighter side of each curve, its contrast over all channels, and on which side that is: 1
    on the left of the way along it, -1 on the right."""
    if not len(curves.count):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    pixels, across = (points[curves.order, k : k + 2].astype(np.float64) for k in (0, 2))
    height, width = image.shape[:2]
    along = np.gradient(pixels, axis=0)
    first = curves.starts
    along[first] = pixels[first + 1] - pixels[first]
    along[first - 1] = pixels[first - 1] - pixels[first - 2]
    left = np.where((along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0])[:, None] < 0, -across, across)
    sides = []
    for side in (-1, 1):
        column, row = np.rint(pixels + side * BESIDE_PX * left).astype(np.int64).T
        grey = image.reshape(height * width, -1)[row.clip(0, height - 1) * width + column.clip(0, width - 1)]
        sides.append(grey.astype(np.float64) / grey_unit(image))
    step = np.add.reduceat(sides[1] - sides[0], curves.starts) / curves.count[:, None]
    sign = np.where(step.sum(-1) < 0, -1.0, 1.0)
    return left * sign[curves.chain][:, None], np.linalg.norm(step, axis=-1), sign


def _sigmas(curves: _Curves) -> Float[np.ndarray, " k"]:
    """Of each curve, the standard deviation across of points that are taken as independent: their scatter, and that of all
    curves where they are few, times the correlation along the curves of the photo."""
    if not len(curves.count):
        return np.zeros(0)
    chain, scatter, count = curves.chain, curves.scatter, curves.count
    value = np.clip(curves.residual / scatter[chain], -MOST_SIGMAS, MOST_SIGMAS)
    variance, factor = float(np.square(value).mean()), 1.0
    for lag in range(1, LAGS + 1):
        same = chain[lag:] == chain[:-lag]
        correlation = float((value[lag:] * value[:-lag])[same].mean()) / variance
        if correlation <= 0:
            break
        factor += 2.0 * correlation
    pooled = (count * np.square(scatter) + POOLED * float(np.median(scatter)) ** 2) / (count + POOLED)
    sigma: Float[np.ndarray, " k"] = np.sqrt(factor * pooled)
    return sigma
