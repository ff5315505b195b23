"""Long edges that are not quite straight: how far they are from it, and their tracks.

Shelves sag, walls are plastered by hand, and a panorama is stitched of lenses that do not quite agree. A long arc follows its
edge to a tenth of a pixel and still lies a pixel beside the line that other photos show, while short arcs are less certain than
that anyway. So the longest edges, those that everybody sees, would be lost. What arcs lie apart beyond their noise and the slack
of the poses is taken for a share of their length. The arcs themselves tell how large it is (`shown_bow`), and those that show no
line as they are are matched once more with it (`with_bowed`): they are few, so that hardly any meet by chance.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.hypotheses import find_hypotheses
from omnilines.matching.known_lines import known_lines, most_likely
from omnilines.matching.options import MatchingOptions
from omnilines.matching.tracks import Tracks, build_tracks, triangulated
from omnilines.progress import ProgressCallback, silent
from omnilines.triangulation.robust import noise_level

LEAST_PHOTOS = 3
"""Of a line that tells anything: two planes always meet in one."""


def shown_bow(
    arcs: ViewedArcs,
    neighbours: Bool[np.ndarray, "m m"],
    tolerance_px: float,
    options: MatchingOptions = MatchingOptions(),
) -> float:
    """Standard deviation of arcs from their lines beyond their noise and the slack `tolerance_px` that they were widened by, over
    their length.

    It is told by the arcs that are longest for what their noise is, among those of the lines that stand out most; of these only
    by arcs so long that a bow of `options.bow.most_share` is several times their noise. 0 where they are too few, and where they
    show no more than arcs may err for what they state (`options.tolerance.max_noise_factor`).
    """
    its, bowed = options.bow, arcs.bowed(options.bow.most_share)
    rows = np.sort(np.argsort(-arcs.length_px / arcs.sigma_px, kind="stable")[: its.telling_arcs])
    member, track = find_hypotheses(bowed, neighbours, rows=rows, options=options).clearest(rows, options.tolerance.showing_share)
    telling = its.most_share * arcs.length_px[member] > its.min_sigmas * arcs.sigma_px[member]
    member, track, count = _seen_by_enough(member[telling], track[telling], arcs.image)
    if count < its.min_lines:
        return 0.0
    level = noise_level(bowed.tracks(member, track, count))
    length_px, stated_px2 = float(np.median(arcs.length_px[member])), float(np.median(arcs.sigma_px[member])) ** 2
    shown_px2 = level**2 * (stated_px2 + (its.most_share * length_px) ** 2)
    own_px2 = stated_px2 - tolerance_px**2
    if not shown_px2 > options.tolerance.max_noise_factor**2 * own_px2 + tolerance_px**2:
        return 0.0
    # Two digits, since they are printed, and no more is known of it.
    return float(f"{math.sqrt(shown_px2 - stated_px2) / length_px:.2g}")


def _seen_by_enough(
    member: Int[np.ndarray, " n"], track: Int[np.ndarray, " n"], image: Int[np.ndarray, " a"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], int]:
    """The members of the tracks that enough photos see, with their tracks numbered anew, and how many tracks there are."""
    pairs = np.unique(np.stack([track, image[member]]), axis=1)
    photos = np.bincount(pairs[0], minlength=int(track.max(initial=0)) + 1)
    kept = photos[track] >= LEAST_PHOTOS
    own, number = np.unique(track[kept], return_inverse=True)
    return member[kept], number, len(own)


def with_bowed(
    arcs: ViewedArcs,
    tracks: Tracks,
    neighbours: Bool[np.ndarray, "m m"],
    bow_share: float,
    min_views: int,
    options: MatchingOptions = MatchingOptions(),
    progress: ProgressCallback = silent,
) -> tuple[ViewedArcs, Tracks]:
    """The tracks with long arcs that had none: of lines that explain them with a noise that is larger by `bow_share`, and, after
    these, of tracks of their own. The arcs that are taken so have that noise.

    Arcs take part for which that outweighs what they state and the slack.
    """
    bowed = arcs.bowed(bow_share)
    long = np.flatnonzero((tracks.track < 0) & (bow_share * arcs.length_px > arcs.sigma_px))
    known, track = known_lines(arcs, tracks.track, tracks.lines), tracks.track.copy()
    arc, line, alike, square = known.explaining(bowed.rows(long), options, known.shown_near(arcs, track, neighbours))
    best = most_likely(arc, alike, square)
    track[long[arc[best]]] = known.track[line[best]]
    rest = long[track[long] < 0]
    some = bowed.rows(rest)
    more = build_tracks(some, find_hypotheses(some, neighbours, options=options), min_views, options, progress)
    track[rest[more.rows]] = more.track[more.rows] + len(tracks)
    taken = np.zeros(len(arcs), dtype=bool)
    taken[long] = track[long] >= 0
    noisier = replace(arcs, covariance_px2=np.where(taken[:, None, None, None], bowed.covariance_px2, arcs.covariance_px2))
    track, lines, wrong = triangulated(noisier, track, len(tracks) + len(more))
    return noisier, Tracks(
        track,
        lines,
        np.flatnonzero(track >= 0),
        tracks.merged + more.merged,
        tracks.inconsistent + more.inconsistent + wrong,
        tracks.explained + more.explained,
        np.append(tracks.enough_views, more.enough_views),
        taken,
    )
