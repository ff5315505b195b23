"""How straight chains of edge points are under a radial camera that is straight up to its scale.

A pixel at (x, y) from the centre, in units of about the farthest edge point's distance, is seen along the ray

    v = (x, y, h(rho)),    h = 1 + k1 rho^2 + k2 rho^4 + k3 rho^6,    rho^2 = x^2 + y^2,

up to a factor on z. h = 1 is a pinhole, h = 1 + k1 rho^2 the division model (A. Fitzgibbon, CVPR 2001), which for k1 < 0 goes
on past 90 degrees, where h = 0, and holds the stereographic lens; with k2 and k3 others are within 0.2 degrees. A factor on z
moves great circles to great circles: straight lines do not tell it, nor do lines that meet. Right angles do.

For each chain the plane n . v = 0 is fitted by least squares of distances in pixels. What is left is taken apart into polynomials
along the chain, of the second, third and fourth degree. Those of a line of the world have the variance s^2 (noise of the points,
and a stray of the lens); those of another curve s^2 + S^2, where S is that of a bend at random. The ratio of both likelihoods is

    r = sqrt(1 + S^2 / s^2) exp(-e^2 / 2 (1 / s^2 - 1 / (s^2 + S^2))),

and a short chain, which fits any lens, has r near 1. Another curve is bent in the second degree alone (a ring), or in all.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from omnilines.geometry.chains import Chains

NODES = 8
"""Of a chain: means of as many stretches of it."""
LEAST_RATE = 1e-9
SAG_RMS = 0.075
"""Root mean square of a parabola about its chord's best line, over the square of its length times its curvature."""
CELL_PX, TURNS = 4.0, 8
"""Pixels and directions in which edges of several photos are compared: squares of such a side, and parts of half a turn."""
LESS_BENT = 0.25
"""Of S: that of the next degree over that of one."""
BENDS: Float[np.ndarray, "nodes 3"] = np.linalg.qr(np.linspace(-1.0, 1.0, NODES)[:, None] ** np.arange(5))[0][:, 2:]
"""Orthonormal polynomials of the second to the fourth degree at the nodes."""


@dataclass(frozen=True)
class ChainNodes:
    """Chains as a few points each."""

    image: Int[np.ndarray, " chains"]
    pixels: Float[np.ndarray, "chains nodes 2"]
    normals: Float[np.ndarray, "chains nodes 2"]
    sigma_px: Float[np.ndarray, " chains"]
    """Of a node, across."""
    bend_px: Float[np.ndarray, "chains 3"]
    """S: what a bend at random leaves, by degree."""
    weight: Float[np.ndarray, " chains"]
    """One over the number of photos that show the same at the same place."""

    @staticmethod
    def of(chains: Chains, most: int, min_radius_px: float) -> "ChainNodes":
        """Of the `most` longest chains with as many points as nodes; curves bend at random with a radius of `min_radius_px` and
        more."""
        count = np.bincount(chains.chain, minlength=chains.count)
        chosen = np.sort(np.argsort(-count, kind="stable")[:most])
        chosen = chosen[count[chosen] >= NODES]
        start = np.cumsum(count) - count
        part = np.arange(NODES + 1) * count[chosen, None] // NODES
        edges = start[chosen, None] + part

        def means(values: Float[np.ndarray, "points k"]) -> Float[np.ndarray, "chains nodes k"]:
            total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
            mean: Float[np.ndarray, "chains nodes k"] = np.diff(total[edges], axis=1) / np.diff(part, axis=1)[..., None]
            return mean

        pixels, normals = means(chains.pixels), means(chains.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), LEAST_RATE)
        sigma = chains.sigma_px[start[chosen]] / np.sqrt(count[chosen] / NODES)
        length = np.linalg.norm(pixels[:, -1] - pixels[:, 0], axis=-1)
        bend = SAG_RMS * math.sqrt(NODES) * np.square(length) / min_radius_px
        by_degree = bend[:, None] * LESS_BENT ** np.arange(3)
        return ChainNodes(chains.image[chosen], pixels, normals, sigma, by_degree, 1.0 / times_seen(chains)[chosen])

    def rows(self, chosen: Bool[np.ndarray, " chains"]) -> "ChainNodes":
        """Some of them."""
        return ChainNodes(
            self.image[chosen],
            self.pixels[chosen],
            self.normals[chosen],
            self.sigma_px[chosen],
            self.bend_px[chosen],
            self.weight[chosen],
        )

    def __len__(self) -> int:
        return len(self.image)


