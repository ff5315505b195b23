"""By how much corners lie farther off in a rig than where each camera has its board poses for itself, by chance alone.

Alone, six unknowns of each view follow the noise of its corners; in the rig cameras share the pose of a frame, by how much each
tells of it. With C_fc what camera c adds to the normal equations of frame f, C_f = sum_c C_fc, the corners of c have taken
sum_f tr(C_f^-1 C_fc) of the poses: 6 of each view alone, half of it beside a camera like it, and hardly any where it counts
little. With few corners a view, that is more than a few percent.
"""

import math

import torch
from torch import Tensor

from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigState
from omnilines.least_squares.schur import normal_equations


def beside_alone(data: RigData, points: RigPoints, state: RigState) -> tuple[float, ...]:
    """Of each member, the expected ratio of root mean square residuals; 1 where views have a motion of their own, which takes as
    much as poses of their own do."""
    if data.motion is not None:
        return (1.0,) * len(data.bases)
    problem, camera = data.problem(points), points.camera[points.view]
    at, blocks = problem.linearise(state), torch.unique(points.frame[points.view])

    def of(rows: Tensor) -> Tensor:
        return normal_equations(problem.structure, at, rows.to(torch.float64)).eliminated[blocks]

    whole, found = torch.linalg.inv(of(camera >= 0)), []
    for k, basis in enumerate(data.bases):
        own, views = camera == k, len(torch.unique(points.view[camera == k]))
        rest = 2 * int(own.sum()) - basis.shape[1]
        taken = float((whole * of(own)).sum())
        alone = rest - 6 * views
        found.append(math.sqrt(max(1.0, (rest - taken) / alone)) if alone > 0 else 1.0)
    return tuple(found)
