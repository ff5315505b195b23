"""Poses between the rows of a trajectory: places on the straight line, rotations along the shortest turn."""

import numpy as np
import torch
from jaxtyping import Float, Int

from camera_models.pose import Pose, rotation_from_vector, vector_from_rotation


def poses_between(
    poses: Pose, rows_s: Float[np.ndarray, " n"], times_s: Float[np.ndarray, " m"], before: Int[np.ndarray, " m"]
) -> Pose:
    """world_from_body (m,) at times within rows `before` and `before + 1` of n poses, R = R0 exp(w log(R0' R1)).

    Beyond the two rows (and of a single one) that pose which is nearer.
    """
    after = np.minimum(before + 1, len(rows_s) - 1)
    gap = rows_s[after] - rows_s[before]
    share = np.divide(times_s - rows_s[before], gap, out=np.zeros(len(times_s)), where=gap > 0)
    return _mixed(poses[before.tolist()], poses[after.tolist()], torch.from_numpy(np.clip(share, 0.0, 1.0))[:, None])


def _mixed(first: Pose, second: Pose, share: Float[torch.Tensor, "m 1"]) -> Pose:
    turn = vector_from_rotation(first.rotation.mT @ second.rotation)
    rotation = first.rotation @ rotation_from_vector(share * turn)
    return Pose(rotation, first.translation + share * (second.translation - first.translation))


def left_out_errors(
    poses: Pose,
    rows_s: Float[np.ndarray, " n"],
    times_s: Float[np.ndarray, " m"],
    before: Int[np.ndarray, " m"],
    most_s: float,
) -> tuple[float, float] | None:
    """How far (rad, m; medians) the poses between rows are off, from rows that lie between two others up to `most_s` apart.

    A body that turns or speeds up evenly is off by a s (1 - s) gap^2 / 2 at the share s of a gap; a comes from each row that is
    left out. None where no row has others so near.
    """
    wide = rows_s[2:] - rows_s[:-2]
    middle = 1 + np.flatnonzero((wide > 0) & (wide <= most_s) & (rows_s[2:] > rows_s[1:-1]) & (rows_s[1:-1] > rows_s[:-2]))
    if not len(middle):
        return None
    gap = rows_s[middle + 1] - rows_s[middle - 1]
    share = (rows_s[middle] - rows_s[middle - 1]) / gap
    known = poses[middle.tolist()]
    said = _mixed(poses[(middle - 1).tolist()], poses[(middle + 1).tolist()], torch.from_numpy(share)[:, None])
    own_gap = rows_s[before + 1] - rows_s[before]
    own_share = (times_s - rows_s[before]) / own_gap
    grows = np.median(own_share * (1 - own_share) * own_gap**2)
    turned = vector_from_rotation(known.rotation.mT @ said.rotation).norm(dim=-1).numpy()
    moved = (known.translation - said.translation).norm(dim=-1).numpy()
    of_row = share * (1 - share) * gap**2
    return float(np.median(turned / of_row) * grows), float(np.median(moved / of_row) * grows)
