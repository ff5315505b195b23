"""What neither the drawing of the board nor the camera model holds, and all photos agree on.

A board that is bent, or printed higher than wide, and a lens whose rays do not meet in one point pull the camera the same way in
each photo, so photos do not contradict each other, and no covariance holds it. Freed along some terms (s) of the board's shape
(`board_shape`) or of the place of the pupil, view v, its pose eliminated, adds S_v and h_v (`least_squares.groups`) to the normal
equations of the camera (c) and the terms. With the camera re-estimated, it pulls the terms by

    u_v = h_sv - S_sc S_cc^-1 h_cv,     U = sum u_v

and the terms are M^-1 U with M = S_ss - S_sc S_cc^-1 S_cs; the camera moves along. That they are 0 is tested by how they move
without each view in turn (the jackknife: corners of one view count once, however many there are; Hotelling's T^2). Pulls where
the terms are 0 differ by what there is of them too, as views tell more or less of it, so that much of it would hide itself.
Views that tell little of the terms say little of how certain they are: with m_v the share of M that view v adds, sum m_v = 1,
there are 1 / sum m_v^2 that count (F. Satterthwaite 1946; R. Bell and D. McCaffrey 2002).

Each kind is tested by itself, since one looks a little like the other: what lowers the squared residuals most is said. Of a rig
(`rig/unmodelled.py`) v are frames, and c is all that is kept: the board is the same for all its cameras.

The pupil of a wide lens moves along the axis with the angle: rays of theta come from p theta^2 on it. A board near the camera
shows so, and a camera calibrated with it is off where points are far. Elements that do not share an axis displace what is seen
under theta by 3 theta^2 (a . c) outwards and theta^2 (a x c) around, a being the direction on the image from the axis (Brown,
Decentering distortion of lenses, 1966, with the angle in place of the radius).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from camera_models import CameraModel
from camera_models.wording import rounded
from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.uncertainty import (
    bearing_jacobian,
    common_turn,
    projection_covariance_px2,
    supported_grid,
    worst_sigma_px,
)
from omnilines.least_squares import Linearisation
from omnilines.least_squares.groups import Groups

K = TypeVar("K")
Kind = Literal["flatness", "aspect", "pupil", "decentering"]
"""What is tested: of `options.REFINABLE`, and of the lens."""
LEAST_LEFT = 1e-9
"""Of what views say of a term, by the rest of them: below it something else that is estimated is the same."""
REMEDIES: dict[Kind, str] = {
    "flatness": "Give `refine_board` flatness or surface, or use a board on glass or metal.",
    "aspect": "Give `refine_board` aspect, or measure the board along both sides.",
    "pupil": "Hold the board about as far away as the camera will look: no camera model here holds that, and it fades with the "
    "distance.",
    "decentering": "Compare with `--model fisheye624`, which has terms for it (so have unified and, below 100 degrees, pinhole); "
    "`auto` compares all.",
}


@dataclass(frozen=True)
class Unmodelled:
    """What all photos agree on, and what it does to the camera."""

    kind: Kind
    size: float
    """Largest distance of a corner of a bent board from a plane (m); by what share squares are higher than wide; by how much the
    pupil moves towards what it looks at, from the axis to where corners end (m); by how much what is seen there is displaced
    outwards at most (rad)."""
    reach_deg: float
    """Where corners end, off axis."""
    moved_px: float
    """By how much the projection would change with that estimated, and what is stated of it: root mean squares over the part
    of the image that corners support."""
    stated_px: float
    chance: float
    """Of as much by any of the kinds, where there is none."""
    camera: str = ""
    """Of a rig, whose projection that is."""

    @property
    def limit(self) -> str:
        """What it does, one sentence."""
        return (
            f"{self._said} estimated the projection{self._of_what} moves by "
            f"{rounded(self.moved_px)} px, more than its stated {rounded(self.stated_px)} px (root mean squares where corners "
            "lie)"
        )

    @property
    def _of_what(self) -> str:
        far = " of far points" if self.kind == "pupil" else ""
        return far + (f" of camera {self.camera}" if self.camera else "")

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
                f"percent {more} than wide. With this"
            )
        camera = f"camera {self.camera}" if self.camera else "the camera"
        if self.kind == "decentering":
            return (
                f"The lens of {camera} is not centred: all photos agree that {self.reach_deg:.0f} degrees off axis it bends rays "
                f"by up to {rounded(math.degrees(self.size))} degrees more to one side (decentering). With this"
            )
        way = "nearer to the scene" if self.size > 0 else "farther from the scene"
        return (
            f"The rays of {camera} do not meet in one point: all photos agree that rays {self.reach_deg:.0f} degrees off axis "
            f"meet the axis about {rounded(1e3 * abs(self.size))} mm {way} than rays near it. With this"
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


class LensProblem(BoardProblem):
    """With more columns in the kept block: how a lens moves points of the camera's frame."""

    def __init__(
        self,
        moves: Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3 s"]],
        points: BoardPoints,
        basis: Float[Tensor, "p q"],
        weight: Float[Tensor, " n"] | None,
    ) -> None:
        super().__init__(points, basis, weight, AS_DRAWN)
        self.moves = moves

    def _linearised(self, state: CameraAndBoards) -> Linearisation:
        at = super()._linearised(state)
        seen = state.seen(self.points)
        _, _, by_point, _ = state.model.project_with_jacobians(seen)
        by_lens = self.weight[:, None, None] * (by_point @ self.moves(seen))
        return Linearisation(at.residual, at.by_eliminated, (torch.cat([at.by_kept[0], by_lens], -1),))


