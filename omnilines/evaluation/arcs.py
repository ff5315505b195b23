"""Extracted arcs against the edges that photos of a rendered scene truly see.

Visible stretches and arcs are compared as points half a pixel apart in the photo. A point of the one lies on the other where the
distance across is at most 1 px and both run in nearly the same direction; everything else is counting.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from omnilines.evaluation.curves import Curves, normalised, on_arrays, photo_curves, points_beside
from omnilines.files.true_edges import Stretches, TrueEdges
from omnilines.geometry.sphere import angle_between, arc_normal
from omnilines.records import ImagePoses, Segments

ON_EDGE = 0.9
"""Share of an arc's length that has to lie on one edge."""
SAME_LINE_M = 1e-3
MIN_PX, MIN_CONTRAST = 40.0, 10.0
"""Stretches that an extraction is expected to find."""
GAP_PX = 1.0
"""A stretch goes on across a shorter gap."""


@dataclass(frozen=True)
class ArcScores:
    """What was found of the edges, and what of the arcs is true. Stretches count from 40 px and 10 grey levels on."""

    length_px: float
    """Of all stretches that count, over all photos."""
    covered_share: float
    """Of that length, what an arc lies on."""
    stretches: int
    arcs: int
    arcs_per_stretch: float
    """Arcs on a stretch that counts, mean over those with any; an arc is on it when half of either lies on the other."""
    mean_arc_px: float
    on_edge: Bool[np.ndarray, " m"]
    """Which arcs lie on one true edge over ON_EDGE of their length; of visible stretches of any length and contrast."""
    edge: Int[np.ndarray, " m"]
    """The edge that most of each arc lies on, -1 for none."""
    direction_rad: Float[np.ndarray, " m"]
    """Angle between the great circles of an arc and of its edge; NaN off any edge."""

    on_line: Bool[np.ndarray, " m"]
    """Which arcs lie on true edges of one straight line over ON_EDGE of their length. An arc that goes on from one sill to the
    next, or past what hides a part of an edge, is on a line, but on no single edge."""

    @property
    def on_edge_share(self) -> float:
        """Of all arcs."""
        return float(self.on_edge.mean()) if self.arcs else math.nan

    @property
    def on_line_share(self) -> float:
        """Of all arcs."""
        return float(self.on_line.mean()) if self.arcs else math.nan

    def direction_deg(self, percentile: float | int) -> float:
        """Percentile of the direction error of the arcs on a line, degrees."""
        error = self.direction_rad[self.on_line]
        return math.degrees(float(np.percentile(error, percentile))) if len(error) else math.nan


def arc_scores(
    camera: CameraModel,
    poses: ImagePoses,
    edges: TrueEdges,
    stretches: Stretches,
    segments: Segments,
    *,
    colour: bool = True,
    min_px: float | int = MIN_PX,
    min_contrast: float | int = MIN_CONTRAST,
) -> ArcScores:
    """Score the segments extracted from photos of one camera, all photos of `poses` together.

    With `colour` the contrast of a stretch is that of the channel that differs most, without it that in grey. Raises InputError
    where a segment is of a photo that has no pose.
    """
    known = {name: k for k, name in enumerate(poses.images)}
    for names in (segments.images, stretches.images):
        strange = [name for name in names if name not in known]
        if strange:
            raise InputError(f"A pose of every photo was expected, found none of '{strange[0]}'; give its pose or leave it out.")
    of_segment = np.array([known[name] for name in segments.images], dtype=np.int64)[segments.image]
    of_stretch = np.array([known[name] for name in stretches.images], dtype=np.int64)[stretches.image]
    contrast = stretches.contrast_rgb if colour else stretches.contrast_grey
    line, parts = lines_of_edges(edges), []
    for k in range(len(poses)):
        rows, own = np.flatnonzero(of_segment == k), of_stretch == k
        seen = unbroken(stretches.keep(own), contrast[own] >= min_contrast, min_px)
        photo = _score_photo(camera, poses.cam_from_world[k], edges, line, seen, segments.endpoints_px[rows])
        parts.append((rows, photo))
    return _together(len(segments), parts)


