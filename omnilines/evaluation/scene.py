"""Reconstructed lines against the edges of a rendered scene: recall, precision, errors and duplicates.

The points within a distance of a straight edge fill a capsule, which is convex. So the part of a line near an edge, and of an
edge near a line, is one interval in closed form, and every measure is the length of a union of intervals: nothing is sampled.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from camera_models import InputError
from camera_models.rotations import similarity_alignment
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
_PAIRS = 1 << 20
"""Pairs of a line and an edge that are looked at together: bounds the memory."""


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
    views = _Spans(seen.edge, seen.t * _length(true)[seen.edge, None])
    pieces = _pieces(len(true), [views])
    visible = pieces.total(pieces.depth[:, 0] >= min_views)
    line, other = _near_pairs(ends_m, true, max(thresholds_m))
    inside = np.stack([_covered(len(ends_m), _near(ends_m, line, true, other, tau)) for tau in thresholds_m])
    found = np.stack([_found(len(true), views, _near(true, other, ends_m, line, tau), min_views) for tau in thresholds_m])
    share, unknown = inside / _length(ends_m), np.full(len(thresholds_m), math.nan)
    total, count = float(visible.sum()), len(ends_m)
    nearest, error = _nearest(ends_m, true)
    angle = _angle(ends_m, true[nearest])
    own = (error <= max(thresholds_m)) & (angle <= math.radians(PARALLEL_DEG))
    return SceneScores(
        tuple(thresholds_m),
        count,
        float(_length(ends_m).sum()),
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
    bad = np.flatnonzero(~(np.isfinite(ends).all((1, 2)) & (_length(ends) > 0)))
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


def _length(ends: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)


@dataclass(frozen=True)
class _Spans:
    """Intervals along lines or edges, metres from their first ends."""

    owner: Int[np.ndarray, " n"]
    span: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class _Pieces:
    """Lines or edges cut where any interval of some sets begins or ends, and how many of each set cover each piece."""

    owners: int
    owner: Int[np.ndarray, " p"]
    length: Float[np.ndarray, " p"]
    depth: Int[np.ndarray, "p sets"]

    def total(self, counts: Bool[np.ndarray, " p"]) -> Float[np.ndarray, " owners"]:
        """Length of the pieces of each owner that count."""
        # np.bincount gives integers where there is nothing to add.
        return np.bincount(self.owner[counts], self.length[counts], self.owners).astype(np.float64)


def _pieces(owners: int, sets: Sequence[_Spans]) -> _Pieces:
    """Sweep: the depth changes by one at the ends of the intervals, and is 0 between owners."""
    owner = np.concatenate([np.repeat(spans.owner, 2) for spans in sets])
    place = np.concatenate([spans.span.ravel() for spans in sets])
    change = np.zeros((len(owner), len(sets)), dtype=np.int64)
    first = 0
    for k, spans in enumerate(sets):
        rows = 2 * len(spans.owner)
        change[first : first + rows, k] = np.tile([1, -1], len(spans.owner))
        first += rows
    order = np.lexsort((place, owner))
    owner, place = owner[order], place[order]
    depth = np.cumsum(change[order], axis=0)
    same = owner[1:] == owner[:-1]
    return _Pieces(owners, owner[:-1][same], np.diff(place)[same], depth[:-1][same])


def _covered(owners: int, spans: _Spans) -> Float[np.ndarray, " owners"]:
    """Length of the union of the intervals of each owner."""
    pieces = _pieces(owners, [spans])
    return pieces.total(pieces.depth[:, 0] > 0)


def _found(edges: int, views: _Spans, near: _Spans, min_views: int) -> Float[np.ndarray, " edges"]:
    """Length of each edge that enough photos see and that lies near a line."""
    pieces = _pieces(edges, [views, near])
    return pieces.total((pieces.depth[:, 0] >= min_views) & (pieces.depth[:, 1] > 0))


def _chunks(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, _PAIRS // max(columns, 1))
    return (slice(first, first + step) for first in range(0, rows, step))


def _near_pairs(
    lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"], reach_m: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Pairs of a line and an edge whose boxes are within `reach_m` of each other: all that can be near."""
    low, high = edges.min(1) - reach_m, edges.max(1) + reach_m
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for rows in _chunks(len(lines), len(edges)):
        part = lines[rows]
        apart = (part.min(1)[:, None] > high).any(-1) | (part.max(1)[:, None] < low).any(-1)
        i, j = np.nonzero(~apart)
        pairs.append(np.stack([i + rows.start, j]))
    line, edge = np.concatenate(pairs, axis=1)
    return line, edge


