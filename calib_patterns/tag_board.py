"""Boards with tags: their corners are grown from the tags (corner_growth.py), so that a corner needs no tag of its own."""

from abc import abstractmethod
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from calib_patterns._cells import CellGrid
from calib_patterns._pattern import Detection, Pattern, check_image
from calib_patterns.board_match import matched
from calib_patterns.corner_growth import MIN_CORNERS, grow_corners
from calib_patterns.corner_kind import CornerKind
from calib_patterns.detection import LEAST_SIDE_PX, grey_of, searched, stretched, why_not
from calib_patterns.local_map import LEAST_SIGMA_PX, KnownCorners, local_map
from calib_patterns.saddle_points import SAME_PLACE_PX, SCALES_PX, Lattice, lattices, saddle_points
from calib_patterns.tag_decoding import likeness
from calib_patterns.tags import TagFamily, codes_of, find_tags, tag_corners

LEAST_LIKENESS = 0.4
"""Of the tags of a board to what is seen in their places: their own reach 0.5 with blur of 2 px and bits of 1.3, others 0.2."""
CERTAIN_TAG = 0.1
"""A tag's corners are known when their standard deviation is below this share of its side."""
LEAST_SEEDS, MOST_PIECES = 4, 6
"""Corners of a piece that may lead to the others: a square; and such pieces that are tried at each set of scales."""
_SCALES_PX = (SCALES_PX, *((scale,) for scale in SCALES_PX))
"""All together, then each alone: where squares are small, the bits of tags are saddle points of the finer scales that lie between
the corners."""
MUCH, MOST_GROWN = 0.5, 3
"""No more pieces are tried once one with this share of the board's corners, or so many that had more corners around them, look
like no part of it: the photo shows another board, or texture."""
FEW = 0.9
"""With a smaller share of the corners than this the board is also looked for without reading its tags."""


class TagBoard(Pattern):
    """What boards with tags share: their print is a grid of cells, and their corners are grown from their tags."""

    @property
    @abstractmethod
    def family(self) -> TagFamily:
        """The tags on it."""

    @property
    @abstractmethod
    def tag_corners_m(self) -> Float[np.ndarray, "tags 4 2"]:
        """Corners of every tag on the board, rows by id, in OpenCV's order."""

    @property
    @abstractmethod
    def lines_m(self) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
        """The x of the lines along y and the y of those along x that the corners are on, and of those around them, ascending."""

    @cached_property
    @abstractmethod
    def cells(self) -> CellGrid:
        """The print."""

    @cached_property
    @abstractmethod
    def corner_kind(self) -> CornerKind:
        """What the print looks like around the corners, rows by id."""

    @property
    def black_rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        return self.cells.rectangles_m

    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """0 on black, 1 on white, from a summed-area table of the print's cells."""
        return self.cells.reflectance(points_m, footprint_m)

    def detect(self, image: np.ndarray, *, mirrored: bool = False) -> tuple[Detection, str | None]:
        """Every visible corner with its id; part of the board is enough, from one tag with its corners on, or two
        where tags have few bits."""
        check_image(image)
        grey = grey_of(image)
        if min(grey.shape) < LEAST_SIDE_PX:
            return Detection.empty(), self._why_not(grey, tags_found=False)
        if mirrored:
            grey = np.ascontiguousarray(grey[:, ::-1])
        tags = find_tags(stretched(grey), self.family, self.tag_corners_m)
        found = self._grown(grey, tag_corners(tags, self.tag_corners_m)) if len(tags.ids) else Detection.empty()
        if len(found) < FEW * len(self.points_m):
            by_look = self._seeds_by_appearance(grey)
            again = Detection.empty() if by_look is None else self._grown(grey, by_look)
            found = max(found, again, key=len)
        if not len(found):
            return found, self._why_not(grey, tags_found=bool(len(tags.ids)))
        if mirrored:
            pixels = np.array([grey.shape[1] - 1.0, 0.0]) + found.pixels * [-1.0, 1.0]
            found = Detection(found.ids, pixels, found.sigma_px, found.blur_px)
        return found, None

    def _grown(self, grey: np.ndarray, seeds: KnownCorners) -> Detection:
        """The corners grown from known places, none where the tags among them are not seen to be those of the board: clutter
        reads as a tag now and then, and corners of boards with other tags are alike."""
        found = grow_corners(grey, self.corner_kind, seeds)
        if not len(found):
            return found
        corners_m, spacing_m = self.corner_kind.corners_m[found.ids], self.corner_kind.spacing_m
        known = KnownCorners(corners_m, found.pixels, np.maximum(found.sigma_px, LEAST_SIGMA_PX))
        places = local_map(known, self.tag_corners_m.reshape(-1, 2), spacing_m)
        quads, sigma_px = places.pixels.reshape(-1, 4, 2), places.sigma_px.reshape(-1, 4).max(1)
        side_px = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).min(1)
        inside = ((quads >= 0) & (quads <= np.array(grey.shape[::-1]) - 1)).all((1, 2))
        tags = np.flatnonzero(inside & (sigma_px < CERTAIN_TAG * side_px))
        if not len(tags):
            return Detection.empty()
        alike = likeness(stretched(grey), quads[tags], codes_of(self.family, len(quads)), tags)
        return found if alike > LEAST_LIKENESS else Detection.empty()

    def _seeds_by_appearance(self, grey: np.ndarray) -> KnownCorners | None:
        """Places of the board known without reading a tag, for photos that are too blurred for that: from pieces of its corners
        between which the photo looks like some part of it; None where there are none.

        `grey`: (h, w) of any depth, not mirrored.
        """
        search, factors = searched(grey)
        tried, grown = np.zeros((0, 2)), 0
        for scales_px in _SCALES_PX:
            for piece in lattices(saddle_points(search, scales_px), LEAST_SEEDS, MOST_PIECES):
                # Part of what did not stand out does so even less.
                if len(tried) and np.max(cKDTree(tried).query(piece.pixels)[0]) < SAME_PLACE_PX:
                    continue
                whole = self._with_more_corners(grey, piece, factors)
                seeds = matched(search, whole, self, *self.lines_m)
                if seeds is not None:
                    pixels = (seeds.pixels + 0.5) * factors - 0.5
                    return KnownCorners(seeds.board_m, pixels, seeds.sigma_px * float(factors.max()))
                tried, grown = np.concatenate([tried, whole.pixels]), grown + (len(whole.places) > len(piece.places))
                if grown == MOST_GROWN or len(whole.places) >= MUCH * len(self.points_m):
                    return None
        return None

    def _with_more_corners(self, grey: np.ndarray, piece: Lattice, factors: Float[np.ndarray, "2"]) -> Lattice:
        """A piece with the corners around it, where they can be found without ids; `grey` and `factors` as in `visible_part`."""
        return piece

    def _why_not(self, grey: np.ndarray, *, tags_found: bool) -> str:
        if tags_found:
            return f"Tags like those of a {self.NAME} were found, but no {MIN_CORNERS} corners around them fit its print."
        needs = "it needs one whole tag at least, some 20 px wide, of the family and size of bits given, and not mirrored"
        return why_not(grey, self.NAME, needs)
