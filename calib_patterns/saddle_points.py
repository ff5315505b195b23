"""Saddle points of a photo, linked to their neighbours into pieces of checkerboard.

1. Saddle points are maxima of -det H of the smoothed photo's Hessian H, at several scales, around which a circle meets four
   quadrants of alternating brightness; between them are the arms of the two edges that cross there.
2. Neighbours on a board have opposite H. Two points are linked where each is the other's nearest of opposite H along one of its
   arms, and a link is kept where it is a side of a closed square.
3. Columns and rows are counted along the links from one corner.

No camera and no straight line is assumed, only that squares are about as wide as their neighbours.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

SCALES_PX = (1.2, 2.0, 3.5)
"""Standard deviations of the smoothing, about a tenth to a quarter of the squares that each finds best."""
MOST_POINTS = 6000
WEAKEST = 0.02
"""Of the response of a strong corner: weaker saddle points are texture."""
POINT_SIGMA_PX = 0.7
"""Standard deviation of a saddle point, not fitted yet."""
SAME_PLACE_PX = 2.5
CONE = float(np.cos(np.radians(20.0)))
"""A neighbour lies along an edge within this angle."""
OPPOSITE = -0.6
"""Cosine between the Hessians of neighbours, at most."""
NEAREST = 40
"""Points around each that are tried as neighbours."""
RING = 2.5
"""Radius of the circle that edges are looked for on, in standard deviations of the smoothing."""
_RING_SAMPLES = 32
_FIELDS = ("pixels", "hessian", "edges", "response")
_FROBENIUS = np.array([1.0, 2.0, 1.0])
_STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass(frozen=True)
class SaddlePoints:
    """Candidates for corners, to about POINT_SIGMA_PX."""

    pixels: Float[np.ndarray, "n 2"]
    hessian: Float[np.ndarray, "n 3"]
    """(uu, uv, vv) over its norm."""
    edges: Float[np.ndarray, "n 4 2"]
    """Unit directions of the four arms of both edges, in the order in which they turn from u to v."""
    response: Float[np.ndarray, " n"]

    def at(self, chosen: Int[np.ndarray, " k"]) -> "SaddlePoints":
        """Some of the points."""
        return SaddlePoints(*(getattr(self, name)[chosen] for name in _FIELDS))


@dataclass(frozen=True)
class Lattice:
    """Saddle points that are corners of one checkerboard."""

    pixels: Float[np.ndarray, "m 2"]
    places: Int[np.ndarray, "m 2"]
    """Column and row of each, from (0, 0) on; columns turn to rows as u to v."""
    bright: bool
    """Whether the square between larger columns and larger rows of the place (0, 0) is the brighter."""


def quarter_turn(times: int) -> Int[np.ndarray, "2 2"]:
    """The matrix that takes columns to rows and rows to columns backwards, so many times."""
    return np.asarray(np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), times))


def saddle_points(grey: np.ndarray) -> SaddlePoints:
    """The strongest saddle points of an 8-bit photo (h, w), one for each place."""
    found = [_at_scale(grey.astype(np.float32), sigma) for sigma in SCALES_PX]
    points = SaddlePoints(*(np.concatenate([getattr(part, name) for part in found]) for name in _FIELDS))
    order = np.argsort(-points.response)[: 3 * MOST_POINTS]
    if not order.size:
        return points
    # Of the same corner at several scales the strongest response is kept.
    pairs = cKDTree(points.pixels[order]).query_pairs(SAME_PLACE_PX, output_type="ndarray")
    weaker = np.zeros(len(order), dtype=bool)
    weaker[pairs.max(1)] = True
    order = order[~weaker][:MOST_POINTS]
    return points.at(order[points.response[order] > WEAKEST * np.percentile(points.response[order], 99)])


def _at_scale(grey: np.ndarray, sigma: float) -> SaddlePoints:
    """The maxima of -sigma^4 det H that four quadrants of alternating brightness surround."""
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma)
    # Sobel's kernels of size 3 sum to 4 for second derivatives and for the mixed one.
    uu, vv, uv = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=0.25) for order in ((2, 0), (0, 2), (1, 1)))
    response = sigma**4 * (uv * uv - uu * vv)
    peak = (response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > 0)
    peak[:3], peak[-3:], peak[:, :3], peak[:, -3:] = False, False, False, False
    v, u = np.nonzero(peak)
    slope_u, slope_v = (smooth[v, u + 1] - smooth[v, u - 1]) / 2, (smooth[v + 1, u] - smooth[v - 1, u]) / 2
    a, b, c = uu[v, u], uv[v, u], vv[v, u]
    # One Newton step to where the gradient is zero.
    step = -np.stack([c * slope_u - b * slope_v, a * slope_v - b * slope_u], -1) / (a * c - b * b)[:, None]
    pixels = np.stack([u, v], -1) + step
    edges, crossed = _edges(smooth, pixels, RING * sigma)
    hessian = np.stack([a, b, c], -1) / np.sqrt(a * a + 2 * b * b + c * c)[:, None]
    kept = (np.abs(step).max(-1) < 1.5) & crossed
    fields = (values[kept].astype(np.float64) for values in (pixels, hessian, edges, response[v, u]))
    return SaddlePoints(*fields)


def _edges(
    smooth: np.ndarray, pixels: Float[np.ndarray, "n 2"], radius_px: float
) -> tuple[Float[np.ndarray, "n 4 2"], Bool[np.ndarray, " n"]]:
    """Unit directions in which a circle around each point crosses its mean level, and whether there are just four of them.

    The Hessian does not tell them: that of a sharp corner has no trace, whatever the angle between its edges.
    """
    angle = np.linspace(0, 2 * np.pi, _RING_SAMPLES, endpoint=False)
    circle = pixels[:, None] + radius_px * np.stack([np.cos(angle), np.sin(angle)], -1)
    # cv2.remap takes at most 32767 rows.
    level = np.concatenate(
        [np.zeros((0, _RING_SAMPLES), np.float32)]
        + [
            cv2.remap(smooth, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for part in np.split(circle.astype(np.float32), range(30000, len(circle), 30000))
            if len(part)
        ]
    )
    level = level - 0.5 * (level.max(1, initial=-np.inf) + level.min(1, initial=np.inf))[:, None]
    following = np.roll(level, -1, axis=1)
    crossing = (level < 0) != (following < 0)
    four = crossing.sum(1) == 4
    first = np.argsort(~crossing, axis=1, kind="stable")[:, :4]
    before, after = np.take_along_axis(level, first, 1), np.take_along_axis(following, first, 1)
    share = before / np.where(before == after, 1.0, before - after)
    at = 2 * np.pi / _RING_SAMPLES * (first + share)
    return np.stack([np.cos(at), np.sin(at)], -1), four


@dataclass(frozen=True)
class _Links:
    """What comes next to each point along each of its four directions, -1 where nothing does."""

    point: Int[np.ndarray, "n 4"]
    onward: Int[np.ndarray, "n 4"]
    """The direction at that point that leads on."""

    def step(self, at: Int[np.ndarray, "*k"], direction: Int[np.ndarray, "*k"]) -> tuple[np.ndarray, np.ndarray]:
        """One square ahead, with the direction that leads on; from -1 to -1."""
        direction = direction % 4
        following, onward = self.point[at, direction], self.onward[at, direction]
        return np.where(at < 0, -1, following), onward

    def only(self, kept: Bool[np.ndarray, "n 4"]) -> "_Links":
        return _Links(np.where(kept, self.point, -1), self.onward)


def _linked(points: SaddlePoints) -> _Links:
    """Points that are each other's nearest of opposite Hessian along an edge."""
    count = len(points.pixels)
    distance, index = cKDTree(points.pixels).query(points.pixels, k=min(NEAREST + 1, count))
    distance, index = np.asarray(distance)[:, 1:], np.asarray(index)[:, 1:]
    away = (points.pixels[index] - points.pixels[:, None]) / np.maximum(distance[..., None], 1e-9)
    opposite = np.einsum("nkc,nc->nk", points.hessian[index] * _FROBENIUS, points.hessian) < OPPOSITE
    usable = (np.einsum("nkc,ndc->ndk", away, points.edges) > CONE) & opposite[:, None]
    nearest = np.where(usable.any(-1), np.take_along_axis(index, usable.argmax(-1), 1), -1)
    back = nearest[nearest] == np.arange(count)[:, None, None]
    mutual = back.any(-1) & (nearest >= 0)
    return _Links(np.where(mutual, nearest, -1), (back.argmax(-1) + 2) % 4)


