"""Arcs of photos with poses -> tracks: which arcs show one line of the world, and where that line is.

found = match_arcs(arcs)        # ViewedArcs: both ends of every arc as bearings, their noise, colours beside them, poses
found.tracks.track              # (n,) line of every arc or -1; found.tracks.lines: a `Triangulation`

How far arcs of one line may lie apart follows from their stated noise and from a slack for what no arc knows of: errors of poses
and cameras (`tolerance_px`). Unless given, the slack is chosen by the data (`slack.py`). Long edges may be farther from straight
than that (`bow.py`).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from camera_models.errors import InputError
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.bow import shown_bow, with_bowed
from omnilines.matching.hypotheses import Hypotheses, find_hypotheses, near_photos
from omnilines.matching.kernels.supporters import supporting_photos
from omnilines.matching.options import MatchingOptions
from omnilines.matching.shared_view import neighbours_in_view
from omnilines.matching.slack import evidence_of_lines
from omnilines.matching.tracks import Tracks, build_tracks
from omnilines.progress import Each, ProgressCallback, silent

LEAST_VIEWS = 4


@dataclass(frozen=True)
class Matched:
    """The tracks with what led to them."""

    arcs: ViewedArcs
    """As given, widened by the slack; those of tracks that take it into account, by what edges bow too."""
    hypotheses: Hypotheses
    tracks: Tracks
    tolerance_px: float
    """The slack."""
    beyond_chance: bool = True
    """Whether lines stand out by more than sampling explains, where the slack was chosen by that."""
    bow_share: float = 0.0
    """Standard deviation of long arcs from their lines, as edges are not quite straight, over their length."""

    @cached_property
    def bow_px(self) -> Float[np.ndarray, " n"]:
        """Standard deviation that each arc was given as edges are not quite straight."""
        return np.where(self.tracks.bowed, self.bow_share * self.arcs.length_px, 0.0)

    def agreeing_photos(self) -> Int[np.ndarray, " n"]:
        """Number of other photos that support the best line of every arc."""
        every, together = np.arange(len(self.arcs)), np.zeros(len(self.arcs), dtype=np.int64)
        count: Int[np.ndarray, " n"] = supporting_photos(
            every, self.hypotheses.support, together, self.arcs.image, self.arcs.images
        )
        return count


def match_arcs(
    arcs: ViewedArcs,
    *,
    min_views: int = LEAST_VIEWS,
    tolerance_px: float | None = None,
    options: MatchingOptions = MatchingOptions(),
    seed: int = 0,
    progress: ProgressCallback = silent,
    workers: Each | None = None,
) -> Matched:
    """Put arcs into tracks that at least `min_views` photos (3 or more) see. Where `workers` are given, they compare the arcs.

    Raises InputError on a wrong option and GeometryError where fewer than three photos have arcs, or all of them stand at one
    place: then nothing has a depth.
    """
    neighbours = options.hypotheses.max_neighbours
    if min_views < 3 or neighbours < 2 or (tolerance_px is not None and not tolerance_px > 0):
        raise InputError(
            "Matching expects `min_views` of 3 or more, 2 neighbours of a photo and a `tolerance_px` above 0, found "
            f"{min_views}, {neighbours} and {tolerance_px}; correct the option."
        )
    arcs.require_parallax()
    near = near_photos(arcs, neighbours)
    beyond_chance = True
    if tolerance_px is None:
        its = evidence_of_lines(arcs, near, seed, options, progress)
        tolerance_px, beyond_chance = its.tolerance_px, its.beyond_chance
    widened = arcs.widened(tolerance_px)
    near = neighbours_in_view(widened, near, min_views, options, progress, workers)
    found = find_hypotheses(widened, near, options=options, progress=progress, workers=workers)
    tracks = build_tracks(widened, found, min_views, options, progress)
    return Matched(widened, found, tracks, tolerance_px, beyond_chance)


def with_long_edges(
    matched: Matched,
    *,
    min_views: int = LEAST_VIEWS,
    bow_share: float | None = None,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
) -> Matched:
    """The tracks with the long arcs that have none as edges are not quite straight; `bow_share` is found where it is not given.

    The same where edges are straight, and where lines do not stand out.
    """
    near = matched.hypotheses.neighbours
    if bow_share is None:
        bow_share = shown_bow(matched.arcs, near, matched.tolerance_px, options) if matched.beyond_chance else 0.0
    if bow_share == 0.0:
        return matched
    arcs, tracks = with_bowed(matched.arcs, matched.tracks, near, bow_share, min_views, options, progress)
    return replace(matched, arcs=arcs, tracks=tracks, bow_share=bow_share)
