"""Arcs of several photos put into tracks, one for each line of the world.

Arcs with a good hypothesis take those that support it; every track is triangulated robustly; then every arc goes to the line that
explains it best, tracks of one line become one, and what is left over may form tracks of its own. A few rounds of this settle.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import Hypotheses
from omnilines.matching.kernels.supporters import free_supporters, photos_of_tracks, supporting_photos
from omnilines.matching.kernels.track import claim, needed, united
from omnilines.matching.known_lines import known_lines, most_likely
from omnilines.matching.options import MatchingOptions
from omnilines.progress import ProgressCallback, silent
from omnilines.triangulation.result import Triangulation
from omnilines.triangulation.robust import robust_triangulate

ROUNDS = 3
"""Times that arcs are given to lines anew."""
FIRST_VIEWS = 3
"""Photos that see a line before it is looked at: two planes always meet in a line."""


@dataclass(frozen=True)
class Tracks:
    """Which line every arc shows, and the lines."""

    track: Int[np.ndarray, " n"]
    """-1 where an arc shows none."""
    lines: Triangulation
    rows: Int[np.ndarray, " m"]
    """The arcs that the lines rest on, in the order of `lines.observations`."""
    merged: int
    """Tracks that turned out to be parts of others."""
    inconsistent: int
    """Arcs that were left out because they do not fit the others of their track."""
    explained: int
    """Tracks of which other lines explain all but the arcs of too few photos."""
    enough_views: Int[np.ndarray, " t"]
    """Photos that have to show each line."""
    bowed: Bool[np.ndarray, " n"]
    """Arcs that are taken to be of edges that are not quite straight (`bow.with_bowed`)."""

    def __len__(self) -> int:
        return len(self.lines)

    def members(self, kept: Int[np.ndarray, " k"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """The arcs of the tracks `kept`, and the place of the track of each among them."""
        place = np.full(len(self), -1)
        place[kept] = np.arange(len(kept))
        own = np.where(self.track >= 0, place[self.track], -1)
        rows = np.flatnonzero(own >= 0)
        return rows, own[rows]


def build_tracks(
    arcs: ViewedArcs,
    found: Hypotheses,
    min_views: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
) -> Tracks:
    """Tracks of arcs in at least `min_views` photos, with their lines.

    One photo fewer is enough (not fewer than FIRST_VIEWS) where each arc of the track by itself leads to all the others.
    """
    order = np.argsort(-found.score, kind="stable")
    track, count = claim(order, found.support, arcs.image, arcs.images, FIRST_VIEWS)
    merged = wrong = 0
    for turn in range(ROUNDS):
        progress("building tracks", turn, ROUNDS + 1)
        track, lines, out = triangulated(arcs, track, count)
        track, candidates = _nearest_lines(arcs, track, lines, found.neighbours, options)
        track, fewer = _united(track, candidates, count, options.tracks.same_share)
        merged, wrong = merged + fewer, wrong + out
        free = order[track[order] < 0]
        support = free_supporters(found.support, track)
        more, extra = claim(free, support, arcs.image, arcs.images, FIRST_VIEWS)
        track = np.where(more >= 0, more + count, track)
        track, count = _with_views(arcs, track, count + extra, np.full(count + extra, FIRST_VIEWS))
    explained = 0
    while True:
        # A track that loses members may have too few photos, and one without a line has none.
        track, lines, out = triangulated(arcs, track, count)
        wrong, before = wrong + out, count
        track = _of_tracks(track, np.where(lines.known.numpy(), np.arange(count), -1))
        enough = _enough_views(arcs, track, count, found, min_views, options.tracks.min_agreement)
        track, count = _with_views(arcs, track, count, enough)
        if count < before:
            continue
        own = _needed(arcs, track, lines, enough, found.neighbours, options)
        if own.all():
            break
        explained += int((~own).sum())
        track, count = _of_tracks(track, np.where(own, np.cumsum(own) - 1, -1)), int(own.sum())
    progress("building tracks", ROUNDS + 1, ROUNDS + 1)
    return Tracks(track, lines, np.flatnonzero(track >= 0), merged, wrong, explained, enough, np.zeros(len(arcs), dtype=bool))


def spare_tracks(
    arcs: ViewedArcs, found: Hypotheses, tracks: Tracks, views: int, options: MatchingOptions = MatchingOptions()
) -> Tracks:
    """Tracks of arcs that have none in `tracks`, in at least `views` photos (3 or more): lines there may be, where `tracks` asks
    for more photos. None of those explains what they show."""
    order, count = np.argsort(-found.score, kind="stable"), len(tracks)
    free = order[tracks.track[order] < 0]
    more, extra = claim(free, free_supporters(found.support, tracks.track), arcs.image, arcs.images, views)
    track = np.where(more >= 0, more + count, tracks.track)
    enough = np.append(tracks.enough_views, np.full(extra, views))
    own, explained = np.zeros(len(enough), dtype=bool), 0
    while not own.all():
        track, lines, _ = triangulated(arcs, track, len(enough))
        own = lines.known.numpy() & (_views(arcs, track, len(enough)) >= enough)
        if own[count:].all():
            own = _needed(arcs, track, lines, enough, found.neighbours, options)
            explained += int((~own[count:]).sum())
        own[:count] = True
        track, enough = _of_tracks(track, np.where(own, np.cumsum(own) - 1, -1)), enough[own]
    track, lines, wrong = triangulated(arcs, np.where(track >= count, track - count, -1), len(enough) - count)
    return Tracks(track, lines, np.flatnonzero(track >= 0), 0, wrong, explained, enough[count:], tracks.bowed)


def _enough_views(
    arcs: ViewedArcs, track: Int[np.ndarray, " n"], count: int, found: Hypotheses, min_views: int, min_agreement: float
) -> Int[np.ndarray, " t"]:
    """Photos that have to show each track: `min_views`, or one fewer where all its arcs agree.

    An arc agrees when arcs of all other photos of its track support the best line that it has alone, with `min_agreement` each:
    alike in colour on both sides. By chance three do that far less often than four meet in a line.
    """
    member = np.flatnonzero(track >= 0)
    own = track[member]
    others = _views(arcs, track, count)[own] - 1
    agreeing = supporting_photos(member, found.support, track, arcs.image, arcs.images)
    alone = (agreeing < others) | (found.agreement[member] < min_agreement * others)
    return np.where(np.bincount(own, alone, minlength=count) > 0, min_views, max(min_views - 1, FIRST_VIEWS))


def _needed(
    arcs: ViewedArcs,
    track: Int[np.ndarray, " n"],
    lines: Triangulation,
    enough: Int[np.ndarray, " t"],
    neighbours: Bool[np.ndarray, "m m"],
    options: MatchingOptions,
) -> Bool[np.ndarray, " t"]:
    """The tracks that `enough` photos show by arcs which no line with more photos explains.

    Among edges that repeat themselves arcs of several of them meet in lines that are not there, and most of those arcs fit a
    line that is.
    """
    count = len(lines)
    _, candidates = _nearest_lines(arcs, track, lines, neighbours, options)
    member = np.flatnonzero(track >= 0)
    member = member[np.argsort(track[member], kind="stable")]
    starts = np.searchsorted(track[member], np.arange(count + 1))
    by_views = np.lexsort((-np.diff(starts), -_views(arcs, track, count)))
    by_arc = np.argsort(candidates.arc, kind="stable")
    line_starts = np.searchsorted(candidates.arc[by_arc], np.arange(len(track) + 1))
    return needed(by_views, starts, member, arcs.image, arcs.images, line_starts, candidates.track[by_arc], enough)


def triangulated(arcs: ViewedArcs, track: Int[np.ndarray, " n"], count: int) -> tuple[np.ndarray, Triangulation, int]:
    """The tracks without their wrong members, the lines, and how many members were wrong."""
    rows = np.flatnonzero(track >= 0)
    found = robust_triangulate(arcs.tracks(rows, track[rows], count), method="ml", sigma=1.0)
    inlier = found.inlier.numpy()
    kept = np.full_like(track, -1)
    kept[rows[inlier]] = track[rows[inlier]]
    return kept, found.triangulation, int((~inlier).sum())


@dataclass(frozen=True)
class _Candidates:
    """Arcs and the lines that could be theirs."""

    arc: Int[np.ndarray, " k"]
    track: Int[np.ndarray, " k"]


def _nearest_lines(
    arcs: ViewedArcs,
    track: Int[np.ndarray, " n"],
    lines: Triangulation,
    neighbours: Bool[np.ndarray, "m m"],
    options: MatchingOptions,
) -> tuple[Int[np.ndarray, " n"], _Candidates]:
    """The track whose line explains each arc best, -1 for none, and all that explain it, of those that neighbours show."""
    known = known_lines(arcs, track, lines)
    arc, line, alike, square = known.explaining(arcs, options, known.shown_near(arcs, track, neighbours))
    best = most_likely(arc, alike, square)
    nearest = np.full_like(track, -1)
    nearest[arc[best]] = known.track[line[best]]
    return nearest, _Candidates(arc, known.track[line])


def _united(
    track: Int[np.ndarray, " n"], candidates: _Candidates, count: int, same_share: float
) -> tuple[Int[np.ndarray, " n"], int]:
    """Tracks become one where the line of one explains the arcs of the other; the largest takes its parts first."""
    size = np.bincount(track[track >= 0], minlength=count)
    other = (track[candidates.arc] >= 0) & (track[candidates.arc] != candidates.track)
    pair, times = np.unique(track[candidates.arc[other]] * count + candidates.track[other], return_counts=True)
    part, whole = pair // count, pair % count
    same = times >= same_share * np.maximum(size[part], 1)
    one, another = np.concatenate([part[same], whole[same]]), np.concatenate([whole[same], part[same]])
    by_one = np.argsort(one, kind="stable")
    starts = np.searchsorted(one[by_one], np.arange(count + 1))
    root = united(np.argsort(-size, kind="stable"), starts, another[by_one])
    return _of_tracks(track, root), int((root != np.arange(count)).sum())


def _views(arcs: ViewedArcs, track: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, " t"]:
    """Number of photos that see each track."""
    views: Int[np.ndarray, " t"] = photos_of_tracks(track, arcs.image, count)
    return views


def _with_views(
    arcs: ViewedArcs, track: Int[np.ndarray, " n"], count: int, enough: Int[np.ndarray, " t"]
) -> tuple[Int[np.ndarray, " n"], int]:
    """The tracks that enough photos see, renumbered."""
    keep = _views(arcs, track, count) >= enough
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    return _of_tracks(track, number), int(keep.sum())


def _of_tracks(track: Int[np.ndarray, " n"], values: Int[np.ndarray, " t"]) -> Int[np.ndarray, " n"]:
    """The value of the track of every arc, -1 where it has none."""
    found = np.full_like(track, -1)
    member = track >= 0
    found[member] = values[track[member]]
    return found