def _near(
    lines: Float[np.ndarray, "n 2 3"],
    line: Int[np.ndarray, " k"],
    axes: Float[np.ndarray, "m 2 3"],
    axis: Int[np.ndarray, " k"],
    reach_m: float,
) -> _Spans:
    """The parts of lines within `reach_m` of the axes they are paired with; owners are the lines."""
    span, there = _in_capsule(lines[line], axes[axis], reach_m)
    return _Spans(line[there], span[there])


def _in_capsule(
    lines: Float[np.ndarray, "n 2 3"], axes: Float[np.ndarray, "n 2 3"], reach_m: float
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Where a line, metres from its first end, is within `reach_m` of a segment, pair by pair, and whether it is at all.

    A capsule is the union of a finite cylinder and a ball about each end. It is convex: the hull of the three intervals is the
    interval of the union.
    """
    length, reach = _length(lines), _length(axes)
    along, axis = _unit(lines), _unit(axes)
    first = lines[:, 0] - axes[:, 0]
    turn, arm = np.cross(along, axis), np.cross(first, axis)
    parts = [_not_positive((turn * turn).sum(-1), (turn * arm).sum(-1), (arm * arm).sum(-1) - reach_m**2)]
    slab = _between((first * axis).sum(-1), (along * axis).sum(-1), reach)
    parts[0] = np.stack([np.maximum(parts[0][:, 0], slab[:, 0]), np.minimum(parts[0][:, 1], slab[:, 1])], -1)
    for end in range(2):
        from_end = lines[:, 0] - axes[:, end]
        parts.append(_not_positive(np.ones(len(lines)), (along * from_end).sum(-1), (from_end * from_end).sum(-1) - reach_m**2))
    every = np.stack(parts)
    empty = ~(every[..., 0] <= every[..., 1])
    low = np.where(empty, np.inf, every[..., 0]).min(0).clip(min=0.0)
    high = np.minimum(np.where(empty, -np.inf, every[..., 1]).max(0), length)
    return np.stack([low, high], -1), high > low


def _not_positive(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], c: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Where a s^2 + 2 b s + c <= 0, a >= 0: from inf to -inf where nowhere, all s where a = 0 and c <= 0."""
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    # The larger root first, the other from their product: no difference of near numbers.
    large = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        pair = np.sort(np.stack([large / a, c / large], -1), axis=-1)
    # With a below the square of what rounding leaves of two parallel unit vectors, the slope is none.
    parallel = a < 1e-30
    pair[parallel] = np.where(c[parallel, None] <= 0, [-np.inf, np.inf], [np.inf, -np.inf])
    pair[~parallel & (b * b < a * c)] = [np.inf, -np.inf]
    touching = ~parallel & (large == 0)
    pair[touching] = 0.0
    return pair


def _between(
    start: Float[np.ndarray, " n"], slope: Float[np.ndarray, " n"], top: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """Where 0 <= start + s slope <= top: from inf to -inf where nowhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pair = np.sort(np.stack([-start / slope, (top - start) / slope], -1), axis=-1)
    level = slope == 0
    inside = (start >= 0) & (start <= top)
    pair[level] = np.where(inside[level, None], [-np.inf, np.inf], [np.inf, -np.inf])
    return pair


def _unit(ends: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 3"]:
    return (ends[:, 1] - ends[:, 0]) / _length(ends)[:, None]


def _nearest(
    lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The edge whose distance from the farther end of each line is least, and that distance (m)."""
    best, error = np.zeros(len(lines), dtype=np.int64), np.zeros(len(lines))
    axis, length = _unit(edges), _length(edges)
    for rows in _chunks(len(lines), len(edges)):
        worst = np.zeros((len(lines[rows]), len(edges)))
        for end in range(2):
            step = lines[rows, end, None] - edges[:, 0]
            place = np.clip((step * axis).sum(-1), 0.0, length)
            worst = np.maximum(worst, np.linalg.norm(step - place[..., None] * axis, axis=-1))
        best[rows], error[rows] = worst.argmin(1), worst.min(1)
    return best, error


def _angle(lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """Between two undirected lines, 0 to pi / 2."""
    a, b = _unit(lines), _unit(edges)
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.abs((a * b).sum(-1)))


def _repeated(lines: Float[np.ndarray, "n 2 3"], edges: Float[np.ndarray, "e 2 3"], edge: Int[np.ndarray, " n"]) -> float:
    """Share of the length of lines, each laid on its edge, that lines before it on the same edge cover already."""
    axis, first = _unit(edges)[edge], edges[edge, 0]
    place = ((lines - first[:, None]) * axis[:, None]).sum(-1)
    spans = _Spans(edge, np.sort(np.clip(place, 0.0, _length(edges)[edge, None]), axis=-1))
    laid = float((spans.span[:, 1] - spans.span[:, 0]).sum())
    return max(1.0 - float(_covered(len(edges), spans).sum()) / laid, 0.0) if laid else 0.0
