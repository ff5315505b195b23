"""For every arc the 3D line that the other photos agree on, over all arcs of all photos (`kernels/voting.py`)."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.kernels.voting import best_lines
from omnilines.matching.options import MatchingOptions
from omnilines.progress import Each, ProgressCallback, on_all_cores, silent

MAX_SUPPORTERS = 96
"""Arcs that are remembered for each arc."""
AT_ONCE = 256
"""Arcs that a core works on at a time, and photos whose neighbours are looked for."""
PHOTOS_A_TASK = 25
"""That a worker compares with their neighbours."""
PLACES = 64
"""Parts that each coordinate of a bearing is cut into."""


@dataclass(frozen=True)
class Hypotheses:
    """The best line of every arc: a pair of depths at its ends, and who agrees."""

    inverse_depth: Float[np.ndarray, "n 2"]
    """Per metre, at both ends of the arc; NaN where no arc of another photo could show its line."""
    score: Float[np.ndarray, " n"]
    """Sum over the other photos of the best agreement, each at most 1."""
    rival: Float[np.ndarray, " n"]
    """The same of the best line that does not agree with it."""
    agreement: Float[np.ndarray, " n"]
    """Of the best line, the score by the likeness of colours alone, wherever arcs end."""
    support: Int32[np.ndarray, "n k"]
    """The arcs of other photos that agree, -1 after the last."""
    candidates: Int[np.ndarray, " n"]
    """Arcs of other photos that could show its line, and look like it."""
    neighbours: Bool[np.ndarray, "m m"]
    """The photos that each was compared with."""

    def clearest(self, rows: Int[np.ndarray, " n"], share: float) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """The arcs of the lines that stand out most from their rivals, a share of all: arcs of which these are (of `rows`, one
        for each line), then their supporters, and the line of each."""
        best = np.argsort(self.rival - self.score, kind="stable")[: max(1, math.ceil(share * len(rows)))]
        support = self.support[best]
        member = np.concatenate([rows[best], support[support >= 0]])
        return member, np.concatenate([np.arange(len(best)), np.nonzero(support >= 0)[0]])


def find_hypotheses(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    *,
    rows: Int[np.ndarray, " n"] | None = None,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
    workers: Each | None = None,
) -> Hypotheses:
    """Compare every arc (or those of `rows`) with all arcs of the photos that are neighbours of its own, on all cores, or by
    workers.

    The same arcs give the same result to the last bit, whatever the number of cores, and whoever works on them.
    """
    every = np.arange(len(arcs)) if rows is None else rows
    near = _by_place(arcs)
    place = np.empty_like(near)
    place[near] = np.arange(len(near))
    asked = np.sort(place[every])
    whole = _Compared(
        asked, near, arcs.image, arcs.starts, neighbours, arcs.packed[near], arcs.px_rad[near], arcs.colours[near], options
    )
    if workers is None:
        parts = [replace(whole, rows=asked[at : at + AT_ONCE]) for at in range(0, max(len(asked), 1), AT_ONCE)]
        found = on_all_cores(_best_lines, parts, "matching arcs", progress)
    else:
        progress("matching arcs", 0, 0)
        photos = range(0, arcs.images, PHOTOS_A_TASK)
        found = workers(_best_lines, [whole.of_photos(first, first + PHOTOS_A_TASK) for first in photos])
    back = np.searchsorted(asked, place[every])
    depth, score, support, candidates = (np.concatenate(column)[back] for column in zip(*found, strict=True))
    return Hypotheses(depth, score[:, 0], score[:, 1], score[:, 2], support, candidates, neighbours)


@dataclass(frozen=True)
class _Compared:
    """Arcs that are to be compared, in the order of `_by_place`, with all that this takes: numbers, no pixels."""

    rows: Int[np.ndarray, " k"]
    """Which of these arcs are asked for; the others are of photos that they are compared with."""
    number: Int[np.ndarray, " n"]
    """Of each, where it is among all arcs of all photos."""
    image: Int[np.ndarray, " n"]
    starts: Int[np.ndarray, " s"]
    neighbours: Bool[np.ndarray, "m m"]
    packed: Float[np.ndarray, "n 14"]
    px_rad: Float[np.ndarray, " n"]
    colours: Float[np.ndarray, "n 2 3"]
    options: MatchingOptions

    def of_photos(self, first: int, last: int) -> "_Compared":
        """Those of the photos from `first` up to `last`, with their neighbours: a task that travels. Photos and arcs keep their
        order, on which results depend."""
        own = np.arange(first, min(last, len(self.neighbours)))
        photos = np.union1d(own, np.nonzero(self.neighbours[own])[1])
        kept = np.flatnonzero(np.isin(self.image, photos))
        low, high = self.starts[[first, min(last, len(self.starts) - 1)]]
        image = np.searchsorted(photos, self.image[kept])
        return _Compared(
            np.searchsorted(kept, self.rows[np.searchsorted(self.rows, low) : np.searchsorted(self.rows, high)]),
            self.number[kept],
            image,
            np.searchsorted(image, np.arange(len(photos) + 1)),
            self.neighbours[np.ix_(photos, photos)],
            self.packed[kept],
            self.px_rad[kept],
            self.colours[kept],
            self.options,
        )


def _best_lines(its: _Compared) -> tuple[np.ndarray, ...]:
    """Of the arcs that are asked for, what `best_lines` finds."""
    depth, score, support, tried = best_lines(
        its.rows,
        its.image,
        its.starts,
        its.neighbours,
        its.packed,
        its.px_rad,
        its.colours,
        MAX_SUPPORTERS,
        its.options.hypotheses,
        its.options.likeness,
    )
    return depth, score, np.where(support >= 0, its.number[support], -1).astype(np.int32), tried


def _by_place(arcs: ViewedArcs) -> Int[np.ndarray, " n"]:
    """The arcs photo by photo, in each those that look about the same way after each other: they are compared with the same arcs
    of other photos, which then lie in fast memory, and beside each other.

    Order is that of a cube's cells along a curve of Morton, PLACES cells along each edge.
    """
    cell = ((arcs.bearings.mean(1) + 1.0) * (PLACES / 2)).astype(np.int64).clip(0, PLACES - 1)
    key = np.zeros(len(arcs), dtype=np.int64)
    for bit in range(PLACES.bit_length() - 1):
        for axis in range(3):
            key |= (cell[:, axis] >> bit & 1) << 3 * bit + axis
    return np.lexsort((key, arcs.image))


def near_photos(arcs: ViewedArcs, neighbours: int) -> Bool[np.ndarray, "m m"]:
    """Which photos each is compared with, `neighbours` of the nearest at most."""
    return neighbouring_photos(arcs.poses.centre.numpy(), arcs.poses.rotation[:, 2].numpy(), neighbours)


def neighbouring_photos(
    centres_m: Float[np.ndarray, "m 3"], axes: Float[np.ndarray, "m 3"], most: int
) -> Bool[np.ndarray, "m m"]:
    """Which photos each is compared with: all of them where there are no more than `most` others, else the nearest.

    Photos are near that stand close to each other and look the same way: the distance is stretched by up to four where the
    optical axes are opposed. The relation is symmetric, and a photo is no neighbour of its own.
    """
    count = len(centres_m)
    every = ~np.eye(count, dtype=bool)
    if count - 1 <= most:
        return every
    near = np.zeros_like(every)
    for low in range(0, count, AT_ONCE):
        own = slice(low, low + AT_ONCE)
        stretch = 2.5 - 1.5 * np.clip(axes[own] @ axes.T, -1.0, 1.0)
        distance = np.linalg.norm(centres_m[own, None] - centres_m, axis=-1) * stretch
        distance[~every[own]] = np.inf
        np.put_along_axis(near[own], np.argsort(distance, axis=1, kind="stable")[:, :most], True, 1)
    return near | near.T
