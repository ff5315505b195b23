"""The reduced normal equations S dk = g of many kept blocks, block-sparse, on the constraint C' dk = 0.

B are the steps that the residuals do not see. C = D^-2 B with the sizes D of a step of each kept parameter that count as one:
where some are lengths and others angles, no solution depends on the units.

A band of blocks is factorised as such, which is fastest for cameras along a path; where the pairs fill little of a wide band,
SuperLU finds an order of its own. Neither takes the constraint's dense rows, so they come afterwards: with Y = S^-1 C

    x = S^-1 g - Y (C'Y)^-1 C' S^-1 g.

Undamped, S is singular along B. As many coordinates as B has columns are then held by a term on their diagonal, which leaves them
at zero, and x is the solution found minus its part along B, as S B = 0. What that part is may be told by another C with
C'B = I (`datum.py`).
"""

from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from omnilines.least_squares.band import BandFactor, band_width
from omnilines.least_squares.datum import weighed
from omnilines.least_squares.pattern import PairPattern
from omnilines.least_squares.selected_inverse import (
    elimination_pattern,
    factor_values,
    inverse_blocks_at,
    inverse_in_pattern,
)

LEAST_DAMPING = 1e-9
"""Damping from which the matrix is definite along the gauge without help."""
WIDE_BAND_FLOPS = 4e9
FULL_BAND = 0.1
"""A band that takes more than so many multiplications and of which the pairs fill less than this share is left to SuperLU."""
DENSE_SIZE = 300
"""Columns up to which the smallest eigenvalue comes from the dense matrix."""
SOLVED_AT_ONCE = 1 << 22
"""Numbers in the columns of the inverse that are solved for at once."""


@runtime_checkable
class Factor(Protocol):
    """A factor of a definite matrix."""

    def solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """S^-1 b."""
        ...

    def inverse_blocks(self, pattern: PairPattern, dim: int) -> Float[np.ndarray, "blocks d d"]:
        """The blocks of S^-1 that the pattern has."""
        ...


def sparse_matrix(pattern: PairPattern, blocks: Float[np.ndarray, "blocks d d"]) -> scipy.sparse.csc_array:
    """S with both triangles."""
    dim = blocks.shape[1]
    within = np.arange(dim)
    i = (dim * pattern.row[:, None, None] + within[:, None]) + np.zeros((1, 1, dim), dtype=np.int64)
    j = (dim * pattern.column[:, None, None] + within) + np.zeros((1, dim, 1), dtype=np.int64)
    upper = i <= j
    size = dim * pattern.kept
    half = scipy.sparse.coo_array((blocks[upper], (i[upper], j[upper])), shape=(size, size)).tocsc()
    return scipy.sparse.csc_array(half + scipy.sparse.triu(half, 1).T)


