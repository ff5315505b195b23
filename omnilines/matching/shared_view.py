"""Which neighbours of a photo see what it sees: those behind a wall stand near and share nothing.

Such photos add no line, and take some away: their arcs meet those of this side by chance, in lines that are not there, and where
they look through the wall without showing a line they count against it. So the sharpest arcs are put into tracks first, and
photos are neighbours that share more lines than chance gives.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import find_hypotheses
from omnilines.matching.options import MatchingOptions
from omnilines.matching.tracks import Tracks, build_tracks
from omnilines.progress import ProgressCallback, silent


def neighbours_in_view(
    arcs: ViewedArcs,
    near: Bool[np.ndarray, "m m"],
    min_views: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
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
    shared = _shared(few, build_tracks(few, find_hypotheses(few, near, options=options), min_views, options))
    lines = shared.diagonal()
    fewer = np.minimum(lines[:, None], lines)
    by_chance = (min_views - 1) / near.sum(1).clip(1) * lines
    share = np.where(np.eye(len(near), dtype=bool), 0.0, shared / fewer.clip(1))
    most = np.argsort(-share, axis=1, kind="stable")[:, : options.hypotheses.max_neighbours]
    chosen = np.zeros_like(near)
    np.put_along_axis(chosen, most, True, 1)
    beyond = (share > 0) & (shared >= np.minimum(by_chance[:, None], by_chance))
    return ((chosen | chosen.T) & beyond) | (near & (fewer == 0))


def _sharpest(arcs: ViewedArcs, most: int) -> ViewedArcs:
    """Of each photo the arcs whose great circles are known best, so many at most, in the same order."""
    order = np.lexsort((arcs.circle_sigma_rad, arcs.image))
    rank = np.arange(len(arcs)) - arcs.starts[arcs.image]
    return arcs.rows(np.sort(order[rank < most]))


def _shared(arcs: ViewedArcs, found: Tracks) -> Float[np.ndarray, "m m"]:
    """Number of lines that each two of m photos show (m, m); on the diagonal those of each."""
    member = found.track >= 0
    ones = np.ones(int(member.sum()))
    shows = sparse.csr_array((ones, (arcs.image[member], found.track[member])), shape=(arcs.images, len(found)))
    shows.sum_duplicates()
    shows.data[:] = 1.0
    shared: Float[np.ndarray, "m m"] = (shows @ shows.T).toarray()
    return shared
