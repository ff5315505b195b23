"""The straight edges of a scene: sides of its faces, those on one line joined where they touch."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from omnilines.scenes.polygon_scene import PolygonScene

SAME_M = 1e-6
"""Points nearer than this are one, and sides nearer than this to a line lie on it."""
SHORTEST_M = 0.005


def scene_edges(scene: PolygonScene) -> Float[np.ndarray, "e 2 3"]:
    """End points (m) of all edges, none overlapping another: where sides of faces overlap or touch on one line they are one edge.

    The order follows from the scene. Seams inside a surface are no edges; edges shorter than SHORTEST_M are left out.
    """
    first = scene.corners_m[scene.shows]
    second = np.roll(scene.corners_m, -1, 1)[scene.shows]
    length = np.linalg.norm(second - first, axis=-1)
    first, second = first[length > SAME_M], second[length > SAME_M]
    line, direction, foot = _lines(first, second)
    low, high = np.sort(np.stack([np.einsum("ni,ni->n", point, direction[line]) for point in (first, second)], -1), axis=-1).T
    group, start, end = _unions(line, low, high)
    kept = end - start >= SHORTEST_M
    along = np.stack([start, end], -1)[kept]
    return foot[group[kept], None] + along[..., None] * direction[group[kept], None]


def _lines(
    first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """The line of each segment, and of each line its unit direction and its point nearest to the origin."""
    direction = second - first
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    # One sense for both: the largest component is positive.
    largest = np.take_along_axis(direction, np.abs(direction).argmax(-1)[:, None], -1)
    direction *= np.sign(largest)
    foot = first - np.einsum("ni,ni->n", first, direction)[:, None] * direction
    # Buckets of a coarse grid would cut a group in two at their borders: lines are joined to their near neighbours instead.
    line = _clusters(np.concatenate([direction, foot], -1))
    _, representative = np.unique(line, return_index=True)
    return line, direction[representative], foot[representative]


def _clusters(keys: Float[np.ndarray, "n 6"]) -> Int[np.ndarray, " n"]:
    """Number of the group of each row, groups being rows that agree to SAME_M in every column, in the order of appearance."""
    pairs = cKDTree(keys).query_pairs(SAME_M, p=np.inf, output_type="ndarray")
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    _, label = connected_components(links, directed=False)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _unions(
    line: Int[np.ndarray, " n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Unions of intervals on each line: line, start and end of every one."""
    order = np.lexsort((low, line))
    line, low, high = line[order], low[order], high[order]
    # The farthest end so far on the same line: lines are set apart by more than any coordinate.
    apart = 2.0 * (np.abs(np.stack([low, high])).max(initial=0.0) + 1.0)
    reached = np.maximum.accumulate(high + line * apart) - line * apart
    begins = np.ones(len(line), dtype=bool)
    begins[1:] = (line[1:] != line[:-1]) | (low[1:] > reached[:-1] + SAME_M)
    start = np.flatnonzero(begins)
    last = np.append(start[1:], len(line)) - 1
    return line[start], low[start], reached[last]