def lines_of_edges(edges: TrueEdges) -> Int[np.ndarray, " e"]:
    """Number of the straight line that each edge lies on: edges whose directions, and feet of the perpendicular from the middle
    of the scene, agree to SAME_LINE_M are parts of one."""
    if not len(edges):
        return np.zeros(0, dtype=np.int64)
    first, second = edges.ends_m[:, 0] - edges.ends_m.mean((0, 1)), edges.ends_m[:, 1] - edges.ends_m.mean((0, 1))
    direction = normalised(second - first)
    foot = first - (first * direction).sum(-1, keepdims=True) * direction
    # A direction has no sign: each line stands for both.
    keys = np.concatenate([np.concatenate([sign * direction, foot], -1) for sign in (1.0, -1.0)])
    pairs = cKDTree(keys).query_pairs(SAME_LINE_M, output_type="ndarray") % len(edges)
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(edges), len(edges)))
    return connected_components(links, directed=False)[1].astype(np.int64)


@dataclass(frozen=True)
class Unbroken:
    """Visible stretches of one photo as in the table, each with the unbroken stretch above the least contrast it is part of."""

    table: Stretches
    whole: Int[np.ndarray, " n"]
    """-1 for what does not count: too faint, or too short even with its neighbours."""
    count: int


def unbroken(table: Stretches, strong: Bool[np.ndarray, " n"], min_px: float | int) -> Unbroken:
    """Join the strong stretches of one photo that touch, or nearly so, and number those of at least that length."""
    rows = np.flatnonzero(strong)
    edge, t, length = table.edge[rows], table.t[rows], table.length_px[rows]
    begins = np.ones(len(rows), dtype=bool)
    # Fractions of an edge to pixels at the pace of the stretch before.
    pace = length / (t[:, 1] - t[:, 0])
    begins[1:] = (edge[1:] != edge[:-1]) | ((t[1:, 0] - t[:-1, 1]) * pace[:-1] > GAP_PX)
    group = np.cumsum(begins) - 1
    long = np.bincount(group, length) >= min_px
    number = np.where(long, np.cumsum(long) - 1, -1)
    whole = np.full(len(table), -1)
    whole[rows] = number[group]
    return Unbroken(table, whole, int(long.sum()))


@dataclass(frozen=True)
class _PhotoScore:
    length_px: float
    covered_px: float
    stretches: int
    incidences: int
    found: int
    arc_px: float
    on_edge: Bool[np.ndarray, " m"]
    edge: Int[np.ndarray, " m"]
    direction_rad: Float[np.ndarray, " m"]
    on_line: Bool[np.ndarray, " m"]


def _score_photo(
    camera: CameraModel,
    pose: Pose,
    edges: TrueEdges,
    line: Int[np.ndarray, " e"],
    seen: Unbroken,
    ends_px: Float[np.ndarray, "m 2 2"],
) -> _PhotoScore:
    table = seen.table
    ends = edges.ends_m[table.edge]
    ends = ends[:, :1] + table.t[..., None] * (ends[:, 1:] - ends[:, :1])
    rotation, translation = pose.rotation.detach().numpy(), pose.translation.detach().numpy()
    true = photo_curves(camera, normalised(ends @ rotation.T + translation))
    with torch.no_grad():
        bearings, _ = camera.unproject(ends_px)
    arcs = photo_curves(camera, bearings)
    i, j = points_beside(camera, true, arcs)
    counts = seen.whole[true.owner] >= 0
    covered = np.zeros(len(true.owner), dtype=bool)
    covered[i] = True
    edge, share = _best_edge(table.edge[true.owner[i]], j, arcs, len(ends_px))
    _, line_share = _best_edge(line[table.edge[true.owner[i]]], j, arcs, len(ends_px))
    length = float(true.length[counts].sum())
    covered_px = float(true.length[counts & covered].sum())
    incidences, found = _incidences(seen, true, arcs, i, j)
    direction = np.full(len(ends_px), np.nan)
    rows = np.flatnonzero(edge >= 0)
    truth = normalised(edges.ends_m[edge[rows]] @ rotation.T + translation)
    angle = on_arrays(
        angle_between, on_arrays(arc_normal, truth[:, 0], truth[:, 1]), on_arrays(arc_normal, *bearings[rows].swapaxes(0, 1))
    )
    direction[rows] = np.minimum(angle, math.pi - angle)
    total = float(arcs.length.sum())
    on_edge, on_line = share >= ON_EDGE, line_share >= ON_EDGE
    return _PhotoScore(length, covered_px, seen.count, incidences, found, total, on_edge, edge, direction, on_line)


