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
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from calib_patterns.kernels.saddle_points import crossings, nearest_along, responses
from calib_patterns.options import SaddleOptions

MOST_POINTS, MOST_PEAKS = 6000, 18000
"""Saddle points that are kept, and maxima of the response that are looked at, at each scale, the strongest of both."""
BORDER_PX = 3
NEAREST = 40
"""Points around each that are tried as neighbours."""
_FIELDS = ("pixels", "hessian", "edges", "response")
_STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass(frozen=True)
class SaddlePoints:
    """Candidates for corners, to about `SaddleOptions.sigma_px`."""

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


def saddle_points(grey: np.ndarray, options: SaddleOptions) -> SaddlePoints:
    """The strongest saddle points of an 8-bit photo (h, w) at all scales, one for each place."""
    found = [_at_scale(grey.astype(np.float32), sigma, options) for sigma in options.scales_px]
    points = SaddlePoints(*(np.concatenate([getattr(part, name) for part in found]) for name in _FIELDS))
    order = np.argsort(-points.response)[:MOST_PEAKS]
    if not order.size:
        return points
    # Of the same corner at several scales the strongest response is kept.
    pairs = cKDTree(points.pixels[order]).query_pairs(options.same_place_px, output_type="ndarray")
    weaker = np.zeros(len(order), dtype=bool)
    weaker[pairs.max(1)] = True
    order = order[~weaker][:MOST_POINTS]
    strong = np.percentile(points.response[order], 99)
    return points.at(order[points.response[order] > options.min_response_share * strong])


def _at_scale(grey: np.ndarray, sigma: float, options: SaddleOptions) -> SaddlePoints:
    """The maxima of -sigma^4 det H that four quadrants of alternating brightness surround, with the directions in which a circle
    crosses its mean level.

    The Hessian does not tell these: that of a sharp corner has no trace, whatever the angle between its edges.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma)
    response = responses(smooth, sigma**4)
    found = crossings(smooth, response, _peaks(response, options.min_response), options.ring_sigmas * sigma)
    return SaddlePoints(found[:, :2], found[:, 2:5], found[:, 5:13].reshape(-1, 4, 2), found[:, 13])


def _peaks(response: Float32[np.ndarray, "h w"], least: float) -> Int[np.ndarray, "k 2"]:
    """Rows and columns of the strongest maxima, each of 5 x 5 pixels, not at the border."""
    at = np.flatnonzero((response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response >= least))
    if len(at) > MOST_PEAKS:
        at = at[np.argpartition(-response.ravel()[at], MOST_PEAKS)[:MOST_PEAKS]]
    places = np.stack(np.divmod(at, response.shape[1]), -1)
    return places[((places >= BORDER_PX) & (places < np.array(response.shape) - BORDER_PX)).all(1)]


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


def _linked(points: SaddlePoints, options: SaddleOptions) -> _Links:
    """Points that are each other's nearest of opposite Hessian along an edge."""
    count = len(points.pixels)
    _, index = cKDTree(points.pixels).query(points.pixels, k=min(NEAREST + 1, count))
    cone = float(np.cos(np.radians(options.cone_deg)))
    tried = np.asarray(index)[:, 1:]
    nearest = nearest_along(points.pixels, points.hessian, points.edges, tried, options.max_hessian_cosine, cone)
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


def lattices(points: SaddlePoints, least_corners: int, most: int, options: SaddleOptions) -> list[Lattice]:
    """The `most` largest pieces of checkerboard of at least `least_corners` corners, the largest first."""
    count = len(points.pixels)
    if count < least_corners:
        return []
    links = _squares_only(_linked(points, options))
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
