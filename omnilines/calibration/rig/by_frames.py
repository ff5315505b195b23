"""How certain a rig is where frames differ by more than the noise of corners: boards that move between two shutters, or bend.

The corners of such a frame are wrong together, so that many of them do not average it out. What one frame says of the estimate
is told by leaving it out, with the pose of the target eliminated (`least_squares.groups`); frames in which the target is at one
place, as where it stands still while cameras film it, are left out together.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.places import places
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigState
from omnilines.least_squares.groups import Groups

LEAST_FRAMES = 4


def spread_of_frames(data: RigData, points: RigPoints, state: RigState, squares: float) -> Float[Tensor, "k k"] | None:
    """Covariance of the kept parameters as frames contradict each other; None with too few frames to tell."""
    groups = groups_of_frames(data, points, state, squares)
    return None if groups is None else groups.jackknife()


def groups_of_frames(data: RigData, points: RigPoints, state: RigState, squares: float) -> Groups | None:
    """What each frame adds to the normal equations of the kept parameters; None with too few frames to tell. Frames in which the
    target has moved by no more than so many squares are one, unless too few would be left."""
    groups = _of_each(data, points, state)
    if data.runs is None:
        blocks = torch.unique(points.frame[points.view])
        place = places(state.rig_from_target[blocks], points.board_m, squares)
        groups = groups if int(place.max()) + 1 < LEAST_FRAMES else groups.joined(place)
    return None if len(groups.matrix) < LEAST_FRAMES else groups


def spread_of_runs(data: RigData, points: RigPoints, state: RigState) -> Float[Tensor, " k"] | None:
    """Variance of the kept parameters as runs of frames contradict each other: S^-1 sum g_f g_f' S^-1, where all together would
    have them (K.-Y. Liang and S. Zeger 1986). Few runs only lower that, where they raise the jackknife. None with too few runs to
    tell."""
    each = _of_each(data, points, state)
    matrix, gradient = each.matrix, each.gradient
    runs = len(matrix)
    if runs < LEAST_FRAMES:
        return None
    scale = matrix.sum(0).diagonal().clamp_min(1e-300).rsqrt()
    whole = torch.linalg.cholesky(scale[:, None] * matrix.sum(0) * scale)

    def solved(right: Float[Tensor, "k n"]) -> Float[Tensor, "k n"]:
        return scale[:, None] * torch.cholesky_solve(scale[:, None] * right, whole)

    together = solved(gradient.sum(0)[:, None])
    steps = solved((gradient - (matrix @ together)[..., 0]).mT).mT
    return runs / (runs - 1) * steps.square().sum(0)


def _of_each(data: RigData, points: RigPoints, state: RigState) -> Groups:
    """Of every frame, or run, with corners."""
    problem = data.problem(points)
    return Groups.of_blocks(problem.structure, problem.linearise(state), torch.unique(points.frame[points.view]))