def _best_edge(
    edge: Int[np.ndarray, " k"], j: Int[np.ndarray, " k"], arcs: Curves, count: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """For each arc the edge (or line, where `edge` numbers lines) that the largest share of it lies on, and that share."""
    best, share = np.full(count, -1), np.zeros(count)
    if len(j):
        (on, point), _ = _distinct(edge, j)
        (owner, of), which = _distinct(arcs.owner[point], on)
        length = np.bincount(which, arcs.length[point])
        order = np.argsort(length, kind="stable")
        best[owner[order]] = of[order]
        share[owner[order]] = length[order]
    return best, share / np.maximum(np.bincount(arcs.owner, arcs.length, count), 1e-12)


def _incidences(
    seen: Unbroken, true: Curves, arcs: Curves, i: Int[np.ndarray, " k"], j: Int[np.ndarray, " k"]
) -> tuple[int, int]:
    """Number of pairs of a stretch that counts and an arc on it, and of stretches that have an arc."""
    whole = seen.whole[true.owner]
    kept = whole[i] >= 0
    i, j = i[kept], j[kept]
    if not len(i):
        return 0, 0
    stretch_px = np.bincount(whole[whole >= 0], true.length[whole >= 0], seen.count)
    arc_px = np.bincount(arcs.owner, arcs.length)
    (stretch, arc), which = _distinct(whole[i], arcs.owner[j])
    (pair, point), _ = _distinct(which, i)
    covered = np.bincount(pair, true.length[point], len(stretch))
    (pair, point), _ = _distinct(which, j)
    lying = np.bincount(pair, arcs.length[point], len(stretch))
    on = (covered >= 0.5 * stretch_px[stretch]) | (lying >= 0.5 * arc_px[arc])
    return int(on.sum()), len(np.unique(stretch[on]))


def _distinct(
    a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]
) -> tuple[tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]], Int[np.ndarray, " n"]]:
    """The distinct pairs (a, b) of numbers from 0, sorted, and which of them each row is."""
    radix = int(b.max(initial=0)) + 1
    key, which = np.unique(a * radix + b, return_inverse=True)
    return (key // radix, key % radix), which


def _together(count: int, parts: list[tuple[np.ndarray, _PhotoScore]]) -> ArcScores:
    on_edge, edge, direction = np.zeros(count, dtype=bool), np.full(count, -1), np.full(count, np.nan)
    on_line = np.zeros(count, dtype=bool)
    for rows, photo in parts:
        on_edge[rows], edge[rows], direction[rows] = photo.on_edge, photo.edge, photo.direction_rad
        on_line[rows] = photo.on_line
    photos = [photo for _, photo in parts]
    length = sum(photo.length_px for photo in photos)
    found = sum(photo.found for photo in photos)
    return ArcScores(
        length,
        sum(photo.covered_px for photo in photos) / length if length else math.nan,
        sum(photo.stretches for photo in photos),
        count,
        sum(photo.incidences for photo in photos) / found if found else math.nan,
        sum(photo.arc_px for photo in photos) / count if count else math.nan,
        on_edge,
        edge,
        direction,
        on_line,
    )
