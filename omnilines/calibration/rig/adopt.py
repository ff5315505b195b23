"""Views that no camera could use alone, taken into the rig where it sees them as predicted: few corners, corners on one line,
another numbering. At the rim of wide lenses these may be all that two cameras have in common."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from camera_models import CameraModel
from camera_models.pose import Pose
from omnilines.calibration.rig.joint import RigData
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.start import ViewNumberings


def adopted_views(
    data: RigData,
    state: RigState,
    options: ViewNumberings,
    handed: dict[int, bool],
    candidates: Iterable[int],
    *,
    agreeing_squares: float,
) -> dict[int, Pose]:
    """Of the candidates those whose board is where the rig says, with the numbering under which it is.

    `handed` says of each member whether its boards are numbered as in a mirror, `agreeing_squares` how far off
    corners may be.
    """
    views, corners = data.views, data.views.corners
    found = {}
    for view in candidates:
        member, part = data.cameras.index(int(views.camera[view])), data.boards.index(int(views.part[view]))
        rows = corners.view == view
        motions = options.of(view)
        motions = motions[(motions.rotation[:, 2, 2] < 0) == handed[member]]
        if not len(motions):
            continue
        predicted = state.cam_from_rig[member] @ state.rig_from_target[int(views.block[view])] @ state.target_from_board[part]
        places = motions.transform(torch.as_tensor(corners.board_m[rows]).expand(len(motions), -1, -1))
        pitch = options.pitch_m[int(views.board[view])]
        off = _off(state.models[member], predicted, places, torch.as_tensor(corners.pixels[rows]), pitch)
        best = int(off.argmin())
        if float(off[best]) < agreeing_squares:
            # The numbering as it is, unless it is plainly worse.
            found[view] = motions[0 if float(off[0]) < agreeing_squares else best]
    return found


def _off(
    model: CameraModel, cam_from_board: Pose, places: Float[Tensor, "k n 3"], pixels: Float[Tensor, "n 2"], pitch_m: float
) -> Float[Tensor, " k"]:
    """Median angle between seen and predicted corners, in squares as the camera sees them, for every numbering."""
    bearings, valid = model.unproject(pixels)
    if not bool(valid.any()):
        return torch.full((len(places),), torch.inf, dtype=torch.float64)
    seen = cam_from_board.transform(places)
    distance = seen.norm(dim=-1)
    rays = seen / distance[..., None].clamp_min(1e-300)
    steps = [cam_from_board.rotation[:, axis] for axis in (0, 1)]
    sideways = [(step - (rays @ step)[..., None] * rays).square().sum(-1) for step in steps]
    spacing = (0.5 * (sideways[0] + sideways[1])).sqrt() * pitch_m / distance.clamp_min(1e-300)
    off = (rays - bearings).norm(dim=-1) / spacing.clamp_min(1e-12)
    return off[:, valid].median(dim=-1).values


def renumbered(board_m: Float[np.ndarray, "n 3"], motion: Pose) -> Float[np.ndarray, "n 3"]:
    """Coordinates on the board, z = 0 staying exactly that."""
    place = motion.transform(torch.as_tensor(board_m)).numpy()
    place[board_m[:, 2] == 0, 2] = 0.0
    return place
