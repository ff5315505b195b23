"""Square tags in a photo: OpenCV finds quadrilaterals at several scales, those that read as tags of the board are kept where they
agree with their neighbours on it.

Any dictionary of few bits decodes some of the clutter of a photo, so a tag counts only as one of the largest set of tags each
of which lies where the local affine maps of its neighbours expect it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from calib_patterns.local_map import KnownCorners
from calib_patterns.options import DetectionOptions
from calib_patterns.tag_decoding import Codes, decode

_NEIGHBOURS = 24
"""Nearest tags that each is compared with: eight, found by each of three searches."""


@dataclass(frozen=True)
class TagFamily:
    """Which tags to look for, and how they are printed."""

    dictionary: str
    """Name of one of OpenCV's predefined dictionaries, without `DICT_`."""
    border_bits: int
    """Width of the black border in bits."""
    touching: bool
    """Whether the tags' corners touch other black: they are then parted by widening the white by a pixel."""
    first: int = 0
    """Which tag of the dictionary is tag 0 of the board."""

    @property
    def opencv(self) -> "cv2.aruco.Dictionary":
        """OpenCV's dictionary."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @property
    def count(self) -> int:
        """Number of tags of the dictionary."""
        return len(self.opencv.bytesList)

    def bits(self, tag: int) -> Bool[np.ndarray, "n n"]:
        """Black cells of a tag of the board, the border included, in OpenCV's orientation."""
        side = self.opencv.markerSize + 2 * self.border_bits
        return cv2.aruco.generateImageMarker(self.opencv, self.first + tag, side, borderBits=self.border_bits) == 0


@dataclass(frozen=True)
class Tags:
    """Tags found: their ids and their corners in OpenCV's order (clockwise from the tag's own top left as printed)."""

    ids: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 4 2"]
    sigma_px: Float[np.ndarray, " n"]


_NEXT = 4
"""Nearest tags that lie next to a tag."""
_NO_TAGS = Tags(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0))


@dataclass(frozen=True)
class _Search:
    scale: float
    widen: int
    """Pixels by which white is widened in the scaled photo."""


_SEARCHES = (_Search(1.0, 1), _Search(2.0, 2), _Search(0.5, 1))
"""`widen` for tags that touch other black."""


@lru_cache(maxsize=8)
def codes_of(family: TagFamily, count: int, corrected_share: float) -> Codes:
    """Of the first `count` tags, with a share of the wrong bits that the dictionary could put right."""
    black = np.stack([family.bits(tag) for tag in range(count)])
    return Codes(black, family.border_bits, int(corrected_share * family.opencv.maxCorrectionBits))


def _detector(family: TagFamily) -> "cv2.aruco.ArucoDetector":
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = family.border_bits
    # Tags near the rim have bent sides and may be small.
    parameters.polygonalApproxAccuracyRate = 0.05
    parameters.minMarkerPerimeterRate = 0.02
    parameters.adaptiveThreshWinSizeMin = 13
    parameters.adaptiveThreshWinSizeMax = 53
    parameters.adaptiveThreshWinSizeStep = 40
    parameters.minDistanceToBorder = 1
    return cv2.aruco.ArucoDetector(family.opencv, parameters)


def tag_candidates(image: np.ndarray, touching: bool, options: DetectionOptions) -> tuple[np.ndarray, Float[np.ndarray, "n 4 2"]]:
    """A photo of 8 bits as it is searched, and the quadrilaterals in it that could be tags of any family."""
    scale = min(1.0, options.search.side_px / max(image.shape))
    scaled = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    widen = _SEARCHES[0].widen if touching else 0
    return scaled, _candidates(scaled, widen, _detector(TagFamily("4X4_50", 1, touching)))


def _candidates(scaled: np.ndarray, widen: int, detector: "cv2.aruco.ArucoDetector") -> Float[np.ndarray, "n 4 2"]:
    parted = cv2.dilate(scaled, np.ones((2 * widen + 1,) * 2, dtype=np.uint8)) if widen else scaled
    read, _, rejected = detector.detectMarkers(parted)
    return _unshrunk(_clockwise(np.array([*read, *rejected], dtype=np.float64).reshape(-1, 4, 2)), widen)


