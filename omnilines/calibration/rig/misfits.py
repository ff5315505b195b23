"""Whether the model of each camera of a rig follows its lens, by its own corners.

As of one camera (`calibration/model_misfit.py`), fitted by itself: in the rig cameras share the poses of boards, so that what one
model cannot do would show in the residuals of the others too.
"""

import numpy as np
import torch

from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.model_misfit import ModelMisfit, model_misfit
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.least_squares import Outcome


def rig_misfits(outcome: RigOutcome) -> tuple[ModelMisfit | None, ...]:
    """Of each member, at the significance of one camera for all of them together, on the board as the rig has it. Frames of one
    run show the board at one place and count once."""
    data, shape = outcome.data, outcome.solution.state.shape
    corners = data.views.corners
    found: list[ModelMisfit | None] = []
    significance = outcome.thresholds.degeneracy.misfit_significance / len(data.cameras)
    for c in data.cameras:
        own = outcome.alone[c]
        rows = np.flatnonzero(data.views.of_camera(c)[2])
        posed = np.isin(corners.view[rows], corners.view[rows[own.kept]])
        rows, kept = rows[posed], torch.as_tensor(own.kept[posed])
        views, place = np.unique(corners.view[rows], return_inverse=True)
        board_m = shape.place(torch.as_tensor(data.board_m[rows]))
        points = BoardPoints(torch.as_tensor(place), len(views), board_m, torch.as_tensor(corners.pixels[rows]))
        good = points.chosen(kept)
        begin = CameraAndBoards(own.model, resect_boards(good, own.model.unproject(good.pixels)[0]))
        weight = torch.as_tensor(1 / (own.noise.sigma_px * data.relative[rows]))[kept]
        solution = BoardProblem(good, own.basis, weight).solve(begin)
        if solution.outcome is Outcome.DEGENERATE:
            found.append(None)
            continue
        residual = solution.state.residual_px(points)
        limit_px = float(residual[kept].norm(dim=-1).max())
        shown = corners.view[rows]
        if data.runs is not None:
            run = data.runs.run[shown]
            shown = np.where(run >= 0, -1 - run, shown)
        centre_px = solution.state.model.centre_px.detach().numpy()
        found.append(model_misfit(shown, corners.pixels[rows], residual.numpy(), centre_px, limit_px, significance))
    return tuple(found)
