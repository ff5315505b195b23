"""The line of the best rank-2 approximation of the stacked planes (Hartley and Zisserman 2003, section 12.7; 3.34).

The rows are (n, s / rho) with the origin at the focus of the track (`frames.py`), which makes the two parts commensurate.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.geometry.line import PlueckerLines
from omnilines.triangulation.degeneracy import assess, gather
from omnilines.triangulation.frames import solvable_groups, track_frames
from omnilines.triangulation.observations import PlaneObservations
from omnilines.triangulation.options import TriangulationOptions
from omnilines.triangulation.result import Triangulation


def rank_two_lines(planes: Float[Tensor, "*batch k 4"]) -> PlueckerLines:
    """The intersection of the two leading right singular vectors of stacked planes (n, s)."""
    leading = torch.linalg.svd(planes, full_matrices=False).Vh
    first, second = leading[..., 0, :], leading[..., 1, :]
    return PlueckerLines.from_planes(first[..., :3], first[..., 3], second[..., :3], second[..., 3])


def triangulate(
    observations: PlaneObservations, *, sigma_rad: float | None = None, options: TriangulationOptions = TriangulationOptions()
) -> Triangulation:
    """The lines of all tracks; `sigma_rad` and `options` as in `degeneracy.assess`."""
    frames = track_frames(observations)
    solved = []
    for group in solvable_groups(observations, frames):
        s = group.offsets(group.focus) / group.unit[:, None]
        local = rank_two_lines(torch.cat([group.normal, s[..., None]], -1))
        metric = PlueckerLines(local.direction, local.moment * group.unit[:, None])
        solved.append((group.tracks, metric.shifted(-group.focus)))
    return assess(observations, frames, gather(solved, frames), sigma_rad, options=options.degeneracy)
