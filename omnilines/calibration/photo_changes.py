"""What changes from photo to photo, where photos contradict each other about the camera (`by_views.py`).

Each photo is given terms of its own, beside the pose of its board, for one of these at a time:

    focal    the image is larger or smaller about its centre (zoom, focus),
    centre   the image is shifted (photos that were cropped, a stabilised lens or sensor),
    turn     while rows are read from the upper to the lower one, the board turns about the camera,
    motion   it turns and moves (rolling shutter),
    bend     the board bends, otherwise in each photo.

Poses take up most of each: what the image of a tilted board still shows of it is left. One linear step of least squares tells by
how much the squares of N residuals fall, from E to E_k, with d more unknowns: N log(E_k / E) + d log N is the least for what
explains them best (G. Schwarz 1978), and above 0 where nothing does. That is said only where what is left is the noise stated of
the corners: real boards and lenses have other faults, of which six terms a photo take up a part, whatever they mean. What all
photos share (a bent board, a lens that does not suit) makes them contradict each other too, and six terms a photo take it up: it
is tried as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from camera_models.pose import Pose, hat
from camera_models.pose_fit import by_pose
from camera_models.wording import rounded
from omnilines.calibration.board_shape import BoardShape
from omnilines.calibration.initialise import BoardPoints, resect_boards
from omnilines.calibration.refine import BoardProblem, CameraAndBoards
from omnilines.calibration.unmodelled import OF_LENS, LensProblem
from omnilines.least_squares import Linearisation

Kind = Literal["focal", "centre", "turn", "motion", "bend"]
DETERMINED = 1e-6
"""Singular values above this share, columns scaled, are those of what corners determine."""
PULLS, STEPS = 20, 15
"""Iterations for how much terms scatter, and for a view by itself, which settle sooner."""
OF_IMAGE: tuple[Kind, ...] = ("centre", "focal")
"""What one photo alone may have beside the others."""
MEANT: dict[Kind, tuple[str, str]] = {
    "focal": (
        "The focal length is not the same in all photos",
        "Set zoom and focus once and lock them (no autofocus), and take all photos so; or calibrate the photos of each setting "
        "alone.",
    ),
    "centre": (
        "The image is not at the same place in all photos",
        "Give photos as the camera took them, not cropped one by one, with image stabilisation switched off.",
    ),
    "motion": (
        "The camera or the board moved while the rows of a photo were read (rolling shutter)",
        "Lay or clamp both down for each photo, or give a video and `rolling_shutter`.",
    ),
    "bend": (
        "The board bends, and not alike in all photos",
        "Fix it to glass or metal: `refine_board` estimates one shape for all photos.",
    ),
}
MEANT["turn"] = MEANT["motion"]


@dataclass(frozen=True)
class PhotoChange:
    """What differs between photos, and by how much."""

    kind: Kind
    size: float
    """Root mean square about the mean of all photos: relative of focal, in pixels an axis of centre; of the others 0."""
    before_px: float
    after_px: float
    """What residuals leave of corners, with all photos alike and with this free in each (standard deviations per axis)."""

    @property
    def limit(self) -> str:
        """One sentence."""
        by = ""
        if self.kind == "focal":
            by = f": it differs by about {rounded(100 * self.size)} percent (root mean square)"
        elif self.kind == "centre":
            by = f": it differs by about {rounded(self.size)} px (root mean square, each way)"
        return (
            f"{MEANT[self.kind][0]}{by}. With that free in each photo, corners lie {rounded(self.after_px)} px off, about as far "
            f"as their noise has them, in place of {rounded(self.before_px)} px"
        )

    @property
    def remedy(self) -> str:
        """What to do."""
        return MEANT[self.kind][1]

    @property
    def note(self) -> str:
        """That, with what follows."""
        return f"{self.limit}. {self.remedy}"


def photo_change(
    points: BoardPoints,
    state: CameraAndBoards,
    basis: Float[Tensor, "p q"],
    weight: Float[Tensor, " n"] | None,
    stated_px: float,
    explained: float,
    one_drawing: bool,
) -> PhotoChange | None:
    """What explains best why photos contradict each other; None where none leaves `explained` times `stated_px` or less, both of
    corners of weight 1, or where something that all photos share explains it better. `one_drawing`: all views are of one plane
    board, taken to be as drawn."""
    problem = BoardProblem(points, basis, weight, state.shape)
    at, count = problem.linearise(state), 2 * len(points.view)
    none = at.residual.new_zeros(len(points.view), 2, 0)
    alike = _Left.of(points, at, none)
    before_px = math.sqrt(alike.squares / max(count - alike.unknowns, 1))

    def score(left: _Left) -> float:
        more = left.unknowns - alike.unknowns
        return count * math.log(max(left.squares, 1e-300) / alike.squares) + more * math.log(count)

    shared = [score(_Left.of(points, one, none)) for one in _shared(points, state, basis, weight)] if one_drawing else []
    least, best = min([0.0, *shared]), None
    for kind in get_args(Kind):
        if kind == "bend" and not one_drawing:
            continue
        left = _Left.of(points, at, problem.weight[:, None, None] * _moved(kind, points, state))
        if left.unknowns >= count or score(left) >= least:
            continue
        after_px = math.sqrt(left.squares / (count - left.unknowns))
        size = left.scatter(after_px) if kind in OF_IMAGE else 0.0
        least, best = score(left), PhotoChange(kind, size, before_px, after_px)
    return best if best is not None and best.after_px <= explained * stated_px else None


def _shared(
    points: BoardPoints, state: CameraAndBoards, basis: Float[Tensor, "p q"], weight: Float[Tensor, " n"] | None
) -> list[Linearisation]:
    """What neither board nor model hold, one at a time (`unmodelled.py`): photos contradict each other about it too."""
    shapes = [BoardShape.to_refine((kind,), points.board) for kind in ("flatness", "aspect")]
    bent = [BoardProblem(points, basis, weight, shape).linearise(replace(state, shape=shape)) for shape in shapes]
    return [*bent, *(LensProblem(moves, points, basis, weight).linearise(state) for moves in OF_LENS.values())]


def unlike_views(
    points: BoardPoints, state: CameraAndBoards, lost: Sequence[int], fits_better: float, significance: float
) -> dict[int, str]:
    """The `lost` views, which do not fit the camera of the others, that fit it with a shift or a size of their own, and what is
    to be said of them: more than `fits_better` times as well (root mean square) beyond chance, and about as well as half of the
    others do."""
    freedom = (2 * points.counts - 6).clamp_min(1)
    variance = points.sum_by_view(state.residual_px(points).square().sum(-1)) / freedom
    others = [view for view in range(points.views) if view not in lost]
    if not others:
        return {}
    most, found = fits_better**2 * float(variance[others].median()), {}
    for view in lost:
        own = points.of_views([view])
        as_it_is, _ = _alone(own, state, None)
        for kind in OF_IMAGE:
            free = 2 * len(own.view) - 8
            if free <= 0:
                continue
            squares, by = _alone(own, state, kind)
            better = stats.f.sf(as_it_is / max(squares, 1e-300) / fits_better**2, free, free) < significance
            if better and squares <= free * most:
                found[view] = _unlike(kind, by)
                break
    return found


def _unlike(kind: Kind, by: Float[Tensor, " m"]) -> str:
    if kind == "focal":
        way = "larger" if float(by) > 0 else "smaller"
        return f"beside the others its image is {rounded(100 * abs(float(by)))} percent {way}; give photos of one zoom and focus"
    right, down = (float(one) for one in by)
    across = f"{rounded(abs(right))} px to the {'right' if right > 0 else 'left'}"
    along = f"{rounded(abs(down))} px {'down' if down > 0 else 'up'}"
    return f"beside the others its image is shifted by {across} and {along}; give it uncropped"


def _alone(own: BoardPoints, state: CameraAndBoards, kind: Kind | None) -> tuple[float, Float[Tensor, " m"]]:
    """The squared residuals of one view at the pose and the terms that fit it best, and the terms."""
    model = state.model
    at = CameraAndBoards(model, resect_boards(own, model.unproject(own.pixels)[0]), state.shape)
    squares, terms = math.inf, own.pixels.new_zeros(0 if kind is None else {"focal": 1}.get(kind, 2))
    for _ in range(STEPS):
        seen = at.seen(own)
        pixels, _, by_point, _ = model.project_with_jacobians(seen)
        moved = pixels.new_zeros(len(pixels), 2, 0) if kind is None else _moved(kind, own, at)
        residual = pixels + moved @ terms - own.pixels
        squares = float(residual.square().sum())
        columns = torch.cat([by_pose(by_point, seen), moved], -1).flatten(0, 1)
        step = torch.linalg.lstsq(columns, -residual.flatten()[:, None], driver="gelsd").solution[:, 0]
        at, terms = replace(at, cam_from_board=Pose.exp(step[None, :6]) @ at.cam_from_board), terms + step[6:]
    return squares, terms


@dataclass(frozen=True, eq=False)
class _Left:
    """What a linear step leaves."""

    squares: float
    unknowns: int
    terms: Float[Tensor, "v m"]
    """Of each view, up to what all have in common."""
    told: Float[Tensor, " v"]
    """By how much the squares of each view grow with a term of 1, mean of its terms."""

    @staticmethod
    def of(points: BoardPoints, at: Linearisation, terms: Float[Tensor, "n 2 m"]) -> "_Left":
        """With a pose and `terms` of each view's own, and what is kept of all."""
        kept = torch.cat(at.by_kept, -1)
        rest = torch.cat([kept * kept.square().sum((0, 1)).clamp_min(1e-300).rsqrt(), at.residual[..., None]], -1)
        views = points.view.argsort(stable=True).split(points.counts.tolist())
        own, told, unknowns = [], [], 0
        for rows in views:
            poses, free = at.by_eliminated[rows].flatten(0, 1), terms[rows].flatten(0, 1)
            size = free.norm(dim=0)
            poses = _span(poses, poses.norm(dim=0))
            free = free - poses @ (poses.mT @ free)
            told.append(free.square().sum() / max(free.shape[1], 1))
            own.append((torch.cat([poses, _span(free, size)], 1), free))
            unknowns += own[-1][0].shape[1]
        flat = [rest[rows].flatten(0, 1) for rows in views]
        whole = torch.cat([one - basis @ (basis.mT @ one) for one, (basis, _) in zip(flat, own, strict=True)])
        # What each photo has of its own takes along what all have in common of it.
        left, values, right = torch.linalg.svd(whole[:, :-1], full_matrices=False)
        known = values > DETERMINED
        along = left[:, known].mT @ whole[:, -1]
        step = torch.cat([-right[known].mT @ (along / values[known]), whole.new_ones(1)])
        found = [torch.linalg.pinv(free, rtol=DETERMINED) @ (one @ step) for one, (_, free) in zip(flat, own, strict=True)]
        squares = float((whole[:, -1] - left[:, known] @ along).square().sum())
        return _Left(squares, unknowns + int(known.sum()), torch.stack(found), torch.stack(told))

    def scatter(self, sigma_px: float) -> float:
        """Root mean square of terms about their mean, beyond noise (R. Paule and J. Mandel 1982, from the half of the views that
        tell them best)."""
        noise, views = sigma_px**2 / self.told.clamp_min(1e-300), len(self.told)
        weight = (self.told >= self.told.median()).to(noise.dtype)
        for _ in range(PULLS):
            share = weight / weight.sum()
            away = (self.terms - share @ self.terms).square().mean(1) * views / (views - 1)
            found = float((share @ (away - noise)).clamp_min(0.0))
            weight = 1 / (found + noise)
        return math.sqrt(found)


