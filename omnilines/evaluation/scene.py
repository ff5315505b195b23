"""Reconstructed lines against the edges of a rendered scene: recall, precision, errors and duplicates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from camera_models import InputError
from camera_models.rotations import similarity_alignment
from omnilines.evaluation.capsules import (
    Spans,
    covered_lengths,
    cut_where_covered,
    directions,
    lengths,
    near_pairs,
    near_parts,
    portions,
)
from omnilines.files.true_edges import Stretches, TrueEdges
from omnilines.records import ImagePoses

THRESHOLDS_M = (0.001, 0.005, 0.010)
MIN_VIEWS = 4
"""Photos that have to see a piece of an edge for it to be expected."""
MIN_CONTRAST = 10.0
"""Grey levels between both sides of an edge from which a photo counts as seeing it."""
ON_EDGE = 0.9
"""Share of a line's length that has to lie near edges for the line to be right."""
PARALLEL_DEG = 10.0
"""A line that crosses an edge does not repeat it."""


@dataclass(frozen=True)
class SceneScores:
    """What was found of a scene, and what of it is true. Arrays over `thresholds_m` (k) follow it in order."""

    thresholds_m: tuple[float, ...]
    lines: int
    total_m: float
    """Length of all lines."""
    visible_m: float
    """Length of the edges that enough photos see."""
    length_recall_m: Float[np.ndarray, " k"]
    """LIMAP's length recall R: length of the lines within the threshold of any edge."""
    inlier_share: Float[np.ndarray, " k"]
    """LIMAP's inlier percentage P: share of the lines of which any part lies within the threshold; NaN without lines."""
    precision: Float[np.ndarray, " k"]
    """Share of the lines of which ON_EDGE of the length lies within the threshold of edges; NaN without lines."""
    recall: Float[np.ndarray, " k"]
    """Share of `visible_m` within the threshold of a line; NaN where nothing is visible."""
    visible_of_edge_m: Float[np.ndarray, " e"]
    found_of_edge_m: Float[np.ndarray, "k e"]
    """Of the visible length of each edge, what lies within the threshold of a line."""
    edge: Int[np.ndarray, " n"]
    """Nearest edge of each line: the one whose farther end of the line is nearest."""
    error_m: Float[np.ndarray, " n"]
    """Distance of the farther end of each line from its nearest edge."""
    direction_rad: Float[np.ndarray, " n"]
    """Angle between each line and its nearest edge, 0 to pi / 2."""
    repeated_share: float
    """Of the length of lines on an edge (error within the largest threshold, nearly parallel), what other such lines cover
    too, counted once for every line but one; 0 without lines."""

    @property
    def median_error_m(self) -> float:
        """Median of `error_m` over all lines; NaN without lines."""
        return float(np.median(self.error_m)) if self.lines else math.nan

    def direction_deg(self, percentile: float | int) -> float:
        """Percentile of the direction error over all lines, degrees; NaN without lines."""
        return math.degrees(float(np.percentile(self.direction_rad, percentile))) if self.lines else math.nan


def scene_scores(
    ends_m: Float[np.ndarray, "n 2 3"],
    edges: TrueEdges,
    stretches: Stretches,
    thresholds_m: Sequence[float] = THRESHOLDS_M,
    *,
    min_views: int = MIN_VIEWS,
    min_contrast: float | int = MIN_CONTRAST,
    min_px: float | int = 0.0,
    colour: bool = True,
) -> SceneScores:
    """Score lines, given by their ends, against all edges of `truth.csv`, seen or not, and recall against `visibility.csv`.

    A piece of an edge is expected where at least `min_views` photos see it with at least `min_contrast` grey levels between
    its sides (of the channel that differs most with `colour`, else in grey), each as part of an unbroken stretch of at least
    `min_px` in the photo. LIMAP's measures are those of Liu et al., 3D Line Mapping Revisited, CVPR 2023, as its evaluation
    counts them, with the edges in place of a mesh.

    Raises InputError where a line has no finite ends or no length, a threshold is not positive, there are no edges, or stretches
    without contrast.
    """
    _require_lines(ends_m)
    if not len(edges):
        raise InputError("True edges were expected, found none; read them from truth.csv.")
    if not thresholds_m or min(thresholds_m) <= 0:
        raise InputError(f"Thresholds above 0 m were expected, found {list(thresholds_m)}; give some.")
    true = edges.ends_m
    seen = _clear(stretches, min_contrast, min_px, colour)
    views = Spans(seen.edge, seen.t * lengths(true)[seen.edge, None])
    pieces = cut_where_covered(len(true), [views])
    visible = pieces.total(pieces.depth[:, 0] >= min_views)
    line, other = near_pairs(ends_m, true, max(thresholds_m))
    inside = np.stack([covered_lengths(len(ends_m), near_parts(ends_m, line, true, other, tau)) for tau in thresholds_m])
    found = np.stack([_found(len(true), views, near_parts(true, other, ends_m, line, tau), min_views) for tau in thresholds_m])
    share, unknown = inside / lengths(ends_m), np.full(len(thresholds_m), math.nan)
    total, count = float(visible.sum()), len(ends_m)
    nearest, error = _nearest(ends_m, true)
    angle = _angle(ends_m, true[nearest])
    own = (error <= max(thresholds_m)) & (angle <= math.radians(PARALLEL_DEG))
    return SceneScores(
        tuple(thresholds_m),
        count,
        float(lengths(ends_m).sum()),
        total,
        inside.sum(1),
        (share > 0).mean(1) if count else unknown,
        (share >= ON_EDGE).mean(1) if count else unknown,
        found.sum(1) / total if total else unknown,
        visible,
        found,
        nearest,
        error,
        angle,
        _repeated(ends_m[own], true, nearest[own]),
    )


