"""Runs of consecutive frames, through which the motion of the board is followed, from the times of views."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from omnilines.calibration.rig.path import ViewTimes
from omnilines.calibration.rig.views import RigViews
from omnilines.calibration.thresholds import ClockThresholds


@dataclass(frozen=True, eq=False)
class Runs:
    """Which run every view of the table is in, and when it was taken."""

    views: RigViews
    run: Int[np.ndarray, " a"]
    """-1: none."""
    middle_s: Float[np.ndarray, " r"]
    """Of each run, by the clock of the first member."""
    time_s: Float[np.ndarray, " a"]
    """Of each view, by the clock of its camera."""
    beside_s: Float[np.ndarray, " m"]
    """Offset of each member's clock as frames are put together: what views of one instant differ by in the median."""
    gap_s: float
    """Between frames of a run, in the median."""
    degree: int
    middle_m: Float[np.ndarray, "3"]
    free: Bool[np.ndarray, " m"]
    """Members whose offset is estimated."""

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.middle_s)

    @property
    def size(self) -> int:
        """Unknowns of a run."""
        return 6 * (1 + self.degree)

    @property
    def unit_s(self) -> float:
        """Half the length of a run."""
        return 0.5 * self.degree * self.gap_s

    def times(self, views: Int[np.ndarray, " v"], delayed: Bool[np.ndarray, " m"] | None) -> ViewTimes:
        """Of some views, all of which are in a run; `delayed` are members whose line delay is estimated."""
        since = self.time_s[views] - self.middle_s[self.run[views]]
        middle, free = torch.as_tensor(self.middle_m), torch.as_tensor(self.free)
        rolling = torch.zeros_like(free) if delayed is None else torch.as_tensor(delayed)
        return ViewTimes(torch.as_tensor(since), self.unit_s, self.degree, middle, free, rolling)


def find_runs(
    views: RigViews,
    members: tuple[int, ...],
    posed: Bool[np.ndarray, " a"],
    middle_m: Float[np.ndarray, "3"],
    limits: ClockThresholds,
) -> Runs | None:
    """The runs of as many consecutive instants as `limits` says in which some member has a posed view; None where there is none,
    views have no times or a member shares no instant with another."""
    time_s = views.corners.times_s
    if time_s is None:
        return None
    found = _put_together(views, members, time_s)
    if found is None:
        return None
    beside_s, instant_s = found
    seen = np.zeros(len(views.frames), dtype=bool)
    seen[views.frame[posed & np.isin(views.camera, members)]] = True
    order = np.flatnonzero(seen & np.isfinite(instant_s))
    order = order[np.argsort(instant_s[order], kind="stable")]
    pieces = _pieces(instant_s[order], limits)
    if not pieces:
        return None
    of_instant, middle_s = np.full(len(views.frames), -1), []
    for number, piece in enumerate(pieces):
        of_instant[order[piece]] = number
        middle_s.append(0.5 * (instant_s[order[piece[0]]] + instant_s[order[piece[-1]]]))
    gap_s = float(np.median(np.concatenate([np.diff(instant_s[order[piece]]) for piece in pieces])))
    run = np.where(np.isin(views.camera, members), of_instant[views.frame], -1)
    # Boards that move by themselves have a path each.
    boards = len(views.boards) if views.moving else 1
    run = np.where(run >= 0, run * boards + (views.board if views.moving else 0), -1)
    return Runs(
        views=views,
        run=run,
        middle_s=np.repeat(np.array(middle_s), boards),
        time_s=time_s,
        beside_s=beside_s,
        gap_s=gap_s,
        degree=limits.frames_of_run - 1,
        middle_m=middle_m,
        free=np.arange(len(members)) > 0,
    )


def usual_gap_s(views: RigViews) -> float:
    """Median time from a frame of a camera to the next one with another time; 0 where all are of one time."""
    time_s = views.corners.times_s
    assert time_s is not None
    gaps = np.concatenate([np.diff(np.unique(time_s[views.camera == c])) for c in np.unique(views.camera)])
    return float(np.median(gaps)) if len(gaps) else 0.0


def _put_together(
    views: RigViews, members: tuple[int, ...], time_s: Float[np.ndarray, " a"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " f"]] | None:
    """The offset of each member's clock, and the time of each instant by the first: from one to the next by common instants."""
    beside = {members[0]: 0.0}
    at = {c: dict(zip(views.frame[views.camera == c].tolist(), time_s[views.camera == c].tolist(), strict=True)) for c in members}
    waiting = deque(members[:1])
    while waiting:
        known = waiting.popleft()
        for c in members:
            common = at[known].keys() & at[c].keys()
            if c not in beside and common:
                beside[c] = beside[known] + float(np.median([at[c][f] - at[known][f] for f in common]))
                waiting.append(c)
    if len(beside) < len(members):
        return None
    total, count = np.zeros(len(views.frames)), np.zeros(len(views.frames))
    for c in members:
        for frame, own in at[c].items():
            total[frame] += own - beside[c]
            count[frame] += 1
    with np.errstate(invalid="ignore"):
        return np.array([beside[c] for c in members]), total / count


def _pieces(instant_s: Float[np.ndarray, " n"], limits: ClockThresholds) -> list[np.ndarray]:
    """Consecutive instants, cut into as many as a run has."""
    gaps = np.diff(instant_s)
    # Frames of one time do not follow one another: times may be unknown, or coarser than frames are apart.
    near = gaps[(gaps > 0) & (gaps <= limits.longest_gap_s)]
    # Where one frame is missing, the motion is not followed.
    apart = (gaps <= 0) | (gaps > min(limits.longest_gap_s, 1.5 * float(np.median(near)) if len(near) else 0.0))
    size, found = limits.frames_of_run, []
    for row in np.split(np.arange(len(instant_s)), np.flatnonzero(apart) + 1):
        found += [row[low : low + size] for low in range(0, len(row) - size + 1, size)]
    return found
