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
from omnilines.matching.photo_starts import start_poses
from omnilines.matching.resection import PlacedByLines, explained_by_lines, refined_by_lines
from omnilines.matching.tracks import Tracks
from omnilines.triangulation.batches import triangulate_on

CLEARLY_MORE = 1.1
"""Times what the pose that a photo has explains: then another near it is better."""
FEW_EXPLAINED = 0.25
"""Of the share of its arcs that lines explain in a typical photo: below it the pose of a photo may be wrong altogether."""
ABOVE_CHANCE, LEAST_SCORE = 1.5, 12.0
"""Times what the best of the other poses explains, and the least, for the pose of a photo that had none."""
MOST_ARCS, MOST_LINES = 500, 800
"""The arcs of a photo that its pose is sought by are those known best, and the lines the longest: thousands of arcs of foliage or
carpet tell no more, and the work is bounded."""
OTHER_RAD, OTHER_SHARE = math.radians(3.0), 0.05
"""Poses are others that are turned by so much, or stand apart by this share of the extent of the lines."""


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


def mended_pose(arcs: ViewedArcs, known: KnownLines, seed: int, typical: float = 1.0) -> PlacedByLines | None:
    """A pose that explains clearly more of the photos of `arcs` than the one they have; None where there is none.

    It is looked for nearby, and anywhere where hardly any arcs are explained: `typical` is the share (`explained_share`) of the
    median photo, which in texture is small.
    """
    arcs = arcs.sharpest(MOST_ARCS)
    own, near = explained_by_lines(arcs, known), refined_by_lines(arcs, known)
    best = own if near is None or near.score <= CLEARLY_MORE * own.score else near
    if best.score < FEW_EXPLAINED * typical * len(arcs):
        far = placed_anywhere(arcs, known, seed)
        best = best if far is None or far.score <= ABOVE_CHANCE * best.score else far
    return None if best is own else best


def explained_share(arcs: ViewedArcs, known: KnownLines) -> float:
    """Share of the sharpest arcs of the photos of `arcs` that lines explain, each by how much they look alike."""
    arcs = arcs.sharpest(MOST_ARCS)
    return explained_by_lines(arcs, known).score / max(len(arcs), 1)


def placed_anywhere(arcs: ViewedArcs, known: KnownLines, seed: int) -> PlacedByLines | None:
    """The pose of the photos of `arcs`, wherever they are; None where none explains clearly more than others do.

    Of their own poses only where they stand to each other counts.
    """
    arcs, known = arcs.sharpest(MOST_ARCS), known.longest(MOST_LINES)
    apart = OTHER_SHARE * _extent(known)
    placed: list[PlacedByLines] = []
    for start in _starts(arcs, known, seed):
        # A start beside a pose that was found leads there.
        if all(_is_other(start.poses, one.pose, apart) for one in placed):
            one = refined_by_lines(start, known)
            placed += [] if one is None else [one]
    best = max(placed, key=lambda one: one.score, default=None)
    if best is None or best.score < LEAST_SCORE:
        return None
    others = (one.score for one in placed if _is_other(one.pose, best.pose, apart))
    return best if best.score >= ABOVE_CHANCE * max(others, default=0.0) else None


def _starts(arcs: ViewedArcs, known: KnownLines, seed: int) -> Iterator[ViewedArcs]:
    """The photos of `arcs` where each of them by itself could have been, and the others with it."""
    for k in range(arcs.images):
        starts = start_poses(arcs.of_photo(k).with_poses(Pose.identity(1)), known, seed)
        first_from_photo = arcs.poses[[0]] @ arcs.poses[[k]].inverse()
        for at in range(len(starts)):
            yield arcs.moved_to(first_from_photo @ starts[[at]])


def _is_other(one: Pose, pose: Pose, apart: float) -> bool:
    turn = one.rotation[0] @ pose.rotation[0].mT
    return float(turn.trace()) < 1.0 + 2.0 * math.cos(OTHER_RAD) or float((one.centre - pose.centre).norm()) > apart


def _extent(known: KnownLines) -> float:
    """Median distance of the lines' middles from their median."""
    ends = np.nan_to_num(known.spans, posinf=0.0, neginf=0.0).mean(-1)
    middle = np.cross(known.direction, known.moment) + ends[:, None] * known.direction
    return float(np.median(np.linalg.norm(middle - np.median(middle, axis=0), axis=-1))) if len(known) else 0.0
