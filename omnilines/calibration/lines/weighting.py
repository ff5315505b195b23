"""How much chains count: what of them is straight, and by how much edge points are off."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models import CameraModel
from omnilines.calibration.lines.options import LineOptions
from omnilines.calibration.lines.readings import EdgeReadings, Offsets, fitted_circles, in_blocks
from omnilines.least_squares.variance import NORMAL_MAD


@dataclass(frozen=True)
class WeightedChains:
    """Chains in blocks, each with its circle under a camera."""

    blocks: EdgeReadings
    normal: Float[Tensor, "c 3"]
    at: Offsets
    weight: Float[Tensor, " c"]
    """By which residuals are multiplied: the root of the chain's share, over `scale`; 0 of those left out."""
    misfit: float
    """How far all chains are from straight, Student's negative log likelihood by the stated standard deviations."""
    scale: float
    """Standard deviation of the residuals of straight chains over the stated one."""
    curvature: float
    """Of the robust cost of chains, over that of the weighted squares: weights fall where residuals grow."""

    @property
    def information(self) -> Float[Tensor, " n"]:
        """Of each block on its distance, 1 / px^2."""
        return torch.where(self.at.valid, (self.weight[self.blocks.chain] / self.blocks.sigma_px).square(), 0.0)


def longest(readings: EdgeReadings, most: int) -> EdgeReadings:
    """The chains of each photo with the most points, `most` of them."""
    order = torch.argsort(readings.counts, descending=True, stable=True)
    order = order[torch.argsort(readings.photo[order], stable=True)]
    first = torch.searchsorted(readings.photo[order].contiguous(), torch.arange(readings.photos))
    rank = torch.arange(len(order)) - first[readings.photo[order]]
    kept = torch.zeros(readings.chains, dtype=torch.bool)
    kept[order[rank < most]] = True
    return readings.of_chains(kept)


def weighted_chains(model: CameraModel, readings: EdgeReadings, options: LineOptions) -> WeightedChains:
    """Circles of chains under a camera, and how much each chain counts: Student's t by its sum of squares,

    w = (v + n) / (v + squares / scale^2),    n degrees of freedom, scale by the median chain.
    """
    blocks = in_blocks(model, readings, options.block_px)
    sigma = torch.sqrt(blocks.sigma_px**2 + options.edge_sigma_px**2)
    return weighed(model, replace(blocks, sigma_px=sigma), options)


def weighed(model: CameraModel, blocks: EdgeReadings, options: LineOptions) -> WeightedChains:
    """`weighted_chains` of chains that are in blocks already."""
    normal, at = fitted_circles(model, blocks)
    freedom = (blocks.sum_by_chain(at.valid.double()) - 2.0).clamp_min(0.0)
    squares = blocks.sum_by_chain(torch.square(at.px / blocks.sigma_px))
    variance = _median_variance(squares, freedom)
    share = (options.freedom + freedom) / (options.freedom + squares / variance)
    share = torch.where((share >= options.least_weight) & (freedom > 0), share.clamp(max=1.0), 0.0)
    misfit = 0.5 * ((options.freedom + freedom) * torch.log1p(squares / options.freedom)).sum()
    # A chain has the cost (v + n) log(v + squares) / 2: of n directions of its residuals, it is less curved along one.
    less = torch.where(share < 1.0, 2.0 * (1.0 - options.freedom * share / (options.freedom + freedom)), 0.0)
    curvature = 1.0 - float((share * less).sum() / (share * freedom).sum().clamp_min(1.0))
    curvature = max(curvature, least_curvature(options.freedom))
    return WeightedChains(blocks, normal, at, (share / variance).sqrt(), float(misfit), variance**0.5, curvature)


def least_curvature(freedom: float) -> float:
    """Of a robust cost over that of the weighted squares: half of what is expected of Student's t. Residuals that show less are
    not its, and with enough of these the mean is not even positive."""
    return 0.5 * (freedom + 1.0) / (freedom + 3.0)


def _median_variance(squares: Float[Tensor, " c"], freedom: Float[Tensor, " c"]) -> float:
    """The factor that brings the median chain to the median of its chi-square (E. B. Wilson and M. M. Hilferty, 1931)."""
    told = freedom >= 2.0
    if not bool(told.any()):
        return 1.0
    expected = freedom[told] * (1.0 - 2.0 / (9.0 * freedom[told])) ** 3
    return max(float((squares[told] / expected).median()), 1e-12)


def residual_px(chains: WeightedChains) -> Float[Tensor, " n"]:
    """Distances of the blocks of chains that count from their curves."""
    return chains.at.px[chains.at.valid & (chains.weight[chains.blocks.chain] > 0)]


def robust_px(values: Float[Tensor, " n"]) -> float:
    """Standard deviation by the median absolute value."""
    return NORMAL_MAD * float(values.abs().median()) if len(values) else 0.0


def count_by_photo(chains: WeightedChains) -> Int[Tensor, " v"]:
    """Chains of each photo that count."""
    return torch.bincount(chains.blocks.photo[chains.weight > 0], minlength=chains.blocks.photos)