def read_tags(image: np.ndarray, family: TagFamily, count: int, options: DetectionOptions) -> Iterator[Tags]:
    """What each search finds of the first `count` tags, in pixels of the photo (8 bits)."""
    detector = _detector(family)
    codes = codes_of(family, count, options.tags.corrected_share)
    base = min(1.0, options.search.side_px / max(image.shape))
    for search in _SEARCHES:
        scale = base * search.scale
        if scale > 1 and scale**2 * image.size > options.search.max_pixels:
            continue
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        scaled = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)
        factors = np.array(image.shape[::-1]) / np.array(scaled.shape[::-1])
        widen = search.widen if family.touching else 0
        _, ids, pixels = decode(scaled, _candidates(scaled, widen, detector), codes, options.tags)
        # Centre of the first pixel at (0, 0): scaling is about (-0.5, -0.5).
        yield Tags(ids, (pixels + 0.5) * factors - 0.5, np.full(len(ids), max(1.0 / scale, options.saddles.sigma_px)))


def _clockwise(quads: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "m 4 2"]:
    """The convex ones of some extent, all turning from u to v."""
    step = np.roll(quads, -1, axis=1) - quads
    following = np.roll(step, -1, axis=1)
    turns = step[..., 0] * following[..., 1] - step[..., 1] * following[..., 0]
    convex = (np.abs(turns).min(1) > 4.0) & (np.abs(np.sign(turns).sum(1)) == 4)
    quads, turns = quads[convex], turns[convex]
    return np.where((turns[:, 0] > 0)[:, None, None], quads, quads[:, ::-1])


def _unshrunk(pixels: Float[np.ndarray, "n 4 2"], widen: int) -> Float[np.ndarray, "n 4 2"]:
    """The corners before white was widened."""
    middle = pixels.mean(1, keepdims=True)
    side = np.linalg.norm(np.roll(pixels, -1, axis=1) - pixels, axis=2).mean(1)
    return middle + (pixels - middle) * (1.0 + 2.0 * widen / np.maximum(side, 1.0))[:, None, None]


def find_tags(
    image: np.ndarray,
    family: TagFamily,
    board_m: Float[np.ndarray, "tags 4 2"],
    options: DetectionOptions,
    rivals_m: Sequence[Float[np.ndarray, "tags 4 2"]] = (),
) -> Tags:
    """The tags of a board in a photo of 8 bits, as `agreeing` takes them; none where more lie as on one of the `rivals_m`.

    `board_m`: the corners of every tag of the board, in OpenCV's order, rows by id. The search ends when all are found, or some
    and then no more.
    """
    found, kept = _NO_TAGS, 0
    for tags in read_tags(image, family, len(board_m), options):
        before = kept
        found = joined(found, tags)
        kept = len(_agreeing(found, board_m, options.tags.max_misfit).ids)
        if kept == len(board_m) or kept == before > 0:
            break
    own = agreeing(found, family, board_m, options)
    if not len(own.ids):
        return own
    others = [tags_in_place(agreeing(found, family, m, options), m, options.tags.max_misfit) for m in rivals_m]
    rivalled = others and max(others) > tags_in_place(own, board_m, options.tags.max_misfit)
    return _NO_TAGS if rivalled else own


def agreeing(found: Tags, family: TagFamily, board_m: Float[np.ndarray, "tags 4 2"], options: DetectionOptions) -> Tags:
    """Of the tags read in a photo those of a board, each at most once, none that disagrees with the others, and so many that
    chance does not explain them: two of the tags of 16 bits, one of most others. None where most tags disagree, as they do on a
    board of another number of squares."""
    kept = _agreeing(found, board_m, options.tags.max_misfit)
    most = 2 * len(kept.ids) >= len(np.unique(found.ids))
    bits = _evidence_bits(kept, family, codes_of(family, len(board_m), options.tags.corrected_share))
    return kept if most and bits > options.tags.min_evidence_bits else _NO_TAGS


def _evidence_bits(tags: Tags, family: TagFamily, codes: Codes) -> float:
    """By how many bits tags that agree exceed what random bits read as: the id and the turn of the first are free, of the others
    given by their places."""
    if not len(tags.ids):
        return 0.0
    bits = family.opencv.markerSize**2
    alike = sum(math.comb(bits, wrong) for wrong in range(codes.max_wrong_bits + 1))
    return len(tags.ids) * (bits - math.log2(alike)) - math.log2(4 * len(codes.black))


def joined(*parts: Tags) -> Tags:
    """All of several searches."""
    return Tags(*(np.concatenate([getattr(tags, field.name) for tags in parts]) for field in fields(Tags)))


