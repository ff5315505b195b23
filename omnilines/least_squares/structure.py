"""Which blocks an observation touches: one eliminated block, and one block of each kept group."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

LEAST_ROWS = 4
"""Observations in the fullest cell from which one stacked product is faster than a sum of small ones."""
MOST_PADDING = 3
"""Padded rows for each real one up to which stacking pays."""


@dataclass(frozen=True)
class KeptGroup:
    """`count` blocks of `dim` parameters each; observation i touches block `index[i]`, or none where that is -1 (held)."""

    index: Int[Tensor, " n"]
    count: int
    dim: int


@dataclass(frozen=True, eq=False)
class Cells:
    """A partition of the observations, each in the cell `index[i]`, over which products of Jacobians are summed."""

    index: Int[Tensor, " n"]
    count: int

    @cached_property
    def _slots(self) -> Int[Tensor, "count most"] | None:
        """The observations of every cell, -1 (the last row of a padded table) where a cell has fewer than the fullest;
        None where the cells are so uneven that padding would cost more than it saves."""
        n = len(self.index)
        sizes = torch.bincount(self.index, minlength=self.count)
        most = int(sizes.max()) if n else 0
        if most < LEAST_ROWS or most * self.count > MOST_PADDING * n:
            return None
        order = torch.argsort(self.index, stable=True)
        cell = self.index[order]
        first = torch.cumsum(sizes, 0) - sizes
        slots = torch.full((self.count, most), -1, dtype=torch.long, device=self.index.device)
        slots[cell, torch.arange(n, device=self.index.device) - first[cell]] = order
        return slots

    @cached_property
    def _even(self) -> bool:
        """Whether the observations lie in the order of the cells, equally many in each: then nothing need be gathered."""
        slots = self._slots
        return slots is not None and bool((slots.flatten() == torch.arange(slots.numel(), device=slots.device)).all())

    def stacked(self, values: Float[Tensor, "n m q"]) -> Float[Tensor, "count rows q"] | None:
        """The rows of all observations of a cell under one another, padded with zeros; None where that does not pay."""
        slots = self._slots
        if slots is None:
            return None
        if self._even:
            return values.reshape(self.count, -1, values.shape[-1])
        padded = torch.cat([values, values.new_zeros(1, *values.shape[1:])])
        return padded[slots].flatten(1, 2)

    def gram(self, values: Float[Tensor, "n m q"]) -> Float[Tensor, "count q q"]:
        """Sum of V_i' V_i over every cell."""
        stacked = self.stacked(values)
        if stacked is not None:
            return stacked.mT @ stacked
        q = values.shape[-1]
        return values.new_zeros(self.count, q, q).index_add_(0, self.index, values.mT @ values)


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
    def cells(self) -> Cells:
        """The observations of every eliminated block."""
        return Cells(self.index, self.count)

    @cached_property
    def all_shared(self) -> bool:
        """Whether every kept group is one block that all observations touch: then every eliminated block couples with all."""
        return bool(self.groups) and all(group.count == 1 and bool((group.index == 0).all()) for group in self.groups)

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

    def places(self, which: slice, groups: Sequence[int]) -> tuple[Int[Tensor, "n c"], Int[Tensor, "n c"]]:
        """Kept columns of some observations in groups that they all touch, and where these lie in the coupling table."""
        own = torch.arange(which.start, which.stop, device=self.index.device)
        columns, table = [own[:, None][:, :0]], [own[:, None][:, :0]]
        for g in groups:
            within = torch.arange(self.groups[g].dim, device=own.device)
            columns.append(self.offsets[g] + self.groups[g].index[own, None] * self.groups[g].dim + within)
            table.append(self.row[g][torch.searchsorted(self.touching[g], own), None] + within)
        return torch.cat(columns, 1), torch.cat(table, 1)
