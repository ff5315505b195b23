"""Photos placed by the lines of other photos: poses that are off are mended, and photos without a pose find one.

What is placed is one photo, or several that move as one: those of a rig at one instant.

A right pose is told from a wrong one by how many arcs of the photo are explained, to their noise, by lines that look like them:
most of them under the right one, a small share under any other. What the best of the others explains is what chance does.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from camera_models.pose import Pose
from omnilines.matching.arcs import ViewedArcs
from omnilines.matching.known_lines import KnownLines, known_lines
from omnilines.matching.options import MatchingOptions
from omnilines.matching.photo_starts import start_poses
from omnilines.matching.resection import PlacedByLines, explained_by_lines, refined_by_lines
from omnilines.matching.tracks import Tracks
from omnilines.triangulation.batches import triangulate_on


def lines_of_tracks(arcs: ViewedArcs, track: Int[np.ndarray, " n"], count: int) -> KnownLines:
    """The lines of `count` tracks from the poses of `arcs`; `track` is that of every arc, -1 for none."""
    rows = np.flatnonzero(track >= 0)
    found = triangulate_on(torch.device("cpu"), "ml", arcs.tracks(rows, track[rows], count))
    return known_lines(arcs, track, found)


def lines_of_others(known: KnownLines, arcs: ViewedArcs, tracks: Tracks, images: Int[np.ndarray, " m"]) -> KnownLines:
    """The lines of tracks as all photos but `images` show them; `known` as all do. Only those that they show differ."""
    theirs = np.isin(arcs.image, images)
    own = np.unique(tracks.track[theirs & (tracks.track >= 0)])
    if not len(own):
        return known
    number = np.full(len(tracks) + 1, -1)
    number[own] = np.arange(len(own))
    without = lines_of_tracks(arcs, np.where(theirs, -1, number[tracks.track]), len(own))
    return known.rows(~np.isin(known.track, own)).and_also(replace(without, track=own[without.track]))


def mended_pose(
    arcs: ViewedArcs, known: KnownLines, seed: int, typical: float = 1.0, options: MatchingOptions = MatchingOptions()
) -> PlacedByLines | None:
    """A pose that explains clearly more of the photos of `arcs` than the one they have; None where there is none.

    It is looked for nearby, and anywhere where hardly any arcs are explained: `typical` is the share (`explained_share`) of the
    median photo, which in texture is small.
    """
    its = options.placing
    arcs = arcs.sharpest(its.max_arcs)
    own, near = explained_by_lines(arcs, known, options), refined_by_lines(arcs, known, options)
    best = own if near is None or near.score <= its.clearly_more * own.score else near
    if best.score < its.few_explained * typical * len(arcs):
        far = placed_anywhere(arcs, known, seed, options)
        # By all lines, as the poses that it is compared with.
        far = None if far is None else refined_by_lines(arcs.with_poses(far.pose), known, options)
        best = best if far is None or far.score <= its.above_chance * best.score else far
    return None if best is own else best


def explained_share(arcs: ViewedArcs, known: KnownLines, options: MatchingOptions = MatchingOptions()) -> float:
    """Share of the sharpest arcs of the photos of `arcs` that lines explain, each by how much they look alike."""
    arcs = arcs.sharpest(options.placing.max_arcs)
    return explained_by_lines(arcs, known, options).score / max(len(arcs), 1)


def placed_anywhere(
    arcs: ViewedArcs, known: KnownLines, seed: int, options: MatchingOptions = MatchingOptions()
) -> PlacedByLines | None:
    """The pose of the photos of `arcs`, wherever they are; None where none explains clearly more than others do.

    Of their own poses only where they stand to each other counts.
    """
    its = options.placing
    arcs, known = arcs.sharpest(its.max_arcs), known.longest(its.max_lines)
    apart = its.other_share * _extent(known)
    placed: list[PlacedByLines] = []
    for start in _starts(arcs, known, seed, options):
        # A start beside a pose that was found leads there.
        if all(_is_other(start.poses, one.pose, its.other_rad, apart) for one in placed):
            one = refined_by_lines(start, known, options)
            placed += [] if one is None else [one]
    best = max(placed, key=lambda one: one.score, default=None)
    if best is None or best.score < its.min_score:
        return None
    others = (one.score for one in placed if _is_other(one.pose, best.pose, its.other_rad, apart))
    return best if best.score >= its.above_chance * max(others, default=0.0) else None


def _starts(arcs: ViewedArcs, known: KnownLines, seed: int, options: MatchingOptions) -> Iterator[ViewedArcs]:
    """The photos of `arcs` where each of them by itself could have been, and the others with it."""
    for k in range(arcs.images):
        starts = start_poses(arcs.of_photo(k).with_poses(Pose.identity(1)), known, seed, options)
        first_from_photo = arcs.poses[[0]] @ arcs.poses[[k]].inverse()
        for at in range(len(starts)):
            yield arcs.moved_to(first_from_photo @ starts[[at]])


def _is_other(one: Pose, pose: Pose, turned_rad: float, apart: float) -> bool:
    turn = one.rotation[0] @ pose.rotation[0].mT
    return float(turn.trace()) < 1.0 + 2.0 * math.cos(turned_rad) or float((one.centre - pose.centre).norm()) > apart


def _extent(known: KnownLines) -> float:
    """Median distance of the lines' middles from their median."""
    ends = np.nan_to_num(known.spans, posinf=0.0, neginf=0.0).mean(-1)
    middle = np.cross(known.direction, known.moment) + ends[:, None] * known.direction
    return float(np.median(np.linalg.norm(middle - np.median(middle, axis=0), axis=-1))) if len(known) else 0.0
