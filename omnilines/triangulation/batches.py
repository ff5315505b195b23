"""Triangulation on another device than the observations': tracks in batches that fit into its memory, results brought back."""

from typing import Any

import torch
from torch import Tensor

from omnilines.geometry.line import PlueckerLines
from omnilines.least_squares.devices import free_bytes, moved_to
from omnilines.triangulation import triangulate
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.result import Triangulation

BYTES_AN_OBSERVATION = 4000
"""What a method holds of an observation at most, with the singular vectors of its track."""
MAX_MEMORY_SHARE = 0.5
"""Of the free memory."""


def triangulate_on(
    device: torch.device, method: str, observations: PlaneObservations, at_once: int | None = None, **options: Any
) -> Triangulation:
    """As `triangulate`, worked out on a device; the result lies where the observations do.

    `at_once` bounds the observations of a batch; by default what fits into half of the free memory.
    """
    if device == observations.normal.device and at_once is None:
        return triangulate(method, observations, **options)
    free = free_bytes(device)
    most = at_once or (len(observations.track) if free is None else int(MAX_MEMORY_SHARE * free / BYTES_AN_OBSERVATION))
    home = observations.normal.device
    batch = (observations.counts().cumsum(0) - 1).div(max(1, most), rounding_mode="floor")
    parts: list[Triangulation] = []
    for number in batch.unique().tolist():
        some, _ = observations.of_tracks(torch.nonzero(batch == number).squeeze(-1))
        parts.append(moved_to(triangulate(method, moved_to(some, device), **options), home))

    def joined(values: list[Tensor]) -> Tensor:
        return torch.cat(values)

    lines = PlueckerLines(joined([p.lines.direction for p in parts]), joined([p.lines.moment for p in parts]))
    return Triangulation(
        lines,
        joined([p.status for p in parts]),
        joined([p.views for p in parts]),
        joined([p.plane_angle_rad for p in parts]),
        joined([p.residual_rad for p in parts]),
        observations,
        joined([p.rests_on_one for p in parts]),
    )
