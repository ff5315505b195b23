"""The inverse of a sparse symmetric matrix A = L D L' where A itself is not zero, from the factor alone.

Column by column from the last (K. Takahashi, J. Fagan, M. Chin 1973; A. Erisman, W. Tinney, CACM 18, 1975), for i and k in the
pattern of column j of L:

    z_ij = -sum_k z_ik l_kj,   z_jj = 1 / d_j - sum_k l_kj z_kj.

The pattern is that of the elimination, whether an entry of the factor happens to be zero or not: then every z_ik that is asked
for lies in it. It costs about as much as the factor, where solving for all columns grows with the square of their number.
"""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def elimination_pattern(starts: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows below the diagonal of each column of L, ascending, from those of the lower triangle of A.

    Those of a column are its own and those of the columns whose first row below the diagonal it is (its children).
    """
    count = len(starts) - 1
    child, sibling = np.full(count, -1), np.full(count, -1)
    first, capacity, total = np.zeros(count + 1, dtype=np.int64), 4 * len(rows) + count, 0
    found, seen = np.empty(capacity, dtype=np.int64), np.full(count, -1)
    for j in range(count):
        begin = total
        seen[j] = j
        own = starts[j + 1] - starts[j]
        at = child[j]
        while at >= 0:
            own += first[at + 1] - first[at]
            at = sibling[at]
        if total + own > capacity:
            capacity = 2 * (total + own)
            larger = np.empty(capacity, dtype=np.int64)
            larger[:total] = found[:total]
            found = larger
        for t in range(starts[j], starts[j + 1]):
            if rows[t] > j and seen[rows[t]] != j:
                seen[rows[t]] = j
                found[total] = rows[t]
                total += 1
        at = child[j]
        while at >= 0:
            for t in range(first[at], first[at + 1]):
                if seen[found[t]] != j:
                    seen[found[t]] = j
                    found[total] = found[t]
                    total += 1
            at = sibling[at]
        found[begin:total].sort()
        first[j + 1] = total
        if total > begin:
            parent = found[begin]
            sibling[j], child[parent] = child[parent], j
    return first, found[:total].copy()


@njit(cache=True, nogil=True)
@no_type_check
def factor_values(
    starts: np.ndarray, rows: np.ndarray, l_starts: np.ndarray, l_rows: np.ndarray, l_values: np.ndarray
) -> np.ndarray:
    """The entries of L at the places of a pattern, zero where L has none."""
    values, here = np.zeros(len(rows)), np.zeros(len(starts) - 1)
    for j in range(len(starts) - 1):
        for t in range(l_starts[j], l_starts[j + 1]):
            here[l_rows[t]] = l_values[t]
        for t in range(starts[j], starts[j + 1]):
            values[t] = here[rows[t]]
        for t in range(l_starts[j], l_starts[j + 1]):
            here[l_rows[t]] = 0.0
    return values


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
@no_type_check
def inverse_in_pattern(
    starts: np.ndarray, rows: np.ndarray, values: np.ndarray, diagonal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of L D L' below the diagonal, at the places of the pattern, and on it; `values` are those of the unit L."""
    count = len(diagonal)
    below, on = np.zeros(len(rows)), np.zeros(count)
    place, sums = np.full(count, -1), np.zeros(count)
    for j in range(count - 1, -1, -1):
        first, last = starts[j], starts[j + 1]
        for t in range(first, last):
            place[rows[t]] = t
            sums[t - first] = 0.0
        for t in range(first, last):
            k, share = rows[t], values[t]
            own = on[k] * share
            for s in range(starts[k], starts[k + 1]):
                other = place[rows[s]]
                if other >= 0:
                    sums[other - first] += below[s] * share
                    own += below[s] * values[other]
            sums[t - first] += own
        total = 1.0 / diagonal[j]
        for t in range(first, last):
            below[t] = -sums[t - first]
            total += values[t] * sums[t - first]
            place[rows[t]] = -1
        on[j] = total
    return below, on


@njit(cache=True, nogil=True)
@no_type_check
def inverse_blocks_at(
    starts: np.ndarray,
    rows: np.ndarray,
    below: np.ndarray,
    on: np.ndarray,
    order: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    dim: int,
) -> np.ndarray:
    """Blocks (i, j) of the inverse, whose row r of A stands at order[r]."""
    blocks = np.empty((len(i), dim, dim))
    for k in range(len(i)):
        for x in range(dim):
            for y in range(dim):
                a, b = order[dim * i[k] + x], order[dim * j[k] + y]
                if a == b:
                    blocks[k, x, y] = on[a]
                    continue
                low, high = min(a, b), max(a, b)
                own = rows[starts[low] : starts[low + 1]]
                blocks[k, x, y] = below[starts[low] + np.searchsorted(own, high)]
    return blocks
