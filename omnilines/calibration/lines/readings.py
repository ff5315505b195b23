"""Edge points of chains as an adjustment takes them, and how far each is from the curve in which its line is seen.

A chain is of one line of the world, which a central camera sees on a great circle with the normal n. Its point x, with the
unit vector m across the edge, lies on the curve n . b(y) = 0 at y = x + t m. The distance t in pixels is the residual. As y lies
on the curve, its derivatives are exact with first derivatives of the model alone: with g = (d b / d pixel)' n at y,

    d t / d n = -b / (g . m),        d t / d parameters = g' (d pixel / d parameters) / (g . m).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.lines.straight import times_seen
from omnilines.geometry.chains import Chains
from omnilines.least_squares import Cells

STEPS = 3
"""Of Newton's method, from an edge point to the curve."""
LEAST_COSINE = 0.5
"""Between the direction across the edge and across the curve; beyond, a point says nothing of where the curve lies."""
FAR_PX = 50.0
"""A point that is farther from a curve is taken to be so far."""
UNDEFINED = 1e-9


@dataclass(frozen=True, eq=False)
class EdgeReadings:
    """n edge points of c chains of some photos, chain after chain."""

    photo: Int[Tensor, " c"]
    photos: int
    chain: Int[Tensor, " n"]
    pixels: Float[Tensor, "n 2"]
    normals: Float[Tensor, "n 2"]
    """Unit, across the edge."""
    sigma_px: Float[Tensor, " n"]
    """Along the normal."""
    times: Float[Tensor, " c"]
    """Number of photos that show each chain at the same place: they say it once."""

    @staticmethod
    def of(chains: Chains) -> "EdgeReadings":
        """The points of a table of chains."""
        pixels, normals, sigma = (torch.as_tensor(a).double() for a in (chains.pixels, chains.normals, chains.sigma_px))
        photo, chain = torch.as_tensor(chains.image).long(), torch.as_tensor(chains.chain).long()
        times = torch.as_tensor(times_seen(chains)).double()
        return EdgeReadings(photo, len(chains.images), chain, pixels, normals, sigma, times)

    @property
    def chains(self) -> int:
        """Number of chains."""
        return len(self.photo)

    @cached_property
    def cells(self) -> Cells:
        """The points of every chain."""
        return Cells(self.chain, self.chains)

    @cached_property
    def counts(self) -> Int[Tensor, " c"]:
        """Points of every chain."""
        return torch.bincount(self.chain, minlength=self.chains)

    def sum_by_chain(self, values: Float[Tensor, "n *shape"]) -> Float[Tensor, "c *shape"]:
        """Sum of values of points over each chain."""
        return values.new_zeros(self.chains, *values.shape[1:]).index_add_(0, self.chain, values)

    def of_chains(self, kept: Bool[Tensor, " c"]) -> "EdgeReadings":
        """Those of some of the chains, which are numbered anew; photos keep their numbers."""
        place = torch.cumsum(kept, 0) - 1
        rows = kept[self.chain]
        return EdgeReadings(
            self.photo[kept],
            self.photos,
            place[self.chain[rows]],
            self.pixels[rows],
            self.normals[rows],
            self.sigma_px[rows],
            self.times[kept],
        )

    def of_points(self, kept: Bool[Tensor, " n"]) -> "EdgeReadings":
        """Some of the points; chains keep their numbers."""
        return replace(
            self, chain=self.chain[kept], pixels=self.pixels[kept], normals=self.normals[kept], sigma_px=self.sigma_px[kept]
        )


@dataclass(frozen=True)
class Offsets:
    """Where the curves of circles pass beside edge points."""

    px: Float[Tensor, " n"]
    """t, along the normal of each point, from the point to the curve."""
    by_circle: Float[Tensor, "n 3"]
    """d t / d n."""
    by_parameter: Float[Tensor, "n p"]
    valid: Bool[Tensor, " n"]
    """Whether the camera sees the point, and its edge runs about along the curve; elsewhere derivatives are 0."""


def offsets(model: CameraModel, readings: EdgeReadings, normal: Float[Tensor, "c 3"]) -> Offsets:
    """Of every point from the curve of its chain's circle."""
    circle, across = normal[readings.chain], readings.normals
    bearing, _ = model.unproject(readings.pixels)
    slope = (_gradient(model, bearing, circle)[0] * across).sum(-1)
    inverse = torch.where(slope.abs() > UNDEFINED, 1.0 / torch.where(slope == 0, 1.0, slope), 0.0)
    t = torch.zeros(len(across), dtype=across.dtype)
    for _ in range(STEPS):
        t = (t - (circle * bearing).sum(-1) * inverse).clamp(-FAR_PX, FAR_PX)
        bearing, valid = model.unproject(readings.pixels + t[:, None] * across)
    gradient, by_parameter, imaged = _gradient(model, bearing, circle)
    slope = (gradient * across).sum(-1)
    valid = valid & imaged & (slope.abs() > LEAST_COSINE * gradient.norm(dim=-1)) & (t.abs() < FAR_PX)
    inverse = torch.where(valid, 1.0 / torch.where(valid, slope, 1.0), 0.0)
    by_pixel = (gradient[:, None] @ by_parameter)[:, 0]
    return Offsets(torch.where(valid, t, 0.0), -bearing * inverse[:, None], by_pixel * inverse[:, None], valid)


