"""Normal equations of an arrow-structured problem, reduced to the kept blocks (Schur complement).

    [ K   W ] [dk]   [gk]        S = K - W E^-1 W',  S dk = gk - W E^-1 ge,  de = E^-1 (ge - W' dk)
    [ W'  E ] [de] = [ge]

E is block diagonal. With the Cholesky factor E = L L' and Y = W L'^-1, S = K - Y Y'; only Y of the kept columns that a block
touches is formed, batched over blocks with equally many of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.repeatable import total
from omnilines.least_squares.devices import free_bytes
from omnilines.least_squares.structure import Cells, Structure

CHUNK = 8_000_000
"""Entries of Y Y' formed at once: bounds the memory of the reduction to about 64 MB, or a sixteenth of what a GPU has free."""
LEAST_PIVOT = 1e-14
"""Of a factor, squared, over the diagonal of its block: what is less is rounding, of either sign, and the block is singular."""


def chunk_of(device: torch.device) -> int:
    """Entries of products of couplings that are formed at once."""
    free = free_bytes(device)
    return CHUNK if free is None else max(CHUNK, free // 128)


@dataclass(frozen=True)
class KeptPrior:
    """Residuals of the kept blocks alone: what is known of them beforehand. No robust loss is applied to them."""

    residual: Float[Tensor, " m"]
    by_kept: Float[Tensor, "m k"]


@dataclass(frozen=True)
class Linearisation:
    """Residuals and their derivatives at one state; m residuals an observation."""

    residual: Float[Tensor, "n m"]
    by_eliminated: Float[Tensor, "n m e"]
    by_kept: tuple[Float[Tensor, "n m _"], ...]
    """One tensor a kept group."""
    prior: KeptPrior | None = None

    @property
    def prior_cost(self) -> float:
        """Sum of the squared residuals of the prior."""
        return 0.0 if self.prior is None else total(self.prior.residual.square())


@dataclass(frozen=True)
class CellPart:
    """Cells of observations that touch the same kept groups. A cell has few local coordinates x (the pose of a board seen by a
    camera, its intrinsics), and these follow from its blocks: d r = local dx, dx = by_block d block."""

    cells: Cells
    """Which of the part's cells each of its observations lies in."""
    local: Float[Tensor, "n m l"]
    by_eliminated: Float[Tensor, "cells l e"]
    by_kept: tuple[tuple[int, Float[Tensor, "cells l _"]], ...]
    """Each kept group that the cells touch, with the derivative by its block."""


@dataclass(frozen=True)
class CellLinearisation:
    """As `Linearisation`, for observations in cells: there the index of the structure and of its groups goes by cell and not by
    observation, and products are formed once for each cell. Cells and observations come in the order of the parts."""

    residual: Float[Tensor, "n m"]
    parts: tuple[CellPart, ...]
    prior: KeptPrior | None = None

    @property
    def prior_cost(self) -> float:
        """Sum of the squared residuals of the prior."""
        return 0.0 if self.prior is None else total(self.prior.residual.square())


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton blocks of 0.5 sum w |r|^2 and the negative gradient."""

    structure: Structure
    kept: Float[Tensor, "k k"]
    eliminated: Float[Tensor, "count e e"]
    coupling: Float[Tensor, "rows e"]
    kept_gradient: Float[Tensor, " k"]
    eliminated_gradient: Float[Tensor, "count e"]

    def promised_decrease(self, kept: Float[Tensor, " k"], eliminated: Float[Tensor, "count e"], damping: float) -> float:
        """Decrease of sum w |r|^2 that the linear model promises for a damped step d: d' g + damping d' diag(H) d."""
        diagonal = torch.diagonal(self.eliminated, dim1=-2, dim2=-1)
        linear = total(kept * self.kept_gradient) + total(eliminated * self.eliminated_gradient)
        quadratic = total(kept**2 * torch.diagonal(self.kept)) + total(eliminated**2 * diagonal)
        return linear + damping * quadratic


def normal_equations(structure: Structure, at: Linearisation | CellLinearisation, weight: Float[Tensor, " n"]) -> NormalEquations:
    """J' w J and -J' w r, block by block, the prior included."""
    if isinstance(at, Linearisation):
        equations = _of_observations(structure, at, weight)
    else:
        equations = _of_cells(structure, at, weight)
    if at.prior is None:
        return equations
    by_kept = at.prior.by_kept
    return replace(
        equations,
        kept=equations.kept + by_kept.mT @ by_kept,
        kept_gradient=equations.kept_gradient - by_kept.mT @ at.prior.residual,
    )


def _of_observations(structure: Structure, at: Linearisation, weight: Float[Tensor, " n"]) -> NormalEquations:
    root = weight.sqrt()[:, None]
    if structure.all_shared:
        return _shared_normal_equations(structure, at, root[..., None])
    r, je = at.residual * root, at.by_eliminated * root[..., None]
    jk = [j * root[..., None] for j in at.by_kept]
    e, k = structure.dim, structure.kept_size
    eliminated = r.new_zeros(structure.count, e, e).index_add_(0, structure.index, je.mT @ je)
    eliminated_gradient = r.new_zeros(structure.count, e).index_add_(0, structure.index, -(je.mT @ r[..., None])[..., 0])
    coupling = r.new_zeros(structure.table_size, e)
    kept, kept_gradient = r.new_zeros(k * k), r.new_zeros(k)
    parts = zip(structure.groups, structure.offsets, structure.touching, structure.row, jk, strict=False)
    for group, offset, seen, row, j in parts:
        within = torch.arange(group.dim, device=r.device)
        coupling.index_add_(0, (row[:, None] + within).flatten(), (j[seen].mT @ je[seen]).flatten(0, 1))
        column = offset + group.index[seen, None] * group.dim + within
        kept_gradient.index_add_(0, column.flatten(), -(j[seen].mT @ r[seen][..., None]).flatten())
    for a in range(len(structure.groups)):
        for b in range(len(structure.groups)):
            _add_kept_blocks(kept, structure, a, b, jk)
    return NormalEquations(
        structure=structure,
        kept=kept.view(k, k),
        eliminated=eliminated,
        coupling=coupling,
        kept_gradient=kept_gradient,
        eliminated_gradient=eliminated_gradient,
    )


def _shared_normal_equations(structure: Structure, at: Linearisation, root: Float[Tensor, "n 1 1"]) -> NormalEquations:
    """The same where every observation touches all kept columns: one product for each eliminated block gives everything."""
    e, k = structure.dim, structure.kept_size
    joint = torch.cat([at.by_eliminated, *at.by_kept, -at.residual[..., None]], -1) * root
    gram = structure.cells.gram(joint)
    whole = gram[:, e:, e:].sum(0)
    seen = torch.bincount(structure.index, minlength=structure.count) > 0
    # The table of the coupling goes group by group, block by block.
    columns = zip(structure.offsets, structure.offsets[1:], strict=False)
    coupling = torch.cat([gram[seen, e + low : e + high, :e].flatten(0, 1) for low, high in columns])
    return NormalEquations(
        structure=structure,
        kept=whole[:k, :k],
        eliminated=gram[:, :e, :e],
        coupling=coupling,
        kept_gradient=whole[:k, k],
        eliminated_gradient=gram[:, :e, e + k],
    )


@dataclass(frozen=True)
class CellProducts:
    """M' (L' w L) M of the cells of a part, with the local Jacobian L and the chain M to the blocks: first the columns of the
    eliminated block, then those of the kept ones."""

    owner: Int[Tensor, " cells"]
    """Eliminated block of each cell."""
    columns: Int[Tensor, "cells c"]
    """Kept columns."""
    table: Int[Tensor, "cells c"]
    """Where those lie in the coupling table."""
    full: Float[Tensor, "cells b b"]
    right: Float[Tensor, "cells b"]


def products_of_cells(structure: Structure, at: CellLinearisation, weight: Float[Tensor, " n"]) -> Iterator[CellProducts]:
    """Of one part after the other."""
    row = cell = 0
    for part in at.parts:
        rows, cells = slice(row, row + len(part.local)), slice(cell, cell + part.cells.count)
        row, cell = rows.stop, cells.stop
        joint = torch.cat([part.local, -at.residual[rows, :, None]], -1) * weight[rows, None, None].sqrt()
        gram = part.cells.gram(joint)
        chain = torch.cat([part.by_eliminated, *(by for _, by in part.by_kept)], -1)
        full, right = chain.mT @ gram[:, :-1, :-1] @ chain, (chain.mT @ gram[:, :-1, -1:])[..., 0]
        columns, table = structure.places(cells, [group for group, _ in part.by_kept])
        yield CellProducts(structure.index[cells], columns, table, full, right)


def _of_cells(structure: Structure, at: CellLinearisation, weight: Float[Tensor, " n"]) -> NormalEquations:
    """Products of cells, summed."""
    e, k = structure.dim, structure.kept_size
    new = at.residual.new_zeros
    eliminated, gradient = new(structure.count, e, e), new(structure.count, e)
    coupling, kept, kept_gradient = new(structure.table_size, e), new(k * k), new(k)
    for part in products_of_cells(structure, at, weight):
        full, right, columns = part.full, part.right, part.columns
        eliminated.index_add_(0, part.owner, full[:, :e, :e])
        gradient.index_add_(0, part.owner, right[:, :e])
        coupling.index_add_(0, part.table.flatten(), full[:, e:, :e].flatten(0, 1))
        kept_gradient.index_add_(0, columns.flatten(), right[:, e:].flatten())
        kept.index_add_(0, (columns[:, :, None] * k + columns[:, None, :]).flatten(), full[:, e:, e:].flatten())
    return NormalEquations(
        structure=structure,
        kept=kept.view(k, k),
        eliminated=eliminated,
        coupling=coupling,
        kept_gradient=kept_gradient,
        eliminated_gradient=gradient,
    )


def _add_kept_blocks(kept: Tensor, structure: Structure, a: int, b: int, jk: list[Tensor]) -> None:
    """Ja' Jb of two groups, summed into the flat kept matrix."""
    left, right, k = structure.groups[a], structure.groups[b], structure.kept_size
    seen = torch.nonzero((left.index >= 0) & (right.index >= 0)).flatten()
    if left.count == 1 and right.count == 1:
        # All observations share the block: one product instead of a sum of many small ones.
        pair = torch.zeros(1, dtype=torch.long, device=kept.device)
        blocks = (jk[a][seen].flatten(0, 1).mT @ jk[b][seen].flatten(0, 1))[None]
    else:
        pair, inverse = torch.unique(left.index[seen] * right.count + right.index[seen], return_inverse=True)
        blocks = kept.new_zeros(len(pair), left.dim, right.dim).index_add_(0, inverse, jk[a][seen].mT @ jk[b][seen])
    rows = structure.offsets[a] + (pair // right.count)[:, None] * left.dim + torch.arange(left.dim, device=kept.device)
    columns = structure.offsets[b] + (pair % right.count)[:, None] * right.dim + torch.arange(right.dim, device=kept.device)
    kept.index_add_(0, (rows[:, :, None] * k + columns[:, None, :]).flatten(), blocks.flatten())


@dataclass(frozen=True)
class Reduced:
    """The Schur complement and what back-substitution needs."""

    equations: NormalEquations
    matrix: Float[Tensor, "k k"]
    right_side: Float[Tensor, " k"]
    factor: Float[Tensor, "count e e"]
    """Cholesky factors of the (damped) eliminated blocks; identity where a block is not observed."""
    sound: bool
    """False when an eliminated block is singular."""


def reduce(equations: NormalEquations, damping: float) -> Reduced:
    """S and its right side, with Marquardt's damping (1 + damping) on every diagonal."""
    eliminated = equations.eliminated
    diagonal = torch.diagonal(eliminated, dim1=-2, dim2=-1)
    seen = (diagonal > 0).any(-1)
    damped = eliminated + torch.diag_embed(damping * diagonal)
    eye = torch.eye(eliminated.shape[-1], dtype=eliminated.dtype, device=eliminated.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(seen[:, None, None], damped, eye))
    pivots, whole = torch.diagonal(factor, dim1=-2, dim2=-1).square(), torch.diagonal(damped, dim1=-2, dim2=-1)
    sound = not bool((info != 0).any() or ((pivots <= LEAST_PIVOT * whole) & seen[:, None]).any())
    k = equations.structure.kept_size
    matrix = (equations.kept + torch.diag(damping * torch.diagonal(equations.kept))).view(-1)
    right = equations.kept_gradient.clone()
    if not sound:
        return Reduced(equations, matrix.view(k, k), right, factor, False)
    for part in equations.structure.size_classes:
        size = part.columns.shape[1]
        step = max(1, chunk_of(equations.coupling.device) // size**2)
        for low in range(0, len(part.blocks), step):
            blocks, columns = part.blocks[low : low + step], part.columns[low : low + step]
            lower = factor[blocks]
            y = torch.linalg.solve_triangular(lower, equations.coupling[part.rows[low : low + step]].mT, upper=False)
            g = torch.linalg.solve_triangular(lower, equations.eliminated_gradient[blocks][..., None], upper=False)
            right.index_add_(0, columns.flatten(), -(y.mT @ g).flatten())
            if bool((columns == columns[0]).all()):
                stacked = y.flatten(0, 1)
                place = columns[0][:, None] * k + columns[0][None, :]
                matrix[place.flatten()] -= (stacked.mT @ stacked).flatten()
            else:
                place = columns[:, :, None] * k + columns[:, None, :]
                matrix.index_add_(0, place.flatten(), -(y.mT @ y).flatten())
    return Reduced(equations, matrix.view(k, k), right, factor, True)


def back_substitute(reduced: Reduced, kept_step: Float[Tensor, " k"]) -> Float[Tensor, "count e"]:
    """de = E^-1 (ge - W' dk)."""
    equations = reduced.equations
    right = equations.eliminated_gradient.clone()
    for part in equations.structure.size_classes:
        coupled = (equations.coupling[part.rows] * kept_step[part.columns][..., None]).sum(1)
        right.index_add_(0, part.blocks, -coupled)
    return torch.cholesky_solve(right[..., None], reduced.factor)[..., 0]


def eliminated_covariance(reduced: Reduced, kept_covariance: Float[Tensor, "k k"]) -> Float[Tensor, "count e e"]:
    """E^-1 + E^-1 W' Cov_k W E^-1 of every eliminated block (unit variance); NaN where a block is not observed."""
    equations = reduced.equations
    if not reduced.sound:
        return torch.full_like(equations.eliminated, torch.nan)
    seen = (torch.diagonal(equations.eliminated, dim1=-2, dim2=-1) > 0).any(-1)
    result = torch.where(seen[:, None, None], torch.cholesky_inverse(reduced.factor), float("nan"))
    for part in equations.structure.size_classes:
        size = part.columns.shape[1]
        step = max(1, chunk_of(equations.coupling.device) // size**2)
        for low in range(0, len(part.blocks), step):
            blocks, columns = part.blocks[low : low + step], part.columns[low : low + step]
            gain = torch.cholesky_solve(equations.coupling[part.rows[low : low + step]].mT, reduced.factor[blocks])
            local = kept_covariance[columns[:, :, None], columns[:, None, :]]
            result.index_add_(0, blocks, gain @ local @ gain.mT)
    return result


def joint_eliminated_covariance(
    reduced: Reduced, kept_covariance: Float[Tensor, "k k"], blocks: Int[Tensor, " b"]
) -> Float[Tensor, "be be"]:
    """The dense covariance of some eliminated blocks together (unit variance), in the order given; NaN where not observed.

    Cov(e_i, e_j) = [i = j] E_i^-1 + G_i Cov_k G_j' with G = E^-1 W'.
    """
    equations = reduced.equations
    count, dim = equations.eliminated.shape[:2]
    place = torch.full((count,), -1, device=blocks.device)
    place[blocks] = torch.arange(len(blocks), device=blocks.device)
    observed = (torch.diagonal(equations.eliminated, dim1=-2, dim2=-1) > 0).any(-1)[blocks][:, None, None]
    own = torch.where(observed, torch.cholesky_inverse(reduced.factor[blocks]), float("nan"))
    # A block that touches no kept column has no more than its own part.
    gain = torch.where(observed, 0.0, float("nan")).expand(-1, dim, len(kept_covariance)).clone().to(kept_covariance)
    for part in equations.structure.size_classes:
        wanted = torch.nonzero(place[part.blocks] >= 0).flatten()
        at, factor = place[part.blocks[wanted]], reduced.factor[part.blocks[wanted]]
        local = torch.cholesky_solve(equations.coupling[part.rows[wanted]].mT, factor)
        columns = part.columns[wanted][:, None, :].expand(-1, dim, -1)
        gain[at] = torch.zeros_like(gain[at]).scatter_(-1, columns, local)
    flat = gain.flatten(0, 1)
    return torch.block_diag(*own) + flat @ kept_covariance @ flat.mT
