"""Why cameras fit a rig worse than each alone: what the fit gains step by step as the rig is taken apart.

All fits are of the same corners with the same weights, so that their costs compare:

    rigid >= with held calibrations refined >= with the surface of the board free >= and its pose free in every view
          >= and the parameters of each camera alone

The first difference is that of calibrations that are held, the second the board's; the third that of its pose, as where hands
move it between two shutters; the fourth that of the camera models. Each is weighed against the residuals that are left by as
many parameters as it frees (an F ratio).
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models.wording import rounded
from omnilines.calibration.board_shape import AS_DRAWN, BoardShape
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.rig.joint import RigData, RigFit
from omnilines.calibration.rig.points import RigPoints
from omnilines.calibration.rig.problem import RigState
from omnilines.calibration.rig.refined import refined_rig
from omnilines.calibration.thresholds import RigThresholds
from omnilines.least_squares import Outcome, Solution, solve

ITERATIONS = 50


@dataclass(frozen=True)
class Apart:
    """Every camera with board poses, and perhaps parameters, of its own."""

    cost: float
    residual_px: tuple[Float[Tensor, "_ 2"], ...]
    """Of each camera."""
    moved_m: Float[Tensor, " v"]
    """How far the middle of the board is from where the rig has it, of the views that share a frame with another camera."""
    turned_deg: Float[Tensor, " v"]
    freed: int
    """Parameters of poses beyond one of every frame."""

    @property
    def rms_px(self) -> tuple[float, ...]:
        """Of each camera, per point."""
        return tuple(map(_rms_px, self.residual_px))


def excess_note(
    data: RigData, fit: RigFit, solution: Solution[RigState], held: Collection[int], thresholds: RigThresholds
) -> str | None:
    """What differs between the cameras together and each alone, a sentence for each cause; None where nothing stands out. `held`
    are members whose calibration is held."""
    points, state = fit.points.chosen(fit.kept), solution.state
    steps, alone_px = _steps(data, fit, solution, held)
    chain = [solution.cost, *(step.cost for step in steps)]
    gains = [before - after for before, after in pairwise(chain)]
    named = [
        gain > thresholds.named_share * sum(gains)
        and gain > thresholds.clear_gain * step.freed * step.cost / (2 * len(points.view))
        for gain, step in zip(gains, steps, strict=True)
    ]
    shares = [
        f"{100 * gain / sum(gains):.0f} percent of the difference in squares {step.cause}."
        for gain, step in zip(gains, steps, strict=True)
    ]
    told = [share for share, is_named in zip(shares, named, strict=True) if is_named]
    if not told:
        return None
    return f"Together the cameras fit to {_rms_px(state.residual_px(points)):.3g} px per point, {alone_px}. {' '.join(told)}"


@dataclass(frozen=True)
class _Step:
    """The fit with more that is free."""

    cost: float
    freed: int
    cause: str


def _steps(data: RigData, fit: RigFit, solution: Solution[RigState], held: Collection[int]) -> tuple[list[_Step], str]:
    """What is freed one after the other, and how well each camera fits alone in the end."""
    points, state, steps, before = fit.points.chosen(fit.kept), solution.state, list[_Step](), ""
    refined = refined_rig(data, fit, state, held)
    if refined is not None:
        freed = sum(basis.shape[1] for basis in refined[0].bases) - sum(basis.shape[1] for basis in data.bases)
        data, state = refined[0], refined[1].state
        steps.append(_Step(refined[1].cost, freed, OF_HELD.format(f"{_rms_px(state.residual_px(points)):.3g}")))
    bent = _bent(data, fit, state)
    if bent is not None:
        state, before = bent.state, " on a bent board"
        steps.append(_Step(bent.cost, state.shape.free.shape[1], _of_board(state, points)))
    posed, free = (apart(data, points, state, hold=hold) for hold in (True, False))
    steps.append(_Step(posed.cost, posed.freed, _of_poses(posed)))
    steps.append(_Step(free.cost, sum(basis.shape[1] for basis in data.bases), OF_PARAMETERS))
    return steps, f"each alone{before} to {_rms_px(torch.cat(free.residual_px)):.3g}"


OF_HELD = (
    "is what is held of the cameras: with their parameters refined they fit to {} px together. Leave `hold` out, or give a "
    "calibration of the same focus and zoom"
)
OF_PARAMETERS = (
    "is the cameras' parameters, which differ between the cameras alone and together: the model does not suit the lens, or few "
    "views leave it open"
)


def _of_board(bent: RigState, points: RigPoints) -> str:
    return (
        "is a board that is not flat: its surface leaves a plane by up to "
        f"{rounded(1e3 * bent.shape.off_plane_m(points.board_m))} mm. With the surface estimated the cameras fit to "
        f"{_rms_px(bent.residual_px(points)):.3g} px together: give `refine_board` surface, or a board on glass or metal (all "
        "photos share this error, so that standard deviations do not hold it)"
    )


def _of_poses(held: Apart) -> str:
    return (
        f"is the board's pose, which differs between cameras by {rounded(1e3 * float(held.moved_m.median()))} mm and "
        f"{rounded(float(held.turned_deg.median()))} degrees in the median view: the board moved between two shutters, or bent "
        "anew in every view. Hold it still, or fix it to something"
    )


def _rms_px(residual_px: Float[Tensor, "n 2"]) -> float:
    return float(residual_px.square().sum(-1).mean().sqrt())


def _bent(data: RigData, fit: RigFit, state: RigState) -> Solution[RigState] | None:
    """The joint fit with the surface of the board free, where it is one board as drawn."""
    if not state.shape.plain or len(data.views.boards) > 1:
        return None
    shape = BoardShape.to_refine(("surface",), fit.points.board_m)
    problem = replace(data, shape=shape).problem(fit.points.chosen(fit.kept))
    found = solve(problem, replace(state, shape=shape), max_iterations=ITERATIONS, damping=1e-8)
    return None if found.outcome is Outcome.DEGENERATE else found


def apart(data: RigData, points: RigPoints, state: RigState, *, hold: bool) -> Apart:
    """Every camera fitted alone to its corners on the board as the state has it; with its parameters held only the poses."""
    cost, residuals, moved, turned = 0.0, [], [], []
    shared = _shared_views(points)
    rig_poses, middle = state.cam_from_board(points), points.board_m.mean(0)
    for k, basis in enumerate(data.bases):
        own = points.camera[points.view] == k
        views, place = torch.unique(points.view[own], return_inverse=True)
        board = BoardPoints(place, len(views), state.shape.place(points.board_m[own]), points.pixels[own])
        problem = BoardProblem(board, basis[:, : 0 if hold else None], points.weight[own], AS_DRAWN)
        found = problem.solve(CameraAndBoards(state.models[k], rig_poses[views]), max_iterations=ITERATIONS)
        cost += found.cost
        residuals.append(found.state.residual_px(board))
        change = rig_poses[views].inverse() @ found.state.cam_from_board
        both = shared[views]
        moved.append((change.transform(middle.expand(len(views), 1, 3))[:, 0] - middle).norm(dim=-1)[both])
        turned.append(torch.rad2deg(change.log()[:, :3].norm(dim=-1))[both])
    freed = 6 * (int(shared.sum()) - len(torch.unique(points.instant[shared])))
    return Apart(cost, tuple(residuals), torch.cat(moved), torch.cat(turned), freed)


def _shared_views(points: RigPoints) -> Bool[Tensor, " v"]:
    """Views with corners whose instant another view with corners has too."""
    seen = torch.bincount(points.view, minlength=len(points.camera)) > 0
    counts = torch.bincount(points.instant[seen], minlength=int(points.instant.max()) + 1)
    return seen & (counts[points.instant] > 1)
