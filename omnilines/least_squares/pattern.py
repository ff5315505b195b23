"""Which pairs of kept blocks some eliminated block touches together: the block pattern of the reduced system.

Every kept block i has a window of places for its partners i to `last[i]`, so that a pair is found by one addition. Where the
order of the kept blocks makes the band wide, that of Cuthill and McKee (1969), reversed, is taken if it is narrower.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import scipy.sparse
from jaxtyping import Int
from numba import njit
from scipy.sparse.csgraph import reverse_cuthill_mckee

MOST_PIECES = 16
PAIRS_OF_A_BLOCK = 8
"""To add a block of one piece to that of all takes about as long as a pair of observations."""
LEAST_OF_PIECE = 200
"""Eliminated blocks."""


@dataclass(frozen=True)
class PairPattern:
    """The pairs i <= j of `kept` blocks that are touched together, every block with itself among them."""

    kept: int
    window: Int[np.ndarray, " places"]
    block_of: Int[np.ndarray, " pairs"]
    """Number of the block of the pair (i, j) at window[i] + j - i, -1 for a pair that is not touched."""
    row: Int[np.ndarray, " blocks"]
    column: Int[np.ndarray, " blocks"]
    """i and j of every block."""

    @property
    def reach(self) -> int:
        """Largest j - i."""
        return int((self.column - self.row).max()) if len(self.row) else 0

    def blocks_of(self, index: Int[np.ndarray, " n"]) -> tuple[int, int]:
        """The first block, and one after the last, of pairs of some kept blocks; numbers from `kept` on are none."""
        index = index[index < self.kept]
        if not len(index):
            return 0, 0
        return int(self.block_of[self.window[index.min()]]), int(np.searchsorted(self.row, index.max(), side="right"))

    @property
    def diagonal(self) -> Int[np.ndarray, " kept"]:
        """Number of every block with itself."""
        return self.block_of[self.window[: self.kept]].astype(np.int64)


@njit(cache=True, nogil=True)
@no_type_check
def _farthest(start, index, kept, last):
    """The farthest partner of every kept block; the kept blocks of an eliminated one ascend, those not kept are last."""
    for p in range(len(start) - 1):
        high = start[p + 1]
        while high > start[p] and index[high - 1] >= kept:
            high -= 1
        for k in range(start[p], high):
            last[index[k]] = max(last[index[k]], index[high - 1])


@njit(cache=True, nogil=True)
@no_type_check
def _mark(start, index, kept, window, block_of):
    for p in range(len(start) - 1):
        for k in range(start[p], start[p + 1]):
            if index[k] >= kept:
                break
            for m in range(k, start[p + 1]):
                if index[m] >= kept:
                    break
                block_of[window[index[k]] + index[m] - index[k]] = 0


def pair_pattern(start: Int[np.ndarray, " t1"], index: Int[np.ndarray, " n"], kept: int) -> PairPattern:
    """The pattern of eliminated blocks, each touching the kept blocks index[start[p]:start[p + 1]], in ascending order.

    Numbers from `kept` on are those of blocks that do not move.
    """
    last = np.arange(kept)
    _farthest(start, index, kept, last)
    window = np.zeros(kept + 1, dtype=np.int64)
    np.cumsum(last - np.arange(kept) + 1, out=window[1:])
    block_of = np.full(window[-1], -1, dtype=np.int32)
    _mark(start, index, kept, window, block_of)
    block_of[window[:-1]] = 0
    places = np.flatnonzero(block_of == 0)
    block_of[places] = np.arange(len(places), dtype=np.int32)
    row = np.searchsorted(window, places, side="right") - 1
    return PairPattern(kept, window, block_of, row, places - window[row] + row)


def summed_pieces(start: Int[np.ndarray, " t1"], pattern: PairPattern) -> list[int]:
    """Bounds of pieces of the eliminated blocks, of about equal work, that are summed each by itself and then in order.

    They do not depend on the number of threads, nor do then the sums.
    """
    views = np.diff(start)
    work = np.concatenate([[0], np.cumsum(views * (views + 8))])
    pairs = int(views @ (views + 1)) // 2
    count = min(MOST_PIECES, len(views) // LEAST_OF_PIECE, pairs // (PAIRS_OF_A_BLOCK * max(1, len(pattern.row))))
    return np.searchsorted(work, work[-1] * np.arange(max(1, count) + 1) / max(1, count)).tolist()


def narrower_order(pattern: PairPattern) -> Int[np.ndarray, " kept"] | None:
    """The kept blocks in an order that makes the band at least a fifth narrower, None where none is found."""
    if pattern.reach < 2:
        return None
    ones = np.ones(len(pattern.row), dtype=np.int8)
    graph = scipy.sparse.csr_matrix((ones, (pattern.row, pattern.column)), shape=(pattern.kept, pattern.kept))
    order = np.asarray(reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True), dtype=np.int64)
    place = np.empty_like(order)
    place[order] = np.arange(pattern.kept)
    reach = int(np.abs(place[pattern.row] - place[pattern.column]).max())
    return order if reach <= 0.8 * pattern.reach else None