@dataclass(frozen=True)
class SparseFactor:
    """SuperLU's factor in its symmetric mode, minimum degree on the pattern of S."""

    factor: scipy.sparse.linalg.SuperLU

    @staticmethod
    def of(pattern: PairPattern, blocks: Float[np.ndarray, "blocks d d"]) -> "SparseFactor | None":
        """The factor; None where the matrix is not definite."""
        try:
            factor = scipy.sparse.linalg.splu(
                sparse_matrix(pattern, blocks),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # exactly singular
            return None
        return SparseFactor(factor) if bool((factor.U.diagonal() > 0).all()) else None

    def solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """S^-1 b."""
        return self.factor.solve(right)

    def inverse_blocks(self, pattern: PairPattern, dim: int) -> Float[np.ndarray, "blocks d d"]:
        """The blocks of S^-1 that the pattern has, from the factor alone (`selected_inverse.py`)."""
        order = self.factor.perm_c
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        lower = scipy.sparse.csc_array(self.factor.L)
        own = scipy.sparse.tril(sparse_matrix(pattern, np.ones((len(pattern.row), dim, dim)))[place][:, place], -1).tocsc()
        starts, rows = elimination_pattern(own.indptr, own.indices)
        values = factor_values(starts, rows, lower.indptr, lower.indices, lower.data)
        below, on = inverse_in_pattern(starts, rows, values, self.factor.U.diagonal())
        return inverse_blocks_at(starts, rows, below, on, order, pattern.row, pattern.column, dim)


def _factor(pattern: PairPattern, blocks: Float[np.ndarray, "blocks d d"]) -> Factor | None:
    dim = blocks.shape[1]
    width, size = band_width(pattern, dim) + 1, dim * pattern.kept
    share = len(pattern.row) / max(1, pattern.kept * (pattern.reach + 1))
    if width * width * size > WIDE_BAND_FLOPS and share < FULL_BAND:
        return SparseFactor.of(pattern, blocks)
    return BandFactor.of(pattern, blocks)


@dataclass(frozen=True)
class ReducedSystem:
    """S by its blocks i <= j, with a basis of the gauge B and the factor."""

    pattern: PairPattern
    blocks: Float[np.ndarray, "blocks d d"]
    gauge: Float[np.ndarray, "n g"]
    factor: Factor
    along: Float[np.ndarray, "n g"] | None = field(repr=False)
    """Y (C'Y)^-1 for Y = S^-1 C; None where S is held along the gauge by its diagonal."""
    datum: Float[np.ndarray, "n g"] = field(repr=False)
    """C of the constraint, with C'B = I."""

    @staticmethod
    def of(
        pattern: PairPattern,
        blocks: Float[np.ndarray, "blocks d d"],
        gauge: Float[np.ndarray, "n c"],
        damping: float,
        sizes: Float[np.ndarray, " n"] | None = None,
    ) -> "ReducedSystem | None":
        """The system with these (damped) blocks; `sizes` of steps that count as one, all alike without. None where it does not
        determine the kept blocks."""
        found = scaled_gauge(gauge, np.ones(len(gauge)) if sizes is None else sizes)
        if found is None:
            return None
        free = gauge.shape[1]
        if free == 0 or damping >= LEAST_DAMPING:
            factor = _factor(pattern, blocks)
            if factor is not None:
                along = factor.solve(found.datum) if free else found.datum
                along = np.einsum("ng,gh->nh", along, np.linalg.inv(np.einsum("ng,nh->gh", found.datum, along)))
                return ReducedSystem(pattern, blocks, found.gauge, factor, along, found.datum)
        if free == 0:
            return None
        held = blocks.copy()
        _, _, order = scipy.linalg.qr(found.basis.T, mode="economic", pivoting=True)
        pins = order[:free]
        dim = blocks.shape[1]
        held[pattern.diagonal[pins // dim], pins % dim, pins % dim] *= 2.0
        factor = _factor(pattern, held)
        return None if factor is None else ReducedSystem(pattern, blocks, found.gauge, factor, None, found.datum)

    def in_datum(self, information: Float[np.ndarray, "kept d d"]) -> "ReducedSystem":
        """The undamped system in the frame that weighs every kept block by what is known of it (`datum.py`)."""
        if self.gauge.shape[1] == 0:
            return self
        assert self.along is None, "a damped system says nothing of what is left open"
        return replace(self, datum=weighed(self.gauge, information))

    @property
    def size(self) -> int:
        """Number of kept columns."""
        return self.blocks.shape[1] * self.pattern.kept

    def solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """x with S x = b up to the constraint's forces, C' x = 0."""
        if self.along is None:
            x = self.factor.solve(_without(right, self.datum, self.gauge))
            return _without(x, self.gauge, self.datum)
        return _without(self.factor.solve(right), self.along, self.datum)

    def covariance_blocks(self) -> Float[np.ndarray, "blocks d d"]:
        """The blocks of the constrained inverse that the pattern has."""
        dim = self.blocks.shape[1]
        found = self.factor.inverse_blocks(self.pattern, dim)
        if self.gauge.shape[1] == 0:
            return found
        # (I - B C') Q (I - C B') of a held S, and Q - Y (C'Y)^-1 Y' of a definite one, both as Q - V W' - W V'.
        solved = self.factor.solve(self.datum)
        inner = self.datum.T @ solved
        left = self.gauge if self.along is None else solved
        right = solved - 0.5 * self.gauge @ inner if self.along is None else 0.5 * self.along
        left, right = (v.reshape(self.pattern.kept, dim, -1) for v in (left, right))
        rows, columns = self.pattern.row, self.pattern.column
        for low in range(0, len(rows), 1 << 16):
            i, j = rows[low : low + (1 << 16)], columns[low : low + (1 << 16)]
            found[low : low + (1 << 16)] -= left[i] @ right[j].transpose(0, 2, 1) + right[i] @ left[j].transpose(0, 2, 1)
        return found

    def conjugated_blocks(self, inner: Float[np.ndarray, "blocks d d"]) -> Float[np.ndarray, "blocks d d"]:
        """The blocks that the pattern has of S^-1 K S^-1, K by its own: columns, as many at once as memory allows."""
        dim, kept, size = self.blocks.shape[1], self.pattern.kept, self.size
        between, found = sparse_matrix(self.pattern, inner), np.zeros_like(inner)
        at_once = max(1, SOLVED_AT_ONCE // (size * dim))
        for low in range(0, kept, at_once):
            high = min(kept, low + at_once)
            right = np.zeros((size, dim * (high - low)))
            right[dim * low : dim * high] = np.eye(dim * (high - low))
            columns = self.solve(between @ self.solve(right)).reshape(kept, dim, high - low, dim)
            own = np.flatnonzero((self.pattern.row >= low) & (self.pattern.row < high))
            found[own] = columns[self.pattern.column[own], :, self.pattern.row[own] - low].transpose(0, 2, 1)
        return found

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Of S."""
        return self.blocks[self.pattern.diagonal].diagonal(axis1=1, axis2=2).ravel()

    def weakest(self) -> tuple[float, Float[np.ndarray, " n"]]:
        """The least eigenvalue of S scaled to a unit diagonal, on the gauge's complement, and its direction."""
        diagonal = self.diagonal()
        scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 1.0)
        if self.size - self.gauge.shape[1] < 1:
            return 1.0, np.zeros(self.size)

        def inverse(u: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
            return self.solve((u.ravel() / scale)[:, None])[:, 0] / scale

        if self.size <= DENSE_SIZE:
            right = np.diag(1 / scale)
            values, vectors = np.linalg.eigh(_symmetric(self.solve(right) / scale[:, None]))
        else:
            operator = scipy.sparse.linalg.LinearOperator((self.size, self.size), matvec=inverse, dtype=np.float64)
            start = np.random.default_rng(0).standard_normal(self.size)
            values, vectors = scipy.sparse.linalg.eigsh(operator, k=1, which="LA", v0=start, tol=1e-6)
        return float(1 / values[-1]) if values[-1] > 0 else 0.0, scale * vectors[:, -1]


def _without(x: Float[np.ndarray, "n k"], direction: Float[np.ndarray, "n g"], basis: Float[np.ndarray, "n g"]) -> np.ndarray:
    """x - V B' x. Not by BLAS, whose threads take longer to start than products with so few columns."""
    return x - np.einsum("ng,gk->nk", direction, np.einsum("ng,nk->gk", basis, x))


def _symmetric(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return 0.5 * (matrix + matrix.T)


@dataclass(frozen=True)
class ScaledGauge:
    """The gauge in steps that count as one."""

    basis: Float[np.ndarray, "n g"]
    """Orthonormal, of D^-1 B."""
    sizes: Float[np.ndarray, " n"]
    """D."""

    @property
    def gauge(self) -> Float[np.ndarray, "n g"]:
        """B."""
        return self.sizes[:, None] * self.basis

    @property
    def datum(self) -> Float[np.ndarray, "n g"]:
        """C = D^-2 B, with C'B = I."""
        return self.basis / self.sizes[:, None]


def scaled_gauge(gauge: Float[np.ndarray, "n g"], sizes: Float[np.ndarray, " n"]) -> ScaledGauge | None:
    """The columns as `ScaledGauge` has them; None where they are not independent."""
    if gauge.shape[1] == 0:
        return ScaledGauge(gauge, sizes)
    scaled = gauge / sizes[:, None]
    length = np.linalg.norm(scaled, axis=0)
    if gauge.shape[1] > gauge.shape[0] or not (length > 0).all():
        return None
    basis, triangle = np.linalg.qr(scaled / length)
    return ScaledGauge(basis, sizes) if np.abs(np.diag(triangle)).min() > 1e-12 else None
