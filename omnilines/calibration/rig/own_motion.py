"""A small motion of the board of each view, eliminated within the view.

With the residuals r of a view, L = dr / d(all else) and J = dr / dxi, and xi = 0 known within the standard deviations s:

    rho = [r; xi / s],   A = [J; 1 / s],   P = 1 - A (A'A)^-1 A':   without xi, residuals P rho and Jacobian P [L; 0]

(Golub and Pereyra 1973, in the form of L. Kaufman 1975), and xi follows a step dx by dxi = -(A'A)^-1 A' (rho + [L; 0] dx). To
first order these are the residuals of a view whose corners have the covariance 1 + J s^2 J'.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.pose import Pose, adjoint
from omnilines.least_squares import CellLinearisation, CellPart, Cells


@dataclass(frozen=True, eq=False)
class OwnMotion:
    """What is known beforehand of the own motion of every view: a twist about the middle of the board, zero on average."""

    sigma: Float[Tensor, "v 6"]
    """Standard deviations of (rotation_rad, translation_m)."""
    middle_m: Float[Tensor, "3"]

    @property
    def board_from_middle(self) -> Pose:
        """Of the frame that the twist is in."""
        return Pose(torch.eye(3, dtype=torch.float64), self.middle_m)


@dataclass(frozen=True)
class Moved:
    """How the own motion of the views of a part follows a step of their local coordinates."""

    by_local: Float[Tensor, "cells 6 l"]
    residual: Float[Tensor, "cells 6"]

    def step(self, local: Float[Tensor, "cells l"]) -> Float[Tensor, "cells 6"]:
        """dxi."""
        return -(self.by_local @ local[..., None])[..., 0] - self.residual


def motion_pose(twist: Float[Tensor, "v 6"], motion: OwnMotion) -> Pose:
    """`board_from_board`: where each view sees the board, in the board as its frame has it."""
    frame = motion.board_from_middle
    return frame @ Pose.exp(twist) @ frame.inverse()


def by_motion(by_pose: Float[Tensor, "n 2 6"], cells: Cells, cam_from_board: Pose, motion: OwnMotion) -> Float[Tensor, "n 2 6"]:
    """Derivative of the residuals of some views by their own motion from that by the left perturbation of their poses."""
    return by_pose @ adjoint(cam_from_board @ motion.board_from_middle)[cells.index]


def without_motion(
    at: CellLinearisation,
    views: Sequence[tuple[int, int]],
    motion: OwnMotion,
    twist: Float[Tensor, "v 6"],
    cam_from_board: Pose,
) -> tuple[CellLinearisation, tuple[Moved, ...]]:
    """P rho and P [L; 0] of each part, whose local coordinates begin with the left perturbation of the pose; `views` are those of
    each part."""
    residuals, parts, moved, row = [], [], [], 0
    for part, (first, last) in zip(at.parts, views, strict=True):
        rows, count = slice(row, row + len(part.local)), last - first
        row = rows.stop
        inverse = 1 / motion.sigma[first:last]
        known = torch.diag_embed(inverse).reshape(3 * count, 2, 6)
        own = torch.cat([by_motion(part.local[..., :6], part.cells, cam_from_board[first:last], motion), known])
        index = torch.cat([part.cells.index, torch.arange(count).repeat_interleave(3)])
        rest = torch.cat([part.local, part.local.new_zeros(3 * count, 2, part.local.shape[-1])])
        off = torch.cat([at.residual[rows], (twist[first:last] * inverse).reshape(3 * count, 2)])
        joint = torch.cat([rest, off[..., None]], -1)
        matrix = _summed(own.mT @ own, index, count)
        gain = torch.linalg.solve(matrix, _summed(own.mT @ joint, index, count))
        left = joint - own @ gain[index]
        residuals.append(left[..., -1])
        parts.append(replace(part, cells=Cells(index, count), local=left[..., :-1]))
        moved.append(Moved(gain[..., :-1], gain[..., -1]))
    return CellLinearisation(torch.cat(residuals), tuple(parts), at.prior), tuple(moved)


def _summed(values: Float[Tensor, "n a b"], index: Tensor, count: int) -> Float[Tensor, "cells a b"]:
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, index, values)


def alone(
    part: CellPart, residual: Float[Tensor, "n 2"], cam_from_board: Pose, motion: OwnMotion
) -> tuple[Float[Tensor, "cells 6"], Float[Tensor, "cells 6 6"]]:
    """By how much more each view of a part would move by its corners alone, and the information of that, of a linearisation that
    has the own motion not eliminated."""
    own = by_motion(part.local[..., :6], part.cells, cam_from_board, motion)
    matrix = _summed(own.mT @ own, part.cells.index, part.cells.count)
    # Views too small for a pose of their own get one that no one asks for.
    matrix = torch.where(_sound(matrix), matrix, torch.eye(6, dtype=torch.float64))
    right = _summed(own.mT @ residual[..., None], part.cells.index, part.cells.count)
    return -torch.linalg.solve(matrix, right)[..., 0], matrix


def _sound(matrix: Float[Tensor, "cells 6 6"]) -> Bool[Tensor, "cells 1 1"]:
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    _, info = torch.linalg.cholesky_ex(matrix * scale[:, :, None] * scale[:, None, :] - 1e-12 * torch.eye(6))
    return (info == 0)[:, None, None]
