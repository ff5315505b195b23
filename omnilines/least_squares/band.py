"""Cholesky factor of a symmetric band matrix of blocks, in place, and the inverse inside the band.

Narrow bands, which stay in a core's cache, are factorised here: LAPACK is no faster there, and on a busy machine its threads wait
for each other at every few columns. Wide ones are left to it.

The matrix is stored by columns of its lower triangle, `band[j, i - j]` for 0 <= i - j <= width. The inverse inside the band
follows from the factor alone, column by column from the last (K. Takahashi, J. Fagan, M. Chin 1973):

    z_jj = (1 / l_jj - sum_i l_ij z_ij) / l_jj,   z_ij = -sum_k z_ik l_kj / l_jj
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.linalg import lapack

from omnilines.least_squares.pattern import PairPattern

NARROW = 400
"""Diagonals up to which a band counts as narrow."""


@njit(cache=True, nogil=True)
@no_type_check
def _fill(row, column, blocks, band):
    dim = blocks.shape[1]
    for k in range(len(row)):
        shift = dim * (column[k] - row[k])
        for x in range(dim):
            # Row x of the block (i, j) is column 6 i + x of the lower triangle, from row 6 j on.
            j = dim * row[k] + x
            for y in range(x if shift == 0 else 0, dim):
                band[j, shift + y - x] = blocks[k, x, y]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
@no_type_check
def _factorise(band):
    """The factor in place, column by column; False where the matrix is not definite."""
    count, width = band.shape[0], band.shape[1] - 1
    for j in range(count):
        m = min(width, count - 1 - j)
        if not band[j, 0] > 0.0:
            return False
        root = math.sqrt(band[j, 0])
        band[j, 0] = root
        for i in range(1, m + 1):
            band[j, i] /= root
        for c in range(1, m + 1):
            share = band[j, c]
            for i in range(m - c + 1):
                band[j + c, i] -= share * band[j, c + i]
    return True


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
@no_type_check
def _solve(factor, x):
    """x (n x k) becomes S^-1 x."""
    count, width, columns = factor.shape[0], factor.shape[1] - 1, x.shape[1]
    for j in range(count):
        for k in range(columns):
            x[j, k] /= factor[j, 0]
        for i in range(1, min(width, count - 1 - j) + 1):
            for k in range(columns):
                x[j + i, k] -= factor[j, i] * x[j, k]
    for j in range(count - 1, -1, -1):
        for i in range(1, min(width, count - 1 - j) + 1):
            for k in range(columns):
                x[j, k] -= factor[j, i] * x[j + i, k]
        for k in range(columns):
            x[j, k] /= factor[j, 0]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
@no_type_check
def _invert(factor, inverse):
    count, width = factor.shape[0], factor.shape[1] - 1
    v = np.empty(width + 1)
    for j in range(count - 1, -1, -1):
        m = min(width, count - 1 - j)
        column = factor[j]
        v[: m + 1] = 0.0
        for c in range(1, m + 1):
            own = inverse[j + c]
            share = column[c]
            total = own[0] * share
            for i in range(1, m - c + 1):
                v[c + i] += own[i] * share
                total += own[i] * column[c + i]
            v[c] += total
        scale = 1.0 / column[0]
        total = scale
        for c in range(1, m + 1):
            inverse[j, c] = -v[c] * scale
            total += column[c] * v[c] * scale
        inverse[j, 0] = total * scale


@njit(cache=True, nogil=True)
@no_type_check
def _take(row, column, band, blocks):
    dim = blocks.shape[1]
    for k in range(len(row)):
        shift = dim * (column[k] - row[k])
        for x in range(dim):
            for y in range(dim):
                if shift == 0 and y < x:
                    blocks[k, x, y] = band[dim * row[k] + y, x - y]
                else:
                    blocks[k, x, y] = band[dim * row[k] + x, shift + y - x]


def band_width(pattern: PairPattern, dim: int) -> int:
    """Number of sub-diagonals."""
    return dim * (pattern.reach + 1) - 1


@dataclass(frozen=True)
class BandFactor:
    """L of a positive definite matrix S = L L'."""

    factor: Float[np.ndarray, "n w"]

    @staticmethod
    def of(pattern: PairPattern, blocks: Float[np.ndarray, "blocks d d"]) -> "BandFactor | None":
        """The factor of the matrix with these blocks; None where it is not definite."""
        dim = blocks.shape[1]
        band = np.zeros((dim * pattern.kept, band_width(pattern, dim) + 1))
        _fill(pattern.row, pattern.column, blocks, band)
        if band.shape[1] <= NARROW:
            return BandFactor(band) if _factorise(band) else None
        _, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        return BandFactor(band) if info == 0 else None

    def solve(self, right: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """S^-1 b."""
        if self.factor.shape[1] <= NARROW:
            found = np.array(right, order="C")
            _solve(self.factor, found)
            return found
        solution, _ = lapack.dpbtrs(self.factor.T, right, lower=1)
        return solution

    def inverse_blocks(self, pattern: PairPattern, dim: int) -> Float[np.ndarray, "blocks d d"]:
        """The blocks of S^-1 that the pattern has."""
        inverse = np.zeros_like(self.factor)
        _invert(self.factor, inverse)
        blocks = np.empty((len(pattern.row), dim, dim))
        _take(pattern.row, pattern.column, inverse, blocks)
        return blocks
