"""Whether groups of observations (photos, frames) contradict each other about the kept unknowns, and what that makes of them.

With its eliminated unknowns gone, group g adds S_g = A_g' A_g and h_g = A_g' e_g to the normal equations. Errors that the
observations of a group share show in two ways, which errors of single observations do not cause:

    sum_g h_g' S_g^+ h_g                                     squares that estimates of each group by itself would save,
    d_g = (S - S_g)^-1 h_g,  (G - 1) / G sum (d_g - mean)^2  how the estimate moves without each group (the jackknife).

The first over its freedom is the mean square between groups (the analysis of variance; R. A. Fisher 1925): the variance of unit
weight that they bear out. The second, by B. Efron (1982), needs no model, but few groups leave directions in which they seem to
agree, so that it is added to the first.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from omnilines.least_squares.schur import CellLinearisation, normal_equations, products_of_cells, reduce
from omnilines.least_squares.structure import Structure

OPEN = 1e-10
"""Eigenvalues of S_g below this share of its largest, columns scaled, are those of directions that the group leaves open."""


@dataclass(frozen=True, eq=False)
class Groups:
    """What each group adds to the normal equations of the kept unknowns, near their solution. All together determine them."""

    matrix: Float[Tensor, "g k k"]
    gradient: Float[Tensor, "g k"]

    @staticmethod
    def of_blocks(structure: Structure, at: CellLinearisation, blocks: Int[Tensor, " g"]) -> "Groups":
        """Of some eliminated blocks, each of which is that of a group. All together in one pass: block by block takes as many
        passes over all of them."""
        e, k, weight = structure.dim, structure.kept_size, torch.ones(len(at.residual), dtype=at.residual.dtype)
        place = torch.full((structure.count,), len(blocks))
        place[blocks] = torch.arange(len(blocks))
        # What is of no group goes into one more, which is dropped.
        matrix, gradient = weight.new_zeros((len(blocks) + 1) * k * k), weight.new_zeros((len(blocks) + 1) * k)

        def add(owner: Int[Tensor, " n"], columns: Int[Tensor, "n c"], full: Tensor, right: Tensor) -> None:
            rows = place[owner][:, None] * k + columns
            matrix.index_add_(0, (rows[:, :, None] * k + columns[:, None, :]).flatten(), full.flatten())
            gradient.index_add_(0, rows.flatten(), right.flatten())

        for cells in products_of_cells(structure, at, weight):
            add(cells.owner, cells.columns, cells.full[:, e:, e:], cells.right[:, e:])
        equations = normal_equations(structure, at, weight)
        factor = reduce(equations, 0.0).factor
        for part in structure.size_classes:
            y, g = (
                torch.linalg.solve_triangular(factor[part.blocks], right, upper=False)
                for right in (equations.coupling[part.rows].mT, equations.eliminated_gradient[part.blocks][..., None])
            )
            add(part.blocks, part.columns, -(y.mT @ y), -(y.mT @ g))
        return Groups(matrix.view(-1, k, k)[:-1], gradient.view(-1, k)[:-1])

    def joined(self, larger: Int[Tensor, " g"]) -> "Groups":
        """As fewer groups: those of one number together."""
        numbers, place = torch.unique(larger, return_inverse=True)
        matrix, gradient = (
            self.matrix.new_zeros(len(numbers), *self.matrix.shape[1:]),
            self.gradient.new_zeros(len(numbers), self.gradient.shape[1]),
        )
        return Groups(matrix.index_add(0, place, self.matrix), gradient.index_add(0, place, self.gradient))

    @cached_property
    def between(self) -> tuple[float, int]:
        """Squares that estimates of each group by itself would save, and their degrees of freedom."""
        scale = self._scale
        value, vector = torch.linalg.eigh(self.matrix * scale[:, None] * scale)
        known = value > OPEN * value[:, -1:].clamp_min(1e-300)
        along = (vector.mT @ (scale * self._own)[..., None])[..., 0]
        squares = torch.where(known, along.square() / torch.where(known, value, 1.0), 0.0)
        return float(squares.sum()), int(known.sum()) - len(scale)

    def jackknife(self) -> Float[Tensor, "k k"]:
        """Covariance of the kept unknowns as groups contradict each other."""
        count = len(self.matrix)
        steps = self._steps_without
        steps = steps - steps.mean(0)
        spread = (count - 1) / count * steps.mT @ steps
        return 0.5 * (spread + spread.mT)

    @cached_property
    def _own(self) -> Float[Tensor, "g k"]:
        """The gradients where all together vanish: the solution may hold unknowns that are free here."""
        scale = self._scale
        whole = torch.linalg.cholesky(scale[:, None] * self.matrix.sum(0) * scale)
        step = scale * torch.cholesky_solve((scale * self.gradient.sum(0))[:, None], whole)[:, 0]
        return self.gradient - (self.matrix @ step[:, None])[..., 0]

    @property
    def _scale(self) -> Float[Tensor, " k"]:
        return self.matrix.sum(0).diagonal().clamp_min(1e-300).rsqrt()

    @property
    def _steps_without(self) -> Float[Tensor, "g k"]:
        """How the estimate moves without each group; without one that alone decides something, as if it stayed in."""
        scale = self._scale
        within = self.matrix * scale[:, None] * scale
        factor, info = torch.linalg.cholesky_ex(within.sum(0) - within)
        whole = torch.linalg.cholesky(within.sum(0))
        factor = torch.where((info == 0)[:, None, None], factor, whole)
        return scale * torch.cholesky_solve((scale * self._own)[..., None], factor)[..., 0]
