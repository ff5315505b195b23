"""Corners of a rig as tensors, part by part."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.calibration.rig.own_motion import OwnMotion
from omnilines.calibration.rig.path import ViewTimes
from omnilines.least_squares import Cells


@dataclass(frozen=True)
class RigPart:
    """The views, and with them the rows, from a first one to an end, that one camera has of one kind of board."""

    camera: int
    other_board: bool
    """Not the first board, which is the frame of the target."""
    views: tuple[int, int]
    rows: tuple[int, int]


@dataclass(frozen=True, eq=False)
class RigPoints:
    """Corners of a rig as tensors, in the order of their cameras, of each camera those on the first board first; a view is one
    board in one photo."""

    view: Int[Tensor, " n"]
    board_m: Float[Tensor, "n 3"]
    pixels: Float[Tensor, "n 2"]
    weight: Float[Tensor, " n"]
    """Inverse standard deviation of each corner, 1 / px."""
    camera: Int[Tensor, " v"]
    """Camera of each view."""
    instant: Int[Tensor, " v"]
    """Pose of the target that cameras with one clock would see."""
    frame: Int[Tensor, " v"]
    """Eliminated block of each view: its instant or, where views have times, its run."""
    board: Int[Tensor, " v"]
    motion: OwnMotion | None = None
    """What is known of each view's own motion of the board; None where cameras see the same."""
    times: ViewTimes | None = None
    """When views were taken; None where cameras have one clock."""
    row_px: Float[Tensor, " n"] | None = None
    """How far each corner lies beyond the middle of its image, in the order in which that is read; None where frames are of one
    instant. The time of a view is then that of the middle."""

    @cached_property
    def by_corner(self) -> "RigPoints":
        """Every corner as a view of its own, at its own time; without the views' own motion."""
        assert self.times is not None and self.row_px is not None
        view, number = self.view, torch.arange(len(self.view))
        times = replace(self.times, time_s=self.times.time_s[view], row_px=self.row_px)
        return replace(
            self,
            view=number,
            camera=self.camera[view],
            instant=self.instant[view],
            frame=self.frame[view],
            board=self.board[view],
            motion=None,
            times=times,
        )

    @cached_property
    def parts(self) -> tuple[RigPart, ...]:
        """The corners by camera, those on the first board apart from those on others."""
        kind = 2 * self.camera + (self.board > 0).to(torch.long)
        counts = torch.bincount(self.view, minlength=len(kind))
        found, first, low = [], 0, 0
        kinds, sizes = torch.unique_consecutive(kind, return_counts=True)
        for number, size in zip(kinds.tolist(), sizes.tolist(), strict=True):
            rows = int(counts[first : first + size].sum())
            found.append(RigPart(number // 2, number % 2 > 0, (first, first + size), (low, low + rows)))
            first, low = first + size, low + rows
        return tuple(found)

    @cached_property
    def cells(self) -> tuple[Cells, ...]:
        """The corners of every view, part by part."""
        return tuple(Cells(self.view[slice(*p.rows)] - p.views[0], p.views[1] - p.views[0]) for p in self.parts)

    def chosen(self, rows: Tensor) -> "RigPoints":
        """Some of the corners; views and frames keep their numbers."""
        return replace(
            self,
            view=self.view[rows],
            board_m=self.board_m[rows],
            pixels=self.pixels[rows],
            weight=self.weight[rows],
            row_px=None if self.row_px is None else self.row_px[rows],
        )
