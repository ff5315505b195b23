"""Which blocks an observation touches: one eliminated block, and one block of each kept group."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Int
from torch import Tensor


@dataclass(frozen=True)
class KeptGroup:
    """`count` blocks of `dim` parameters each; observation i touches block `index[i]`, or none where that is -1 (held)."""

    index: Int[Tensor, " n"]
    count: int
    dim: int


@dataclass(frozen=True)
class SizeClass:
    """Eliminated blocks with equally many kept columns, so that they can be reduced as one batch."""

    blocks: Int[Tensor, " b"]
    columns: Int[Tensor, "b c"]
    """Columns of the kept system that each block touches."""
    rows: Int[Tensor, "b c"]
    """Where those columns lie in the coupling table (see `Structure.row`)."""


@dataclass(frozen=True, eq=False)
class Structure:
    """The arrow pattern of the normal equations.

    The coupling of an eliminated block with each kept column it touches is one row of a table of `dim` columns; `row` says
    where the rows of an observation begin. Kept columns are numbered group after group, block after block.
    """

    index: Int[Tensor, " n"]
    count: int
    dim: int
    groups: tuple[KeptGroup, ...]

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First kept column of each group, and the number of kept columns last."""
        starts = [0]
        for group in self.groups:
            starts.append(starts[-1] + group.count * group.dim)
        return tuple(starts)

    @property
    def kept_size(self) -> int:
        """Number of kept columns."""
        return self.offsets[-1]

    @cached_property
    def touching(self) -> tuple[Int[Tensor, " _"], ...]:
        """Observations that touch each group."""
        return tuple(torch.nonzero(group.index >= 0).flatten() for group in self.groups)

    @cached_property
    def _cells(self) -> tuple[list[Tensor], Tensor, Tensor]:
        """First table row of every touching observation in every group; owner and kept column of every table row."""
        device = self.index.device
        starts: list[Tensor] = []
        owners = [torch.zeros(0, dtype=torch.long, device=device)]
        columns = [torch.zeros(0, dtype=torch.long, device=device)]
        taken = 0
        for group, offset, seen in zip(self.groups, self.offsets, self.touching, strict=False):
            keys, inverse = torch.unique(self.index[seen] * group.count + group.index[seen], return_inverse=True)
            starts.append(taken + inverse * group.dim)
            within = torch.arange(group.dim, device=device)
            owners.append((keys // group.count).repeat_interleave(group.dim))
            columns.append((offset + (keys % group.count)[:, None] * group.dim + within).flatten())
            taken += len(keys) * group.dim
        return starts, torch.cat(owners), torch.cat(columns)

    @property
    def row(self) -> list[Int[Tensor, " _"]]:
        """First table row of every touching observation, one tensor a group."""
        return self._cells[0]

    @property
    def table_size(self) -> int:
        """Number of rows of the coupling table."""
        return len(self._cells[1])

    @cached_property
    def size_classes(self) -> tuple[SizeClass, ...]:
        """The eliminated blocks that are observed, by the number of kept columns they touch."""
        _, owner, column = self._cells
        order = torch.argsort(owner, stable=True)
        counts = torch.bincount(owner, minlength=self.count)
        first = torch.cumsum(counts, 0) - counts
        classes = []
        for size in torch.unique(counts[counts > 0]).tolist():
            blocks = torch.nonzero(counts == size).flatten()
            rows = order[first[blocks][:, None] + torch.arange(size, device=owner.device)]
            classes.append(SizeClass(blocks, column[rows], rows))
        return tuple(classes)