def _squares_only(links: _Links) -> _Links:
    """Links that are sides of closed squares: left and ahead comes to the same point as ahead and left, or to the right."""
    start = np.broadcast_to(np.arange(len(links.point))[:, None], links.point.shape)
    ahead = np.broadcast_to(np.arange(4), links.point.shape)
    following, onward = links.step(start, ahead)
    closed = np.zeros(links.point.shape, dtype=bool)
    for side in (1, 3):
        over, _ = links.step(following, onward + side)
        beside, along = links.step(start, ahead + side)
        round_the_other_way, _ = links.step(beside, along - side)
        closed |= (over >= 0) & (over == round_the_other_way)
    # A square seen from one end only is none: the links of both ends stay or go together.
    back = links.point[following, (onward + 2) % 4] == start
    both = closed[following, (onward + 2) % 4] & back
    return links.only(closed & both & (links.point >= 0))


def lattices(points: SaddlePoints, least_corners: int, most: int) -> list[Lattice]:
    """The `most` largest pieces of checkerboard of at least `least_corners` corners, the largest first."""
    count = len(points.pixels)
    if count < least_corners:
        return []
    links = _squares_only(_linked(points))
    row, direction = np.nonzero(links.point >= 0)
    graph = coo_matrix((np.ones(len(row)), (row, links.point[row, direction])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece)
    largest = [k for k in np.argsort(-sizes, kind="stable")[:most] if sizes[k] >= least_corners]
    found = [_counted(points, links, np.flatnonzero(piece == k)) for k in largest]
    return sorted((grid for grid in found if len(grid.places) >= least_corners), key=lambda grid: -len(grid.places))


def _counted(points: SaddlePoints, links: _Links, members: Int[np.ndarray, " m"]) -> Lattice:
    """Columns and rows, counted layer by layer from the point that most links meet in; a place is taken once."""
    count = len(points.pixels)
    degree = (links.point[members] >= 0).sum(1)
    seed = int(members[np.lexsort((-points.response[members], -degree))[0]])
    turn = np.zeros(count, dtype=np.int64)
    place = np.zeros((count, 2), dtype=np.int64)
    seen = np.zeros(count, dtype=bool)
    seen[seed] = True
    taken = np.array([_key(np.zeros(2, dtype=np.int64))])
    front = np.array([seed])
    while front.size:
        at, direction = np.repeat(front, 4), np.tile(np.arange(4), len(front))
        following, onward = links.point[at, direction], links.onward[at, direction]
        heading = (direction + turn[at]) % 4
        where = place[at] + _STEPS[heading]
        new = np.flatnonzero((following >= 0) & ~seen[following] & ~np.isin(_key(where), taken))
        new = new[np.unique(following[new], return_index=True)[1]]
        new = new[np.unique(_key(where[new]), return_index=True)[1]]
        front = following[new]
        # The direction that leads on at the next point has the heading that led there.
        turn[front], place[front], seen[front] = heading[new] - onward[new], where[new], True
        taken = np.concatenate([taken, _key(where[new])])
    inside = np.flatnonzero(seen)
    agreeing = _agreeing(links, place, turn, seen)
    inside = inside[agreeing[inside]]
    return _lattice(points, inside, place[inside])


def _key(places: Int[np.ndarray, "*k 2"]) -> Int[np.ndarray, "*k"]:
    return np.asarray(places[..., 0] * 100_003 + places[..., 1])


def _agreeing(
    links: _Links, place: Int[np.ndarray, "n 2"], turn: Int[np.ndarray, " n"], seen: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Points most of whose links lead where their places say."""
    heading = (np.arange(4) + turn[:, None]) % 4
    following = links.point
    known = (following >= 0) & seen[:, None] & seen[following]
    right = known & (place[following] == place[:, None] + _STEPS[heading]).all(-1)
    return np.asarray(seen & (2 * right.sum(1) > known.sum(1)))


def _lattice(points: SaddlePoints, members: Int[np.ndarray, " m"], places: Int[np.ndarray, "m 2"]) -> Lattice:
    if not members.size:
        return Lattice(np.zeros((0, 2)), places, False)
    places = places - places.min(0)
    # Along the diagonal between both axes a corner is dark or bright: the sign of d' H d, its axes being edges of zero curvature.
    towards = _mean_steps(points.pixels[members], places).sum(0)
    diagonal = np.array([towards[0] ** 2, 2 * towards[0] * towards[1], towards[1] ** 2])
    sign = np.where(places.sum(1) % 2 == 0, 1.0, -1.0)
    return Lattice(points.pixels[members], places, bool(np.sum(sign * (points.hessian[members] @ diagonal)) > 0))


def _mean_steps(pixels: Float[np.ndarray, "m 2"], places: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "2 2"]:
    """Pixels per column and per row of the affine map that fits best."""
    design = np.concatenate([places, np.ones((len(places), 1))], 1)
    return np.linalg.lstsq(design, pixels, rcond=None)[0][:2]
