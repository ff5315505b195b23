"""Whether the board is flat: what residuals of all photos say of its shape.

A board that is bent alike in all photos pulls the camera the same way in each, so photos do not contradict each other, and no
covariance holds it. Freed along the three bends of the second degree (`board_shape`), view v, its pose eliminated, adds S_v and
h_v (`least_squares.groups`) to the normal equations of the camera (c) and the bends (s). With the camera re-estimated, it pulls
the bends by

    u_v = h_sv - S_sc S_cc^-1 h_cv,     U = sum u_v

A flat board has U = 0; that it is, is tested by how much the pulls of single views differ (Hotelling's T^2: corners of one view
count once, however many there are). The bends are then M^-1 U with M = S_ss - S_sc S_cc^-1 S_cs, and the camera moves along.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.uncertainty import projection_covariance_px2, projection_jacobian, supported_grid, worst_sigma_px

BENDS = ("flatness",)
"""Of `options.REFINABLE`: what is tested."""

REMEDY = "Give `refine_board` flatness or surface, or use a board on glass or metal."


@dataclass(frozen=True)
class BentBoard:
    """A bend that all photos agree on, and what it does to the camera."""

    off_plane_m: float
    """Largest distance of a corner from a plane."""
    moved_px: float
    """By how much the projection would change with the bend estimated, and what is stated of it: root mean squares over the part
    of the image that corners support."""
    stated_px: float
    chance: float
    """Of as much where the board is flat."""

    @property
    def limit(self) -> str:
        """What it does, one sentence."""
        return (
            f"The board is not flat: all photos agree that it leaves a plane by about {rounded(1e3 * self.off_plane_m)} mm. With "
            f"the bend estimated the projection moves by {rounded(self.moved_px)} px, more than the {rounded(self.stated_px)} px "
            "that are stated (root mean squares where corners lie)"
        )

    @property
    def note(self) -> str:
        """That, with what it rests on and what follows."""
        held = f"photos share it, so standard deviations do not hold it (Hotelling's T^2, p = {self.chance:.1g})"
        return f"{self.limit}: {held}. {REMEDY}"


def bent_board(
    points: BoardPoints,
    state: CameraAndBoards,
    basis: Float[Tensor, "p q"],
    weight: Float[Tensor, " n"] | None,
    covariance: Float[Tensor, "p p"],
    reach_rad: tuple[float, float],
    significance: float,
) -> BentBoard | None:
    """Of the optimum of a camera on a board as drawn; None where nothing is that significant, where it moves the camera by less
    than is stated of it (`covariance`), or where views are too few to tell. `reach_rad` are the angles off axis between which
    corners lie."""
    shape = BoardShape.to_refine(BENDS, points.board)
    bends, q, views = shape.free.shape[1], basis.shape[1], points.views
    if not q or views <= bends + 1:
        return None
    bent = CameraAndBoards(state.model, state.cam_from_board, shape)
    each = BoardProblem(points, basis, weight, shape).by_views(bent)
    total = each.matrix.sum(0)
    follow = torch.linalg.solve(total[:q, :q], total[:q, q:])
    pull = each.gradient[:, q:] - each.gradient[:, :q] @ follow
    apart = pull - pull.mean(0)
    scatter = apart.mT @ apart * views / (views - 1)
    whole = pull.sum(0)
    statistic = float(whole @ torch.linalg.pinv(scatter, hermitian=True) @ whole) * (views - bends) / (bends * (views - 1))
    chance = float(stats.f.sf(statistic, bends, views - bends))
    if not chance < significance:
        return None
    bend = torch.linalg.solve(total[q:, q:] - total[q:, :q] @ follow, whole)
    step = basis @ (-follow @ bend)
    grid = supported_grid(state.model, reach_rad[1], reach_rad[0])
    jacobian, valid = projection_jacobian(state.model, grid, grid)
    moved = float((jacobian[valid] @ step).square().sum(-1).mean().sqrt())
    stated, _ = projection_covariance_px2(state.model, covariance, grid[valid], grid)
    stated_px = float(worst_sigma_px(stated).square().mean().sqrt())
    if moved <= stated_px:
        return None
    return BentBoard(shape.moved(shape.free @ bend).off_plane_m(points.board), moved, stated_px, chance)
