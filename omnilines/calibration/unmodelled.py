"""What neither the drawing of the board nor the camera model holds, and all photos agree on.

A board that is bent, or printed higher than wide, and a lens whose rays do not meet in one point pull the camera the same way in
each photo, so photos do not contradict each other, and no covariance holds it. Freed along some terms (s) of the board's shape
(`board_shape`) or of the place of the pupil, view v, its pose eliminated, adds S_v and h_v (`least_squares.groups`) to the normal
equations of the camera (c) and the terms. With the camera re-estimated, it pulls the terms by

    u_v = h_sv - S_sc S_cc^-1 h_cv,     U = sum u_v

Where the terms are 0, U is; that it is, is tested by how much the pulls of single views differ (Hotelling's T^2: corners of one
view count once, however many there are). The terms are then M^-1 U with M = S_ss - S_sc S_cc^-1 S_cs, and the camera moves along.
Each kind is tested by itself, since one looks a little like the other: what lowers the squared residuals most is said.

The pupil of a wide lens moves along the axis with the angle: rays of theta come from p theta^2 on it. A board near the camera
shows so, and a camera calibrated with it is off where points are far.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.uncertainty import projection_covariance_px2, projection_jacobian, supported_grid, worst_sigma_px
from omnilines.least_squares import Linearisation

Kind = Literal["flatness", "aspect", "pupil"]
"""What is tested: of `options.REFINABLE`, and the place of the pupil."""
REMEDIES: dict[Kind, str] = {
    "flatness": "Give `refine_board` flatness or surface, or use a board on glass or metal.",
    "aspect": "Give `refine_board` aspect, or measure the board along both sides.",
    "pupil": "Hold the board farther away, about where the camera will look: no camera model here holds that, and it fades with "
    "the distance.",
}


@dataclass(frozen=True)
class Unmodelled:
    """What all photos agree on, and what it does to the camera."""

    kind: Kind
    size: float
    """Largest distance of a corner of a bent board from a plane (m); by what share squares are higher than wide; by how much the
    pupil moves towards what it looks at, from the axis to where corners end (m)."""
    reach_deg: float
    """Where corners end, off axis."""
    moved_px: float
    """By how much the projection would change with that estimated, and what is stated of it: root mean squares over the part
    of the image that corners support."""
    stated_px: float
    chance: float
    """Of as much by any of the kinds, where there is none."""

    @property
    def limit(self) -> str:
        """What it does, one sentence."""
        return (
            f"{self._said} estimated the projection{' of far points' if self.kind == 'pupil' else ''} moves by "
            f"{rounded(self.moved_px)} px, more than the {rounded(self.stated_px)} px that are stated (root mean squares where "
            "corners lie)"
        )

    @property
    def _said(self) -> str:
        if self.kind == "flatness":
            return (
                f"The board is not flat: all photos agree that it leaves a plane by about {rounded(1e3 * self.size)} mm. "
                "With the bend"
            )
        if self.kind == "aspect":
            more = "higher" if self.size > 0 else "lower"
            return (
                f"The squares of the board are not as drawn: all photos agree that they are {rounded(100 * abs(self.size))} "
                f"percent {more} beside their width. With this"
            )
        way = "towards the scene" if self.size > 0 else "away from the scene"
        return (
            f"The rays of the camera do not meet in one point: all photos agree that those {self.reach_deg:.0f} degrees off axis "
            f"meet the axis about {rounded(1e3 * abs(self.size))} mm {way}. With this"
        )

    @property
    def remedy(self) -> str:
        """What to do."""
        return REMEDIES[self.kind]

    @property
    def note(self) -> str:
        """That, with what it rests on and what follows."""
        held = f"photos share it, so standard deviations do not hold it (Hotelling's T^2, p = {self.chance:.1g})"
        return f"{self.limit}: {held}. {self.remedy}"


class _PupilProblem(BoardProblem):
    """With one more column in the kept block: p of the pupil, metres a squared radian."""

    def _linearised(self, state: CameraAndBoards) -> Linearisation:
        at = super()._linearised(state)
        seen = state.seen(self.points)
        _, _, by_point, _ = state.model.project_with_jacobians(seen)
        squared = torch.atan2(seen[:, :2].norm(dim=-1), seen[:, 2]).square()
        by_pupil = -by_point[:, :, 2] * (squared * self.weight)[:, None]
        return Linearisation(at.residual, at.by_eliminated, (torch.cat([at.by_kept[0], by_pupil[..., None]], -1),))


@dataclass(frozen=True, eq=False)
class _Freed:
    """By how much freed terms, and the camera along its basis, move."""

    kind: Kind
    terms: Float[Tensor, " s"]
    step: Float[Tensor, " q"]
    gain: float
    """By how much that lowers the squared residuals, in those of corners of weight 1."""
    chance: float


def unmodelled(
    points: BoardPoints,
    state: CameraAndBoards,
    basis: Float[Tensor, "p q"],
    weight: Float[Tensor, " n"] | None,
    covariance: Float[Tensor, "p p"],
    reach_rad: tuple[float, float],
    significance: float,
) -> Unmodelled | None:
    """Of the optimum of a camera on a board as drawn; None where nothing is that significant, where it moves the camera by less
    than is stated of it (`covariance`), or where views are too few to tell. `reach_rad` are the angles off axis between which
    corners lie."""
    if not basis.shape[1]:
        return None
    tried = [_freed(kind, points, state, basis, weight) for kind in get_args(Kind)]
    beyond_chance = [one for one in tried if one is not None and len(tried) * one.chance < significance]
    if not beyond_chance:
        return None
    found = max(beyond_chance, key=lambda one: one.gain)
    grid = supported_grid(state.model, reach_rad[1], reach_rad[0])
    jacobian, valid = projection_jacobian(state.model, grid, grid)
    moved = float((jacobian[valid] @ (basis @ found.step)).square().sum(-1).mean().sqrt())
    stated, _ = projection_covariance_px2(state.model, covariance, grid[valid], grid)
    stated_px = float(worst_sigma_px(stated).square().mean().sqrt())
    if moved <= stated_px:
        return None
    size = _size(found, points, reach_rad[1])
    return Unmodelled(found.kind, size, math.degrees(reach_rad[1]), moved, stated_px, len(tried) * found.chance)


def _shape(kind: Kind, points: BoardPoints) -> BoardShape:
    return AS_DRAWN if kind == "pupil" else BoardShape.to_refine((kind,), points.board)


def _freed(
    kind: Kind, points: BoardPoints, state: CameraAndBoards, basis: Float[Tensor, "p q"], weight: Float[Tensor, " n"] | None
) -> _Freed | None:
    shape, q, views = _shape(kind, points), basis.shape[1], points.views
    problem = (_PupilProblem if kind == "pupil" else BoardProblem)(points, basis, weight, shape)
    each = problem.by_views(CameraAndBoards(state.model, state.cam_from_board, shape))
    terms = each.gradient.shape[1] - q
    if views <= terms + 1:
        return None
    total = each.matrix.sum(0)
    follow = torch.linalg.solve(total[:q, :q], total[:q, q:])
    pull = each.gradient[:, q:] - each.gradient[:, :q] @ follow
    apart = pull - pull.mean(0)
    scatter = apart.mT @ apart * views / (views - 1)
    whole = pull.sum(0)
    statistic = float(whole @ torch.linalg.pinv(scatter, hermitian=True) @ whole) * (views - terms) / (terms * (views - 1))
    by = torch.linalg.solve(total[q:, q:] - total[q:, :q] @ follow, whole)
    return _Freed(kind, by, -follow @ by, float(whole @ by), float(stats.f.sf(statistic, terms, views - terms)))


def _size(found: _Freed, points: BoardPoints, reach_rad: float) -> float:
    if found.kind == "pupil":
        return float(found.terms[0]) * reach_rad**2
    if found.kind == "aspect":
        return float(found.terms[0])
    shape = _shape(found.kind, points)
    return shape.moved(shape.free @ found.terms).off_plane_m(points.board)
