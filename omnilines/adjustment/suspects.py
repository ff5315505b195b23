"""Observations that do not fit their line: named by track and photo, whatever was done about them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from omnilines.adjustment.arcs import Arcs
from omnilines.adjustment.noise import LIMIT, NORMAL_MAD
from omnilines.costs import cost_function


@dataclass(frozen=True)
class Suspect:
    """One observation far from its line."""

    track: str
    image: str
    distance_px: float
    """Of the end that is farther from the line."""


def suspect_rows(arcs: Arcs, normal: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Arcs whose squared whitened residual exceeds LIMIT times the variance of all, which is told robustly from their median."""
    whitened, _ = cost_function("whitened", arcs)(arcs.bearings, normal)
    finite = torch.isfinite(whitened).all(-1)
    if not bool(finite.any()):
        return finite
    scale = NORMAL_MAD * float(whitened[finite].abs().median())
    return finite & (whitened.square().sum(-1) > LIMIT * max(scale, 1e-12) ** 2)


def suspects(arcs: Arcs, normal: Float[Tensor, "n 3"], tracks: tuple[str, ...], images: tuple[str, ...]) -> tuple[Suspect, ...]:
    """The suspect observations, the farthest first."""
    rows = torch.nonzero(suspect_rows(arcs, normal)).flatten()
    distance = arcs.orthogonal_px(normal).abs().amax(-1)
    order = rows[torch.argsort(distance[rows], descending=True)].tolist()
    return tuple(Suspect(tracks[int(arcs.track[k])], images[int(arcs.image[k])], float(distance[k])) for k in order)