def _span(columns: Float[Tensor, "n m"], size: Float[Tensor, " m"]) -> Float[Tensor, "n k"]:
    """An orthonormal basis of what columns determine that were of this size."""
    vectors, values, _ = torch.linalg.svd(columns / size.clamp_min(1e-300), full_matrices=False)
    return vectors[:, values > DETERMINED]


def _moved(kind: Kind, points: BoardPoints, state: CameraAndBoards) -> Float[Tensor, "n 2 m"]:
    """By how much terms of 1 move the pixels of corners."""
    seen = state.seen(points)
    pixels, _, by_point, _ = state.model.project_with_jacobians(seen)
    if kind == "focal":
        return (pixels - state.model.centre_px)[:, :, None]
    if kind == "centre":
        return torch.eye(2, dtype=pixels.dtype).expand(len(seen), 2, 2)
    if kind == "bend":
        shape = BoardShape.to_refine(("flatness",), points.board)
        return by_point @ state.cam_from_board.rotation[points.view] @ shape.by_terms(points.board) @ shape.free
    height = state.model.image_size[1]
    row = ((points.pixels[:, 1] + 0.5) / height - 0.5)[:, None, None]
    turned = -by_point @ hat(seen)
    return row * (turned if kind == "turn" else torch.cat([turned, by_point], -1))
