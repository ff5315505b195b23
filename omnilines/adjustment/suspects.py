"""Observations that do not fit their line: named by track and photo, whatever was done about them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.noise import largest_square
from omnilines.costs import WHITENED, cost_function
from omnilines.least_squares.variance import NORMAL_MAD


@dataclass(frozen=True)
class Suspect:
    """One observation far from its line."""

    track: str
    image: str
    distance_px: float
    """Of the end that is farther from the line."""


def suspect_rows(arcs: MatchedArcs, normal: Float[Tensor, "n 3"], significance: float) -> Bool[Tensor, " n"]:
    """Arcs whose whitened residuals are too large for the noise of all, which their median tells robustly."""
    whitened, _ = cost_function(WHITENED, arcs)(arcs.bearings, normal)
    finite = torch.isfinite(whitened).all(-1)
    if not bool(finite.any()):
        return finite
    scale = NORMAL_MAD * float(whitened[finite].abs().median())
    return finite & (whitened.square().sum(-1) > largest_square(significance) * max(scale, 1e-12) ** 2)


def suspects(
    arcs: MatchedArcs, normal: Float[Tensor, "n 3"], tracks: tuple[str, ...], images: tuple[str, ...], significance: float
) -> tuple[Suspect, ...]:
    """The suspect observations, the farthest first."""
    rows = torch.nonzero(suspect_rows(arcs, normal, significance)).flatten()
    distance = arcs.orthogonal_px(normal).abs().amax(-1)
    order = rows[torch.argsort(distance[rows], descending=True)].tolist()
    return tuple(Suspect(tracks[int(arcs.track[k])], images[int(arcs.image[k])], float(distance[k])) for k in order)
