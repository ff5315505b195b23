"""Which neighbours of a photo see what it sees: those behind a wall stand near and share nothing.

Such photos add no line, and take some away: their arcs meet those of this side by chance, in lines that are not there, and where
they look through the wall without showing a line they count against it. So the best hypotheses of the sharpest arcs take
those that support them, and photos are neighbours that share more lines so than chance gives.
"""

import numpy as np
from jaxtyping import Bool
from scipy import sparse

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import AT_ONCE, Hypotheses, find_hypotheses
from omnilines.matching.kernels.track import claim
from omnilines.matching.options import MatchingOptions
from omnilines.progress import Each, ProgressCallback, silent


def neighbours_in_view(
    arcs: ViewedArcs,
    near: Bool[np.ndarray, "m m"],
    min_views: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
    workers: Each | None = None,
) -> Bool[np.ndarray, "m m"]:
    """The neighbours that each photo is matched with, of the nearest ones, `near`: those that share most of its lines, of which
    at least `min_views` photos show each. Where every photo is near, they are all of them.

    Were all lines of a photo there by chance, each shown by `min_views` photos, every one of its k neighbours would show
    (min_views - 1) / k of them in the mean. Asked is for so much of the lines of one of both; where one of both has no line, what
    is near stays.
    """
    if near.sum() == near.size - len(near):
        return near
    progress("looking who sees the same", 0, 0)
    few = _sharpest(arcs, options.hypotheses.sharpest_arcs)
    shows = _shows(few, find_hypotheses(few, near, options=options, workers=workers), min_views)
    lines = np.diff(shows.indptr).astype(np.float64)
    by_chance = (min_views - 1) / near.sum(1).clip(1) * lines
    chosen = np.zeros_like(near)
    for low in range(0, len(near), AT_ONCE):
        own = slice(low, low + AT_ONCE)
        shared = (shows[own] @ shows.T).toarray()
        beyond = (shared > 0) & (shared >= np.minimum(by_chance[own, None], by_chance))
        np.fill_diagonal(beyond[:, low:], False)
        share = np.where(beyond, shared / np.minimum(lines[own, None], lines).clip(1), 0.0)
        most = np.argsort(-share, axis=1, kind="stable")[:, : options.hypotheses.max_neighbours]
        np.put_along_axis(chosen[own], most, np.take_along_axis(beyond, most, 1), 1)
    blind = lines == 0
    return chosen | chosen.T | (near & (blind[:, None] | blind))


def _sharpest(arcs: ViewedArcs, most: int) -> ViewedArcs:
    """Of each photo the arcs whose great circles are known best, so many at most, in the same order."""
    order = np.lexsort((arcs.circle_sigma_rad, arcs.image))
    rank = np.arange(len(arcs)) - arcs.starts[arcs.image]
    return arcs.rows(np.sort(order[rank < most]))


def _shows(arcs: ViewedArcs, found: Hypotheses, min_views: int) -> sparse.csr_array:
    """1 where a photo shows a line (photos, lines), of the lines that at least `min_views` photos show."""
    order = np.argsort(-found.score, kind="stable")
    track, count = claim(order, found.support, arcs.image, arcs.images, min_views)
    member = track >= 0
    ones = np.ones(int(member.sum()))
    shows = sparse.csr_array((ones, (arcs.image[member], track[member])), shape=(arcs.images, count))
    shows.sum_duplicates()
    shows.data[:] = 1.0
    return shows