def _gradient(
    model: CameraModel, bearing: Float[Tensor, "n 3"], circle: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 p"], Bool[Tensor, " n"]]:
    """g at bearings, d pixel / d parameters, and where they are defined: n . B d = g . (d pixel / d bearing) B d for both
    columns of a basis B across the bearing."""
    _, imaged, by_point, by_parameter = model.project_with_jacobians(bearing)
    basis = tangent_basis(bearing)
    (a, b), (c, d) = (row.unbind(-1) for row in (by_point @ basis).unbind(-2))
    determinant = a * d - b * c
    x, y = (circle[:, None] @ basis)[:, 0].unbind(-1)
    gradient = torch.stack([d * x - c * y, a * y - b * x], -1)
    return torch.where(determinant == 0, 0.0, 1.0 / determinant)[:, None] * gradient, by_parameter, imaged


def fitted_circles(
    model: CameraModel, readings: EdgeReadings, weight: Float[Tensor, " n"] | None = None, rounds: int = 3
) -> tuple[Float[Tensor, "c 3"], Offsets]:
    """The circle of each chain by itself: that of least squares of the bearings, then of the distances in pixels."""
    bearings, seen = model.unproject(readings.pixels)
    weight = readings.sigma_px**-2 if weight is None else weight
    whole = torch.where(seen, weight, 0.0)
    moments = readings.sum_by_chain(whole[:, None, None] * bearings[:, :, None] * bearings[:, None])
    normal = torch.linalg.eigh(moments)[1][..., 0]
    at = offsets(model, readings, normal)
    for _ in range(rounds):
        basis = tangent_basis(normal)
        lever = (at.by_circle[:, None] @ basis[readings.chain])[:, 0]
        weighted = torch.where(at.valid, weight, 0.0)[:, None] * lever
        matrix = readings.sum_by_chain(weighted[:, :, None] * lever[:, None])
        right = readings.sum_by_chain(weighted * at.px[:, None])
        step = -(torch.linalg.pinv(matrix, hermitian=True) @ right[..., None])
        normal = torch.nn.functional.normalize(normal + (basis @ step)[..., 0], dim=-1)
        at = offsets(model, readings, normal)
    return normal, at


def tangent_basis(normal: Float[Tensor, "c 3"]) -> Float[Tensor, "c 3 2"]:
    """Two unit vectors across each."""
    axis = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal.dtype)
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=-1)
    return torch.stack([first, torch.linalg.cross(normal, first)], -1)


def in_blocks(model: CameraModel, readings: EdgeReadings, block_px: float) -> EdgeReadings:
    """Points of each chain averaged over pieces of about `block_px`, each put where its middle point is: on the curve of the
    chain's own circle, off by the mean of the piece. Neighbouring points share their smoothing and say little by themselves."""
    _, at = fitted_circles(model, readings, rounds=1)
    kept = at.valid
    readings, t = readings.of_points(kept), at.px[kept]
    step = torch.zeros(len(t), dtype=t.dtype)
    same = readings.chain[1:] == readings.chain[:-1]
    step[1:] = torch.where(same, (readings.pixels[1:] - readings.pixels[:-1]).norm(dim=-1), 0.0)
    along = torch.cumsum(step, 0)
    first = torch.cumsum(readings.counts, 0) - readings.counts
    along = along - along[first.clamp_max(len(t) - 1)][readings.chain]
    length = along.new_zeros(readings.chains).scatter_reduce_(0, readings.chain, along, "amax")
    pieces = torch.round(length / block_px).clamp_min(3.0)
    piece = torch.minimum(torch.floor(along / (length / pieces).clamp_min(1e-9)[readings.chain]), pieces[readings.chain] - 1)
    key = readings.chain * (int(pieces.max()) + 1) + piece.long()
    _, block = torch.unique_consecutive(key, return_inverse=True)
    count = torch.bincount(block)
    middle = torch.cumsum(count, 0) - count + count // 2
    weight = readings.sigma_px**-2
    total = torch.zeros(len(count), dtype=t.dtype).index_add_(0, block, weight)
    mean = torch.zeros(len(count), dtype=t.dtype).index_add_(0, block, weight * t) / total
    pixels = readings.pixels[middle] + (t[middle] - mean)[:, None] * readings.normals[middle]
    # Points less than a pixel apart are of the same pixels.
    apart = (length / readings.counts.clamp_min(2)).clamp(max=1.0)[readings.chain[middle]]
    sigma = (total * apart).rsqrt()
    return replace(readings, chain=readings.chain[middle], pixels=pixels, normals=readings.normals[middle], sigma_px=sigma)
