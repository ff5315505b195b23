"""Which lines each photo is asked for: in a large scene not all of them.

A line that no neighbour of a photo shows is behind a wall or far away, as seen from there. With a bounded number of neighbours
the pairs of photos and lines grow with the photos, not with their square.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int
from scipy import sparse


@dataclass(frozen=True)
class AskedLines:
    """The lines that each of m photos is asked for: of photo p those are lines[starts[p] : starts[p + 1]], ascending."""

    starts: Int[np.ndarray, " s"]
    lines: Int[np.ndarray, " k"]

    @property
    def photos(self) -> Int[np.ndarray, " k"]:
        """The photo of each pair."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    @staticmethod
    def every(photos: int, lines: int) -> "AskedLines":
        """Each photo is asked for all lines."""
        return AskedLines(lines * np.arange(photos + 1), np.tile(np.arange(lines), photos))

    @staticmethod
    def near(
        neighbours: Bool[np.ndarray, "m m"], image: Int[np.ndarray, " n"], line: Int[np.ndarray, " n"], count: int
    ) -> "AskedLines":
        """Each photo is asked for the lines, of `count`, that it or a neighbour shows: `image` and `line` (-1 for none) are those
        of every arc."""
        member = line >= 0
        ones = np.ones(int(member.sum()), dtype=np.int32)
        shown = sparse.csr_array((ones, (image[member], line[member])), shape=(len(neighbours), count))
        compared = sparse.csr_array((neighbours | np.eye(len(neighbours), dtype=bool)).astype(np.int32))
        found = (compared @ shown).tocsr()
        found.sort_indices()
        return AskedLines(found.indptr.astype(np.int64), found.indices.astype(np.int64))