def aligned_ends(ends_m: Float[np.ndarray, "n 2 3"], found: ImagePoses, truth: ImagePoses) -> Float[np.ndarray, "n 2 3"]:
    """Lines of estimated poses in the frame and scale of the true ones: the similarity that fits the camera centres best.

    Photos without an estimated pose do not matter. Raises InputError where fewer than three photos have both poses, and
    GeometryError where their centres lie on one line.
    """
    known = {name: k for k, name in enumerate(truth.images)}
    rows = [(k, known[name]) for k, name in enumerate(found.images) if name in known]
    if len(rows) < 3:
        raise InputError(
            f"At least 3 photos with an estimated and a true pose were expected, found {len(rows)}; check their names."
        )
    a, b = (list(column) for column in zip(*rows, strict=True))
    scale, pose = similarity_alignment(found.cam_from_world.centre[a], truth.cam_from_world.centre[b])
    return float(scale) * ends_m @ pose.rotation.numpy().T + pose.translation.numpy()


def _require_lines(ends: Float[np.ndarray, "n 2 3"]) -> None:
    """Raise on lines that are none."""
    bad = np.flatnonzero(~(np.isfinite(ends).all((1, 2)) & (lengths(ends) > 0)))
    if len(bad):
        raise InputError(
            f"Lines with two finite ends apart were expected, found {ends[bad[0]].tolist()} in row {bad[0]}; keep the known ones."
        )


def _clear(stretches: Stretches, min_contrast: float | int, min_px: float | int, colour: bool) -> Stretches:
    """The stretches above the least contrast that are part of one long enough; raises on those without contrast."""
    contrast = stretches.contrast_rgb if colour else stretches.contrast_grey
    if np.isnan(contrast).any():
        raise InputError("Stretches with their contrast were expected, found some without; add its column to visibility.csv.")
    strong = stretches.keep(contrast >= min_contrast)
    begins = np.ones(len(strong), dtype=bool)
    # Rows that touch are one stretch whose contrast changes.
    touch = (strong.image[1:] == strong.image[:-1]) & (strong.edge[1:] == strong.edge[:-1])
    begins[1:] = ~(touch & (strong.t[1:, 0] <= strong.t[:-1, 1]))
    whole = np.cumsum(begins) - 1
    return strong.keep((np.bincount(whole, strong.length_px) >= min_px)[whole])


def _found(edges: int, views: Spans, near: Spans, min_views: int) -> Float[np.ndarray, " edges"]:
    """Length of each edge that enough photos see and that lies near a line."""
    pieces = cut_where_covered(edges, [views, near])
    return pieces.total((pieces.depth[:, 0] >= min_views) & (pieces.depth[:, 1] > 0))


def _nearest(
    lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The edge whose distance from the farther end of each line is least, and that distance (m)."""
    best, error = np.zeros(len(lines), dtype=np.int64), np.zeros(len(lines))
    axis, length = directions(edges), lengths(edges)
    for rows in portions(len(lines), len(edges)):
        worst = np.zeros((len(lines[rows]), len(edges)))
        for end in range(2):
            step = lines[rows, end, None] - edges[:, 0]
            place = np.clip((step * axis).sum(-1), 0.0, length)
            worst = np.maximum(worst, np.linalg.norm(step - place[..., None] * axis, axis=-1))
        best[rows], error[rows] = worst.argmin(1), worst.min(1)
    return best, error


def _angle(lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """Between two undirected lines, 0 to pi / 2."""
    a, b = directions(lines), directions(edges)
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.abs((a * b).sum(-1)))


def _repeated(lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"], edge: Int[np.ndarray, " n"]) -> float:
    """Share of the length of lines, each laid on its edge, that lines before it on the same edge cover already."""
    axis, first = directions(edges)[edge], edges[edge, 0]
    place = ((lines - first[:, None]) * axis[:, None]).sum(-1)
    spans = Spans(edge, np.sort(np.clip(place, 0.0, lengths(edges)[edge, None]), axis=-1))
    laid = float((spans.span[:, 1] - spans.span[:, 0]).sum())
    return max(1.0 - float(covered_lengths(len(edges), spans).sum()) / laid, 0.0) if laid else 0.0
