"""Frames in which a board is at one place: what is wrong with it there, or with how it is seen, is wrong in all of them alike, so
that they say it once, however many they are."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from camera_models.pose import Pose


def places(poses: Pose, board_m: Float[Tensor, "n 3"], squares: float) -> Int[Tensor, " p"]:
    """The number of the place of each pose of a board: that of the first one whose corners lie within so many squares of its own
    (root mean square), a square being the median distance of neighbouring corners."""
    corners = np.unique(board_m.numpy().round(7), axis=0)
    square_m = float(np.median(np.asarray(cKDTree(corners).query(corners, k=2)[0])[:, 1])) if len(corners) > 1 else 0.0
    low, high = corners.min(0), corners.max(0)
    ends = torch.as_tensor(np.array([low, [high[0], low[1], low[2]], [low[0], high[1], high[2]], high]))
    count = len(poses.translation)
    at = poses.transform(ends.expand(count, 4, 3))
    place = torch.full((count,), -1)
    for k in range(count):
        if place[k] < 0:
            away_m = (at - at[k]).square().sum(-1).mean(-1).sqrt()
            place[(place < 0) & (away_m <= squares * square_m)] = k
    return torch.unique(place, return_inverse=True)[1]
