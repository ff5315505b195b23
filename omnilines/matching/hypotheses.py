"""For every arc the 3D line that the other photos agree on, over all arcs of all photos (`hypothesis_kernel`)."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypothesis_kernel import best_lines

MOST_SUPPORTERS = 96
"""Arcs that are remembered for each arc."""
AT_ONCE = 256
"""Arcs that a core works on at a time."""


@dataclass(frozen=True)
class Hypotheses:
    """The best line of every arc: a pair of depths at its ends, and who agrees."""

    inverse_depth: Float[np.ndarray, "n 2"]
    """Per metre, at both ends of the arc; NaN where no arc of another photo could show its line."""
    score: Float[np.ndarray, " n"]
    """Sum over the other photos of the best agreement, each at most 1."""
    rival: Float[np.ndarray, " n"]
    """The same of the best line that does not agree with it."""
    support: Int32[np.ndarray, "n k"]
    """The arcs of other photos that agree, -1 after the last."""
    candidates: Int[np.ndarray, " n"]
    """Arcs of other photos that could show its line, and look like it."""


def find_hypotheses(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    *,
    rows: Int[np.ndarray, " n"] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Hypotheses:
    """Compare every arc (or those of `rows`) with all arcs of the photos that are neighbours of its own, on all cores.

    The same arcs give the same result, whatever the number of cores.
    """
    every = np.arange(len(arcs)) if rows is None else rows
    parts = [every[at : at + AT_ONCE] for at in range(0, max(len(every), 1), AT_ONCE)]

    def work(rows: Int[np.ndarray, " k"]) -> tuple[np.ndarray, ...]:
        return best_lines(rows, arcs.image, arcs.starts, neighbours, arcs.packed, arcs.colours, MOST_SUPPORTERS)

    found = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, part in enumerate(pool.map(work, parts), 1):
            found.append(part)
            progress(done, len(parts))
    depth, score, support, candidates = (np.concatenate(column) for column in zip(*found, strict=True))
    return Hypotheses(depth, score[:, 0], score[:, 1], support, candidates)


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
    distance = np.linalg.norm(centres_m[:, None] - centres_m, axis=-1) * (2.5 - 1.5 * np.clip(axes @ axes.T, -1.0, 1.0))
    distance[~every] = np.inf
    near = np.zeros_like(every)
    np.put_along_axis(near, np.argsort(distance, axis=1, kind="stable")[:, :most], True, 1)
    return near | near.T