def times_seen(chains: Chains) -> Float[np.ndarray, " chains"]:
    """Number of photos that show an edge of the same direction where a chain lies, its own included: the median over its points.
    What stands still before the camera, or is fixed to it, says the same in each photo."""
    if not chains.count:
        return np.zeros(0)
    turn = np.mod(np.arctan2(chains.normals[:, 1], chains.normals[:, 0]) / np.pi, 1.0) * TURNS
    place = np.concatenate([chains.pixels / CELL_PX, turn[:, None]], -1)
    photo = chains.image[chains.chain]
    seen = np.zeros(len(photo))
    for shift in (0.0, 0.5):
        cell = np.floor(place + shift).astype(np.int64)
        u, v = (cell[:, :2] - cell[:, :2].min(0)).T
        which = np.unique((u * (v.max() + 1) + v) * TURNS + cell[:, 2] % TURNS, return_inverse=True)[1]
        both = np.unique(which * len(chains.images) + photo)
        seen = np.maximum(seen, np.bincount(both // len(chains.images))[which])
    order = np.lexsort((seen, chains.chain))
    count = np.bincount(chains.chain, minlength=chains.count)
    median: Float[np.ndarray, " chains"] = seen[order][np.cumsum(count) - count + count // 2]
    return median


@dataclass(frozen=True)
class RadialShape:
    """A radial camera up to the scale of z: `terms` k1, k2, k3, lengths in units of `unit_px`."""

    centre: Float[np.ndarray, "2"]
    terms: Float[np.ndarray, "3"]
    unit_px: float

    def height(self, rho: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """h and h' / rho."""
        square = np.square(rho)
        first, second, third = self.terms
        height = 1.0 + square * (first + square * (second + square * third))
        return height, 2.0 * first + square * (4.0 * second + 6.0 * square * third)

    def rises(self, rho: float) -> bool:
        """Whether the angle off axis grows with the radius all the way: h - rho h' > 0."""
        radius = np.linspace(0.0, rho, 50)
        h, slope = self.height(radius)
        return bool((h - np.square(radius) * slope > 0).all())


@dataclass(frozen=True)
class Planes:
    """Planes through chains under a shape."""

    normal: Float[np.ndarray, "chains 3"]
    bend_px: Float[np.ndarray, "chains 3"]
    """Of what is left of the chain beside the curve of its plane, the part of each degree of `BENDS`."""


def planes_of(nodes: ChainNodes, shape: RadialShape) -> Planes:
    """The plane of each chain, nearest to its nodes in pixels."""
    x = (nodes.pixels - shape.centre) / shape.unit_px
    h, slope = shape.height(np.linalg.norm(x, axis=-1))
    ray = np.concatenate([x, h[..., None]], -1)
    m = nodes.normals
    tangent = np.stack([-m[..., 1], m[..., 0]], -1)
    across, along = (np.concatenate([w, (slope * (w * x).sum(-1))[..., None]], -1) for w in (m, tangent))
    local = np.cross(ray, along)
    local /= np.maximum(np.linalg.norm(local, axis=-1, keepdims=True), LEAST_RATE)
    # Change of n . v with a pixel across.
    rate = np.maximum(np.abs((across * local).sum(-1)), LEAST_RATE) / shape.unit_px
    scaled = ray / rate[..., None]
    normal = np.linalg.eigh(np.einsum("cnp,cnq->cpq", scaled, scaled))[1][..., 0]
    side = np.sign(np.einsum("cnp,cp->cn", local, normal).sum(-1, keepdims=True))
    normal = normal * np.where(side == 0, 1.0, side)
    return Planes(normal, np.einsum("cnp,cp->cn", scaled, normal) @ BENDS)


def log_ratio(nodes: ChainNodes, planes: Planes, stray_px: float) -> Float[np.ndarray, " chains"]:
    """log r of each chain, over that of a curve with a bend of the second degree or of all."""
    variance = np.square(nodes.sigma_px[:, None]) + stray_px**2
    wide = variance + np.square(nodes.bend_px)
    ratio = 0.5 * np.log(wide / variance) - 0.5 * np.square(planes.bend_px) * (1.0 / variance - 1.0 / wide)
    total: Float[np.ndarray, " chains"] = math.log(2.0) - np.logaddexp(-ratio[:, 0], -ratio.sum(-1))
    return total


def gain(nodes: ChainNodes, ratio: Float[np.ndarray, " chains"], share: float) -> float:
    """log likelihood of chains of which a share are lines of the world, over that of curves at random."""
    return float(nodes.weight @ np.logaddexp(math.log1p(-share), math.log(share) + ratio))
