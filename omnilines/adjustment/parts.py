"""A scene divided into parts for its adjustment: every line is of one part, with all photos that see it.

The graph of the photos that share a line is cut by few separating photos (`least_squares/dissection.py`), so that lines of photos
that do not separate are of one part. A photo whose lines are all of one part is *inner* to it, the others are *shared*.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Int
from torch import Tensor

from camera_models import InputError
from omnilines.adjustment.engine_layout import Layout
from omnilines.adjustment.problem import Freedom, LineProblem
from omnilines.adjustment.state import LinesAndPoses
from omnilines.costs import WHITENED
from omnilines.least_squares.dissection import dissected
from omnilines.least_squares.pattern import PairPattern, narrower_order, pair_pattern


@dataclass(frozen=True)
class Part:
    """What is of a part, by the numbers of the scene."""

    rows: Int[Tensor, " n"]
    """Of the arcs."""
    tracks: Int[Tensor, " t"]
    frames: Int[Tensor, " f"]
    """That see its lines, ascending."""
    shared: Int[np.ndarray, " s"]
    """Those of them that other parts see too, ascending in the order of `Division.shared`, by their places in it."""


@dataclass(frozen=True)
class Division:
    """A scene in parts."""

    parts: tuple[Part, ...]
    shared: Int[np.ndarray, " s"]
    """The frames that parts share, in the order of the separators' system."""
    pattern: PairPattern
    """Of the shared frames: pairs that are of one part."""


def why_in_one_piece(*, cost: str, poses: bool, cameras: bool, rig: bool, prior: bool, device: str) -> str:
    """Why a problem is adjusted in one piece only; empty where it may be divided. `poses` and `cameras` are refined, or not."""
    reasons = {
        "held poses": not poses,
        f"the cost {cost}": cost != WHITENED,
        "a rig": rig,
        "refined cameras": cameras,
        "a prior": prior,
        f"the device {device}": device != "cpu",
    }
    return " and ".join(reason for reason, holds in reasons.items() if holds)


def require_divisible(partition: int, in_one_piece: str) -> None:
    """Raises InputError for a `partition` of what is adjusted in one piece only."""
    if partition < 0 or (partition and in_one_piece):
        found = f"{partition}" if partition < 0 else f"{partition} with {in_one_piece}"
        raise InputError(
            "A `partition` of 0 or more photos was expected, with refined poses, the cost whitened, and without a rig, refined "
            f"cameras, a prior or a GPU, found {found}; leave it out."
        )


def divided(problem: LineProblem, whole: Layout, most: int) -> Division | None:
    """The parts of a problem, of at most so many photos besides those shared; None where it cannot be cut. `whole` is its layout
    in one piece."""
    arcs, pattern = problem.arcs, whole.pattern
    frames = arcs.images
    part_of = np.full(frames, -1)
    part_of[whole.frames[: pattern.kept].numpy()] = dissected(pattern.row, pattern.column, pattern.kept, most)
    label = _parts_of_lines(problem, part_of)
    frame, track = arcs.image.numpy(), arcs.track.numpy()
    members = _counts(label[track], frame, int(label.max()) + 1, frames)
    members = members[np.diff(members.indptr) > 0]
    shares = np.bincount(members.indices, minlength=frames)
    shares[problem.freedom.held_frames.numpy()] = 0
    if members.shape[0] < 2 or not (shares > 1).any():
        return None
    shared, together = _separators(members, np.flatnonzero(shares > 1))
    place = np.full(frames, -1)
    place[shared] = np.arange(len(shared))
    of_part = [_part(np.flatnonzero(label[track] == own), arcs.image, arcs.track, place) for own in np.unique(label[track])]
    return Division(tuple(of_part), shared, together)


def _parts_of_lines(problem: LineProblem, part_of: Int[np.ndarray, " frames"]) -> Int[np.ndarray, " t"]:
    """Of every line the part of its photos that do not separate, or the one that has most of the separating ones."""
    arcs, parts = problem.arcs, int(part_of.max()) + 1
    frame, track = arcs.image.numpy(), arcs.track.numpy()
    label = np.full(arcs.tracks, -1)
    inner = part_of[frame] >= 0
    label[track[inner]] = part_of[frame[inner]]
    # Separating photos are of all parts whose lines they see; lines that only such photos see go where most of these are.
    touched = _counts(frame[label[track] >= 0], label[track][label[track] >= 0], arcs.images, parts)
    touched.data[:] = 1
    free = ~problem.freedom.held_frames.numpy()[frame]
    left = (label[track] < 0) & free
    open_lines = np.unique(track[left])
    votes = _counts(track[left], frame[left], arcs.tracks, arcs.images)[open_lines] @ touched
    if len(open_lines):
        label[open_lines] = np.asarray(votes.argmax(axis=1)).ravel()
    # Lines that only held photos see are tied to nothing.
    alone = np.flatnonzero(label < 0)
    label[alone] = np.arange(len(alone)) % parts
    return label


def _counts(row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"], rows: int, columns: int) -> scipy.sparse.csr_array:
    """How often each pair occurs."""
    return scipy.sparse.csr_array((np.ones(len(row), dtype=np.int64), (row, column)), shape=(rows, columns))


def _separators(members: scipy.sparse.csr_array, shared: Int[np.ndarray, " s"]) -> tuple[Int[np.ndarray, " s"], PairPattern]:
    """The shared frames in an order that makes their system narrow, and its pattern; `members` has a row for each part."""

    def pattern_of(order: Int[np.ndarray, " s"]) -> PairPattern:
        own = scipy.sparse.csr_array(members[:, order])
        own.sort_indices()
        return pair_pattern(own.indptr.astype(np.int64), own.indices.astype(np.int64), len(order))

    found = pattern_of(shared)
    better = narrower_order(found)
    return (shared, found) if better is None else (shared[better], pattern_of(shared[better]))


def _part(
    rows: Int[np.ndarray, " n"], image: Int[Tensor, " m"], track: Int[Tensor, " m"], place: Int[np.ndarray, " frames"]
) -> Part:
    chosen = torch.from_numpy(rows)
    frames = torch.unique(image[chosen])
    own = np.sort(place[frames.numpy()])
    return Part(chosen, torch.unique(track[chosen]), frames, own[own >= 0])


def problem_of(part: Part, problem: LineProblem, state: LinesAndPoses) -> LineProblem:
    """The problem of a part alone, frames and tracks by their numbers in the part."""
    frames, tracks, freedom = part.frames, part.tracks, problem.freedom
    own = replace(problem.arcs, nodes=None, observed=None).rows(part.rows)
    arcs = replace(
        own,
        image=torch.searchsorted(frames, own.image),
        track=torch.searchsorted(tracks, own.track),
        images=len(frames),
        tracks=len(tracks),
    )
    held = None if freedom.held_lines is None else freedom.held_lines[tracks]
    alone = LinesAndPoses(state.rig_from_world[frames], state.chart[tracks])
    mix = None if problem.mix is None else problem.mix[part.rows]
    return LineProblem(arcs, problem.cost_name, Freedom(freedom.held_frames[frames], held), alone, mix=mix)
