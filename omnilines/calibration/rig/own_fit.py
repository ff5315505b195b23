"""One camera of a rig fitted by its own corners, on the board as the rig has it.

In the rig cameras share the poses of boards, so that what one of them cannot do would show in the residuals of the others too.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.places import places
from omnilines.least_squares import Solution


@dataclass(frozen=True, eq=False)
class OwnFit:
    """Of the views with a pose of their own."""

    rows: Int[np.ndarray, " n"]
    """Rows of the table."""
    kept: Bool[Tensor, " n"]
    """Corners that fit the camera alone, of which the solution is."""
    points: BoardPoints
    """All of them."""
    weight: Float[Tensor, " k"]
    """Of the corners that are kept."""
    photo: Int[np.ndarray, " n"]
    """Which photo a corner is of: frames of one run, and those that show the board at one place, are one."""
    solution: Solution[CameraAndBoards]

    @property
    def good(self) -> BoardPoints:
        """The corners that are kept."""
        return self.points.chosen(self.kept)


def own_fit(outcome: RigOutcome, camera: int) -> OwnFit:
    """Of a camera of the table; its intrinsics are held where the rig's are."""
    data, own = outcome.data, outcome.alone[camera]
    corners = data.views.corners
    rows = np.flatnonzero(data.views.of_camera(camera)[2])
    posed = np.isin(corners.view[rows], corners.view[rows[own.kept]])
    rows, kept = rows[posed], torch.as_tensor(own.kept[posed])
    views, place = np.unique(corners.view[rows], return_inverse=True)
    board_m = outcome.solution.state.shape.place(torch.as_tensor(data.board_m[rows]))
    points = BoardPoints(torch.as_tensor(place), len(views), board_m, torch.as_tensor(corners.pixels[rows]))
    good = points.chosen(kept)
    begin = CameraAndBoards(own.model, resect_boards(good, own.model.unproject(good.pixels)[0]))
    weight = torch.as_tensor(1 / (own.noise.sigma_px * data.relative[rows]))[kept]
    solution = BoardProblem(good, own.basis, weight).solve(begin)
    squares = outcome.thresholds.rig.one_place_squares
    photo = places(solution.state.cam_from_board, points.board, squares)[points.view].numpy()
    if data.runs is not None:
        run = data.runs.run[corners.view[rows]]
        photo = np.where(run >= 0, -1 - run, photo)
    return OwnFit(rows, kept, points, weight, photo, solution)
