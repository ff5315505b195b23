"""Tracks of the arcs of a room, for the tests of matching, and what all tracks have to be."""

import functools

import numpy as np
import torch
from matching_scenes import (
    room,
)

from omnilines.matching.match import Matched, match_arcs
from omnilines.matching.options import MatchingOptions

OPTIONS = MatchingOptions()
SLACKS_PX, NEIGHBOURS = OPTIONS.tolerance.tried_px, OPTIONS.hypotheses.max_neighbours


def assert_consistent(found: Matched, min_views: int = 4) -> None:
    """What the tracks say of themselves: numbers, photos, lines and the arcs that they rest on."""
    arcs, tracks = found.arcs, found.tracks
    member = tracks.track >= 0
    assert len(tracks.track) == len(arcs) and set(tracks.track[member].tolist()) == set(range(len(tracks)))
    views = np.unique(np.stack([tracks.track[member], arcs.image[member]]), axis=1)[0]
    seen = np.bincount(views, minlength=len(tracks))
    assert bool((seen >= tracks.enough_views).all()) and set(tracks.enough_views.tolist()) <= {
        max(min_views - 1, 3),
        min_views,
    }
    assert bool(tracks.lines.known.all()) and tracks.merged >= 0 and tracks.inconsistent >= 0
    np.testing.assert_array_equal(tracks.rows, np.flatnonzero(member))
    np.testing.assert_array_equal(tracks.lines.observations.track.numpy(), tracks.track[member])
    assert torch.equal(tracks.lines.observations.normal, arcs.planes.normal[tracks.rows])


@functools.cache
def matched(name: str) -> Matched:
    """The room's arcs with noise of 0.3 px, without colours."""
    return match_arcs(room(name).arcs(0.3, 3))