def _agreeing(tags: Tags, board_m: Float[np.ndarray, "tags 4 2"], max_misfit: float) -> Tags:
    """The largest set of tags that agree with each other; of several of one id the first found."""
    if not len(tags.ids):
        return tags
    pairs, linked, right_handed = _linked(tags, board_m[tags.ids], _NEIGHBOURS, max_misfit)
    # Only true links: SciPy takes a stored False for an edge as well.
    pairs = pairs[:, linked]
    graph = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(len(tags.ids),) * 2)
    member = connected_components(graph, directed=False)[1]
    sizes = np.array([len(np.unique(tags.ids[(member == k) & right_handed])) for k in range(member.max() + 1)])
    in_largest = np.flatnonzero((member == sizes.argmax()) & right_handed)
    kept = in_largest[np.unique(tags.ids[in_largest], return_index=True)[1]]
    return Tags(tags.ids[kept], tags.pixels[kept], tags.sigma_px[kept])


def _linked(
    tags: Tags, on_board: Float[np.ndarray, "n 4 2"], neighbours: int, max_misfit: float
) -> tuple[Int[np.ndarray, "2 m"], Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
    """Pairs of neighbours on the board, which of them agree, and which tags are not mirrored."""
    # Affine map of each tag: its centre and the mean of opposite sides.
    sides = _sides(tags.pixels) @ np.linalg.inv(_sides(on_board))
    right_handed = np.linalg.det(sides) > 0
    centre_m, centre_px = on_board.mean(1), tags.pixels.mean(1)
    count = min(neighbours + 1, len(tags.ids))
    neighbour = np.asarray(cKDTree(centre_m).query(centre_m, k=count)[1], dtype=np.int64).reshape(-1, count)
    pairs = np.stack([np.repeat(np.arange(len(tags.ids)), count), neighbour.ravel()])
    pairs = np.concatenate([pairs, pairs[::-1]], 1)
    steps_m = centre_m[pairs[1]] - centre_m[pairs[0]]
    distance_px = np.linalg.norm(centre_px[pairs[1]] - centre_px[pairs[0]], axis=1)
    # The mean of both maps expects a neighbour to second order.
    both = 0.5 * (sides[pairs[0]] + sides[pairs[1]])
    off = np.linalg.norm(centre_px[pairs[0]] + np.einsum("nij,nj->ni", both, steps_m) - centre_px[pairs[1]], axis=1)
    same = tags.ids[pairs[0]] == tags.ids[pairs[1]]
    size_px = np.sqrt(np.abs(np.linalg.det(_sides(tags.pixels))))[pairs[0]]
    linked = np.where(same, distance_px < 0.3 * size_px, off < max_misfit * distance_px)
    linked &= right_handed[pairs[0]] & right_handed[pairs[1]]
    return pairs, linked, right_handed


def tags_in_place(tags: Tags, board_m: Float[np.ndarray, "tags 4 2"], max_misfit: float) -> int:
    """How many of the tags of a board agree with most of those next to them. On a board with the tags in another order most agree
    with some that are farther off, and few with their neighbours."""
    if len(tags.ids) < 2:
        return len(tags.ids)
    pairs, linked, _ = _linked(tags, board_m[tags.ids], _NEXT, max_misfit)
    apart = pairs[0] != pairs[1]
    seen, agree = (np.bincount(pairs[0][chosen], minlength=len(tags.ids)) for chosen in (apart, apart & linked))
    return int((2 * agree > seen).sum())


def _sides(corners: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "n 2 2"]:
    """Mean top and bottom side, mean left and right side, as columns."""
    a, b, c, d = np.moveaxis(corners, 1, 0)
    return 0.5 * np.stack([b - a + c - d, d - a + c - b], -1)


def tag_corners(tags: Tags, board_m: Float[np.ndarray, "tags 4 2"]) -> KnownCorners:
    """The corners of the tags as known places of the board.

    A quadrilateral far from a parallelogram has taken in a piece of what its tag touches: its corners are trusted no more than
    its sides disagree.
    """
    a, b, c, d = np.moveaxis(tags.pixels, 1, 0)
    sigma_px = np.hypot(tags.sigma_px, 0.5 * np.linalg.norm(a - b + c - d, axis=1))
    return KnownCorners(board_m[tags.ids].reshape(-1, 2), tags.pixels.reshape(-1, 2), np.repeat(sigma_px, 4))