def by_pupil(seen: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 1"]:
    """Of p, metres a squared radian: points are as if so much nearer."""
    squared = torch.atan2(seen[:, :2].norm(dim=-1), seen[:, 2]).square()
    return torch.nn.functional.pad(-squared[:, None, None], (0, 0, 2, 0))


def by_decentering(seen: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 2"]:
    """Of c, radians a squared radian."""
    x, y, z = seen.unbind(-1)
    across = torch.hypot(x, y)
    theta, distance = torch.atan2(across, z), seen.norm(dim=-1)
    # On the axis nothing moves, in whichever direction from it.
    a = seen[:, :2] / across.clamp_min(1e-300)[:, None]
    outwards = torch.cat([torch.cos(theta)[:, None] * a, -torch.sin(theta)[:, None]], -1)
    around = torch.stack([-a[:, 1], a[:, 0], torch.zeros_like(x)], -1)
    turned = torch.stack([-a[:, 1], a[:, 0]], -1) * (torch.sin(theta) * theta)[:, None]
    moved = outwards[:, :, None] * (3 * theta.square()[:, None] * a)[:, None] + around[:, :, None] * turned[:, None]
    return distance[:, None, None] * moved


OF_LENS: dict[Kind, Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3 s"]]] = {
    "pupil": by_pupil,
    "decentering": by_decentering,
}


@dataclass(frozen=True, eq=False)
class Freed:
    """By how much freed terms, and all else that is kept, move."""

    terms: Float[Tensor, " s"]
    step: Float[Tensor, " q"]
    gain: float
    """By how much that lowers the squared residuals, in those of corners of weight 1."""
    chance: float

    @staticmethod
    def of(each: Groups, terms: slice) -> "Freed | None":
        """Of what each view adds to the normal equations; `terms` are their columns. None of too few views, and of terms that
        are among what is estimated already."""
        views, kept = each.gradient.shape
        freed = list(range(kept))[terms]
        rest = [column for column in range(kept) if column not in freed]
        count, total = len(freed), each.matrix.sum(0)
        if views <= count + 1:
            return None
        within = total[rest][:, rest]
        scale = within.diagonal().clamp_min(1e-300).rsqrt()
        coupling = total[rest][:, freed]
        follow = scale[:, None] * torch.linalg.solve(scale[:, None] * within * scale, scale[:, None] * coupling)
        left = total[freed][:, freed] - coupling.mT @ follow
        if not bool((left.diagonal() > LEAST_LEFT * total.diagonal()[freed]).all()):
            return None
        # A change of the terms with all else that follows.
        along = total.new_zeros(kept, count)
        along[freed], along[rest] = torch.eye(count, dtype=total.dtype), -follow
        whole = (each.gradient @ along).sum(0)
        by = torch.linalg.solve(left, whole)
        share = torch.linalg.solve(left, along.mT @ each.matrix @ along).diagonal(dim1=1, dim2=2).mean(1)
        freedom = 1 / float(share.square().sum()) - count + 1
        if freedom <= 0:
            return None
        scatter = each.jackknife()[freed][:, freed]
        statistic = float(by @ torch.linalg.pinv(scatter, hermitian=True) @ by) / count
        chance = float(stats.f.sf(statistic * freedom / (freedom + count - 1), count, freedom))
        return Freed(by, -follow @ by, float(whole @ by), chance)


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
    tried = {kind: _freed(kind, points, state, basis, weight) for kind in get_args(Kind)}
    found = beyond_chance(tried, significance)
    if found is None:
        return None
    kind, freed = found
    own = freed.terms if kind == "decentering" else None
    moved_px, stated_px = moved_and_stated_px(state.model, basis @ freed.step, covariance, reach_rad, own)
    if moved_px <= stated_px:
        return None
    size = size_of(kind, freed, points.board, reach_rad[1])
    return Unmodelled(kind, size, math.degrees(reach_rad[1]), moved_px, stated_px, len(tried) * freed.chance)


def beyond_chance(tried: Mapping[K, Freed | None], significance: float) -> tuple[K, Freed] | None:
    """What lowers the squared residuals most, of what is significant among all that was tried."""
    sure = [(key, one) for key, one in tried.items() if one is not None and len(tried) * one.chance < significance]
    return max(sure, key=lambda pair: pair[1].gain, default=None)


def moved_and_stated_px(
    model: CameraModel,
    change: Float[Tensor, " p"],
    covariance: Float[Tensor, "p p"],
    reach_rad: tuple[float, float],
    decentering: Float[Tensor, "2"] | None = None,
) -> tuple[float, float]:
    """By how much a change of the parameters, and where given the decentering that comes with it, move the projection, after the
    common rotation that fits best, and what is stated of it: root mean squares between two angles off axis."""
    grid = supported_grid(model, reach_rad[1], reach_rad[0])
    bearings, valid, by_parameter, by_point = bearing_jacobian(model, grid)
    bearings, by_point, moved = bearings[valid], by_point[valid], by_parameter[valid] @ change
    if decentering is not None:
        # Where a direction is seen elsewhere, a pixel sees another direction, to the other side.
        moved = moved - by_decentering(bearings) @ decentering
    left = moved - common_turn(bearings, moved)
    moved_px = float((by_point @ left[..., None]).square().sum((1, 2)).mean().sqrt())
    stated, _ = projection_covariance_px2(model, covariance, grid[valid], grid)
    return moved_px, float(worst_sigma_px(stated).square().mean().sqrt())


def _freed(
    kind: Kind, points: BoardPoints, state: CameraAndBoards, basis: Float[Tensor, "p q"], weight: Float[Tensor, " n"] | None
) -> Freed | None:
    terms = slice(basis.shape[1], None)
    if kind in OF_LENS:
        return Freed.of(LensProblem(OF_LENS[kind], points, basis, weight).by_views(state), terms)
    shape = BoardShape.to_refine((kind,), points.board)
    problem = BoardProblem(points, basis, weight, shape)
    return Freed.of(problem.by_views(CameraAndBoards(state.model, state.cam_from_board, shape)), terms)


def size_of(kind: Kind, found: Freed, board: Float[Tensor, "n 3"], reach_rad: float) -> float:
    """`Unmodelled.size`."""
    if kind == "pupil":
        return float(found.terms[0]) * reach_rad**2
    if kind == "decentering":
        return float(found.terms.norm()) * 3 * reach_rad**2
    if kind == "aspect":
        return float(found.terms[0])
    shape = BoardShape.to_refine((kind,), board)
    return shape.moved(shape.free @ found.terms).off_plane_m(board)
