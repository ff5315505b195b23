"""What errors of poses that are held leave uncertain of lines, where it is known how uncertain they are.

With the poses p held a line l minimises the sum over its arcs of w |r(l, p)|^2. Where the pose of one photo moves by e, the line
moves by -H^-1 G e to first order, with the normal matrix H of the line and G = sum of w (dr/dl)' (dr/dp) over its arcs in that
photo. Errors of different photos are taken to be independent. Those of poses found from photos go together where geometry is
weak: of photos along one straight line the covariance is too large then.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.adjustment.arcs import MatchedArcs
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.start import scaled_loss
from omnilines.adjustment.state import LinesAndPoses
from omnilines.pipelines.calibration_errors import charts_of, whole_lines
from omnilines.pipelines.options import SceneOptions
from omnilines.records import ImagePoses, Lines


def errors_by_poses(
    lines: Lines, arcs: MatchedArcs, track: Int[np.ndarray, " n"], poses: ImagePoses, options: SceneOptions
) -> Float[Tensor, "n 4 4"] | None:
    """Covariances from errors of the poses alone, of each line (NaN where there is none); None where poses were refined, which
    lines follow by themselves, or are exact as far as is known.

    The tracks of `arcs` are rows of `lines`; rows of one `track` are stretches of one line.
    """
    if "poses" in options.refine or poses.covariance is None or not lines.known.any():
        return None
    inner, rows, first, line = whole_lines(lines, arcs, track)
    state = LinesAndPoses(poses.cam_from_world, charts_of(lines, rows[first]))
    found = torch.full((len(lines), 4, 4), torch.nan, dtype=torch.float64)
    found[torch.as_tensor(rows)] = _by_line(inner, state, torch.as_tensor(poses.covariance), options)[torch.as_tensor(line)]
    return found


def _by_line(
    arcs: MatchedArcs, state: LinesAndPoses, covariance: Float[Tensor, "images 6 6"], options: SceneOptions
) -> Float[Tensor, "t 4 4"]:
    """Of each track."""
    free = torch.zeros(arcs.images, dtype=torch.bool)
    at = LineProblem(arcs, options.cost, Freedom(free), state).linearise(state)
    loss = scaled_loss(options.loss, options.cost, arcs, state, options.adjustment)
    _, weight = loss(at.residual.square().sum(-1))
    by_line, by_pose = weight.sqrt()[:, None, None] * at.by_eliminated, weight.sqrt()[:, None, None] * at.by_kept[0]
    normal = torch.zeros(arcs.tracks, 4, 4, dtype=torch.float64).index_add_(0, arcs.track, by_line.mT @ by_line)
    pairs, pair = torch.unique(torch.stack([arcs.track, arcs.image]), dim=1, return_inverse=True)
    mixed = torch.zeros(pairs.shape[1], 4, 6, dtype=torch.float64).index_add_(0, pair, by_line.mT @ by_pose)
    unit = normal.diagonal(dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    inverse = torch.linalg.pinv(normal * unit[:, :, None] * unit[:, None], hermitian=True) * unit[:, :, None] * unit[:, None]
    moved = inverse[pairs[0]] @ mixed
    known = torch.nan_to_num(covariance)[pairs[1]]
    return torch.zeros_like(normal).index_add_(0, pairs[0], moved @ known @ moved.mT)
