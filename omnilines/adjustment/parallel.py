"""Lines that are all parallel: they leave open where photos were taken along them."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import GeometryError
from omnilines.adjustment.arcs import MatchedArcs
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.robust import noise_level

SURE = 25.0
"""Squared deviation of a direction, in its standard deviations, from which on it is one of its own: chi-square of two degrees of
freedom exceeds it once in 300,000 times."""
ROUNDS = 10
"""Of weighing lines by how far they lie from the direction of the others."""


def require_directions(arcs: MatchedArcs, first: Triangulation) -> None:
    """Raises GeometryError where no two photos see a line of another direction than that of all the others: with poses refined
    and without a prior each photo can then be anywhere along them."""
    apart = _deviations(arcs, first) > SURE
    if len(arcs.image[apart[arcs.track]].unique()) < 2:
        raise GeometryError(
            "Lines of two directions or more were expected where poses are refined, found all of them parallel as far as they "
            "are known: nothing tells where photos were taken along them. Hold the poses (`refine` lines), give "
            "`pose_sigma_deg` and `pose_sigma_m`, or give photos that show edges in other directions."
        )


def _deviations(arcs: MatchedArcs, first: Triangulation) -> Float[Tensor, " t"]:
    """Squared deviations of the directions of lines from the one that most have, in their standard deviations; 0 where these are
    not known. The first column of a frame is the direction, turns about the second and third one move it."""
    known = first.known & torch.isfinite(first.covariance).all(-1).all(-1)
    frame = torch.where(known[:, None, None], first.chart.S, torch.eye(3, dtype=torch.float64))
    own = torch.where(known[:, None, None], first.covariance[:, 1:3, 1:3], torch.eye(2, dtype=torch.float64))
    # Poses that are off move lines by more than their noise does.
    level = noise_level(first.observations) if arcs.sigma_known else 1.0
    information = torch.linalg.pinv(own, hermitian=True) / (level**2 if math.isfinite(level) and level > 1.0 else 1.0)
    square = torch.zeros(len(frame), dtype=torch.float64)
    for _ in range(ROUNDS):
        weight = known / (1.0 + square)
        scatter = (weight[:, None, None] * frame[:, :, :1] @ frame[:, :, :1].mT).sum(0)
        common = torch.linalg.eigh(scatter)[1][:, -1]
        turn = torch.stack([-frame[:, :, 2] @ common, frame[:, :, 1] @ common], -1)
        square = known * (turn[:, None] @ information @ turn[..., None])[:, 0, 0]
    return square
