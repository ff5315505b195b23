"""The local coordinates of the views of one camera, put together block by block: what its corners move with."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from omnilines.least_squares import CellPart, Cells


@dataclass
class LocalColumns:
    """Columns of derivatives of the corners, and the blocks of the problem that they follow. The first six are those by the left
    perturbation of the board's pose in the camera."""

    cells: Cells
    """The corners of every view."""
    by_pose: Float[Tensor, "n 2 6"]
    _columns: list[Float[Tensor, "n 2 _"]] = field(default_factory=list)
    _follow: list[tuple[int | None, int, Float[Tensor, "cells _ _"]]] = field(default_factory=list)
    """Group (None: the eliminated block), first column, and how the columns from there follow the block."""

    @property
    def _width(self) -> int:
        return 6 + sum(block.shape[-1] for block in self._columns)

    def by_block(self, group: int | None, values: Float[Tensor, "n 2 k"]) -> None:
        """Corners that move with a block in their own way each."""
        eye = torch.eye(values.shape[-1], dtype=values.dtype).expand(self.cells.count, -1, -1)
        self._follow.append((group, self._width, eye))
        self._columns.append(values)

    def through_pose(self, group: int | None, values: Float[Tensor, "m 6 k"], *, each: bool) -> None:
        """Corners that move with a block as the pose of their board does: that of each view, or of `each` corner."""
        if each:
            self.by_block(group, self.by_pose @ values)
        else:
            self._follow.append((group, 0, values))

    def part(self) -> CellPart:
        """Of the linearised problem."""
        local = torch.cat([self.by_pose, *self._columns], -1)
        placed = []
        for group, low, block in self._follow:
            above = local.shape[-1] - low - block.shape[1]
            placed.append((group, torch.nn.functional.pad(block, (0, 0, low, above))))
        (eliminated,) = [block for group, block in placed if group is None]
        return CellPart(self.cells, local, eliminated, tuple((group, block) for group, block in placed if group is not None))
