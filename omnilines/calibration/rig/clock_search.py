"""Where the search for the offsets of clocks begins: those by which the poses that each camera alone finds agree best.

Seen by cameras of one clock, cam_from_rig = cam_from_board (rig_from_board)^-1 is the same in every instant. Of a camera whose
clock is ahead by d that holds for its poses at t + d, to which its views are moved along the path of the board in their run.
Tried are offsets up to half the length of a run, beyond which few instants are common. That one is taken with which the median
view is nearest to where another camera says (least median of squares, P. Rousseeuw 1984): almost half of the views may be wrong.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose
from omnilines.calibration.rig.consensus import PosedViews
from omnilines.calibration.rig.path import followed, pose_along
from omnilines.calibration.rig.runs import Runs, find_runs
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import CalibrationThresholds

STEPS_OF_GAP = 16
"""Offsets tried from one frame to the next: where the board moves by a whole square in that time, the nearest is off by a
thirtieth, from which the fit finds the rest."""


@dataclass(frozen=True, eq=False)
class ClockSearch:
    """Views with the poses that each camera alone found, and the runs of frames in which they are."""

    posed: PosedViews
    numbers: Int[np.ndarray, " p"]
    """The view of each row of `posed`."""
    runs: Runs
    members: tuple[int, ...]
    """Cameras of the table whose clocks are compared."""
    proposers: int
    """Views, those with the most corners, that say where a camera stands."""

    @staticmethod
    def of(
        views: RigViews, posed: PosedViews, numbers: Int[np.ndarray, " p"], thresholds: CalibrationThresholds
    ) -> "ClockSearch | None":
        """Of the cameras that have instants in common; None where there are no two or no runs of frames."""
        members = _together(posed)
        has = np.isin(np.arange(len(views.camera)), numbers)
        middle_m = np.unique(views.corners.board_m, axis=0).mean(0)
        runs = find_runs(views, members, has, middle_m, thresholds.clocks) if len(members) > 1 else None
        return None if runs is None else ClockSearch(posed, numbers, runs, members, thresholds.rig.proposers)

    @cached_property
    def ahead_s(self) -> dict[int, float]:
        """By how much each member's clock is ahead of the first one's, beyond what frames are put together by."""
        half = self.runs.degree * STEPS_OF_GAP // 2
        # Small offsets come first and stay where others are no better.
        steps_s = self.runs.gap_s / STEPS_OF_GAP * np.array(sorted(range(-half, half + 1), key=abs))
        found = {self.members[0]: 0.0}
        while left := [c for c in self.members if c not in found]:
            known = self.moved(found)[0]
            common = [len(_common(known, self.moved({c: 0.0})[0])[0]) for c in left]
            camera = left[int(np.argmax(common))]
            apart = [_apart_squares(known, self.moved({camera: float(step_s)})[0], self.proposers) for step_s in steps_s]
            found[camera] = float(steps_s[int(np.argmin(apart))])
        return found

    def moved(self, offset_s: dict[int, float]) -> tuple[PosedViews, Int[np.ndarray, " q"]]:
        """The views of these cameras at their times and these offsets on, of those that lie in a run then; and their numbers."""
        paths, unit_s = self._paths, self.runs.unit_s
        later = torch.zeros(int(self.posed.camera.max()) + 1, dtype=torch.float64)
        later[[*offset_s]] = torch.tensor([*offset_s.values()], dtype=torch.float64) / unit_s
        at = paths.tau + later[paths.views.camera]
        # Frames at the ends of a run are in it at the offset 0, whatever rounding does.
        slack = 0.5 * self.runs.gap_s / STEPS_OF_GAP / unit_s
        use = torch.isin(paths.views.camera, torch.tensor([*offset_s]))
        inside = torch.nonzero(use & (at > paths.first - slack) & (at < paths.last + slack)).flatten()
        middle = torch.as_tensor(self.runs.middle_m)
        pose = pose_along(paths.base[inside], paths.rates[inside], at[inside], middle) @ paths.numbered[inside]
        return replace(paths.views.chosen(inside), cam_from_board=pose), self.numbers[paths.rows[inside].numpy()]

    def clocks_s(self, cameras: tuple[int, ...]) -> Float[Tensor, " m"] | None:
        """By how much the clock of each of some cameras is ahead of that of the first; None where one was not compared."""
        if not set(cameras) <= set(self.members):
            return None
        clock_s = {c: beside_s + self.ahead_s[c] for c, beside_s in zip(self.members, self.runs.beside_s.tolist(), strict=True)}
        return torch.tensor([clock_s[c] - clock_s[cameras[0]] for c in cameras], dtype=torch.float64)

    @cached_property
    def _paths(self) -> "_Paths":
        run = torch.as_tensor(self.runs.run[self.numbers])
        rows = torch.nonzero(run >= 0).flatten()
        views, numbers = self.posed.chosen(rows), self.numbers[rows.numpy()]
        beside_s = dict(zip(self.members, self.runs.beside_s.tolist(), strict=True))
        since_s = self.runs.time_s[numbers] - self.runs.middle_s[self.runs.run[numbers]]
        tau = torch.as_tensor((since_s - [beside_s[c] for c in views.camera.tolist()]) / self.runs.unit_s)
        _, path, count = torch.unique(
            torch.stack([views.camera, run[rows], views.board], -1), dim=0, return_inverse=True, return_counts=True
        )
        numbered, none = _numbered_alike(views, path, tau), torch.full((len(count),), torch.inf, dtype=torch.float64)
        seen, middle = views.cam_from_board @ numbered.inverse(), torch.as_tensor(self.runs.middle_m)
        base, rates = followed(seen, path, tau, len(count), self.runs.degree, middle)
        first, last = (none.scatter_reduce(0, path, tau, "amin"), (-none).scatter_reduce(0, path, tau, "amax"))
        return _Paths(views, rows, tau, numbered, base[path], rates[path], first[path], last[path])


@dataclass(frozen=True, eq=False)
class _Paths:
    """Views in runs, and for each of them the path along which its camera alone sees its board."""

    views: PosedViews
    rows: Int[Tensor, " v"]
    tau: Float[Tensor, " v"]
    numbered: Pose
    """`board_from_numbered` of each."""
    base: Pose
    rates: Float[Tensor, "v degree 6"]
    first: Float[Tensor, " v"]
    last: Float[Tensor, " v"]
    """Time of the first and of the last view on the path."""


def _together(posed: PosedViews) -> tuple[int, ...]:
    """The most cameras that have instants in common, one with the next."""
    left, largest = set(torch.unique(posed.camera).tolist()), set[int]()
    while left:
        group, more = set[int](), {min(left)}
        while more:
            group |= more
            frames = posed.frame[torch.isin(posed.camera, torch.tensor([*group]))]
            more = set(torch.unique(posed.camera[torch.isin(posed.frame, frames)]).tolist()) - group
        left -= group
        largest = max(largest, group, key=len)
    return tuple(sorted(largest))


def _numbered_alike(views: PosedViews, path: Int[Tensor, " v"], tau: Float[Tensor, " v"]) -> Pose:
    """`board_from_numbered` of each view: the numbering that is nearest to that of the view before it on its path."""
    chosen, before = views.allowed.to(torch.int8).argmax(1), dict[int, int]()
    for v in torch.argsort(tau, stable=True).tolist():
        last = before.get(int(path[v]))
        if last is not None and int(views.allowed[v].sum()) > 1:
            known = views.cam_from_board[last] @ views.board_from_numbered[last, chosen[last]].inverse()
            off = views.chosen(torch.tensor([v])).distance(Pose(known.rotation[None, None], known.translation[None, None]))
            chosen[v] = off[0, 0].argmin()
        before[int(path[v])] = v
    return views.board_from_numbered[torch.arange(len(views)), chosen]


def _common(known: PosedViews, views: PosedViews) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Rows of views, the second of one camera, that show one board in one instant; of the first ones, that with most corners."""
    order = torch.argsort(known.corners, descending=True, stable=True)
    boards = 1 + max(int(part.board.max()) if len(part) else 0 for part in (known, views))
    there, here = ((part.frame * boards + part.board).numpy() for part in (known.chosen(order), views))
    _, first, second = np.intersect1d(there, here, return_indices=True)
    return order[torch.as_tensor(first)], torch.as_tensor(second)


def _apart_squares(known: PosedViews, views: PosedViews, proposers: int) -> float:
    """How far the median view is from where the known ones say, for the best pose of its camera; corrected for few views (P.
    Rousseeuw and A. Leroy 1987)."""
    first, second = _common(known, views)
    if len(second) < 2:
        return math.inf
    there, here = known.chosen(first), views.chosen(second)
    as_first = there.board_from_numbered[torch.arange(len(there)), there.allowed.to(torch.int8).argmax(1)]
    in_known = there.cam_from_board @ as_first.inverse()
    top = torch.argsort(here.corners, descending=True, stable=True)[:proposers]
    place, numbering = torch.nonzero(here.allowed[top], as_tuple=True)
    view = top[place]
    proposed = here.cam_from_board[view] @ here.board_from_numbered[view, numbering].inverse() @ in_known[view].inverse()
    off = here.distance(proposed[:, None] @ in_known[None]).min(-1).values
    return float(off.median(1).values.min()) * (1 + 5 / (len(second) - 1))
