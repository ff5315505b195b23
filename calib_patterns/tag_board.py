"""Boards with tags: their corners are grown from the tags (corner_growth.py), so that a corner needs no tag of its own."""

from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from calib_patterns._cells import CellGrid
from calib_patterns._pattern import Detection, Pattern, Project, check_image
from calib_patterns.board_match import matched
from calib_patterns.corner_growth import MIN_CORNERS, grow_corners, inside_photo
from calib_patterns.detection import grey_of, is_too_small, searched, stretched, why_not
from calib_patterns.local_map import KnownCorners, local_map
from calib_patterns.options import DetectionOptions
from calib_patterns.saddle_points import Lattice, lattices, saddle_points
from calib_patterns.tag_decoding import likeness
from calib_patterns.tags import TagFamily, codes_of, find_tags, tag_corners
from camera_models.errors import InputError

LEAST_SEEDS = 4
"""Corners of a piece that may lead to the others: a square."""
_SAMPLES, _INSIDE = 9, 0.56
"""Samples along the side of a tag, and the share of it within all borders."""


def require_tags(kind: str, name: str, counts: Mapping[str, int], tags: int) -> None:
    """Raises InputError where a set of tags, one of those with `counts` tags, has fewer than `tags`, or there is no such set."""
    if tags <= counts.get(name, 0):
        return
    known = [other for other, count in counts.items() if count >= tags]
    most = max(counts, key=counts.__getitem__)
    do = f"use one of {', '.join(known)}" if known else f"the largest, {most}, has {counts[most]}: make a smaller board"
    raise InputError(f"A {kind} with at least {tags} tags was expected, found '{name}'; {do}.")


class TagBoard(Pattern):
    """What boards with tags share: their print is a grid of cells, and their corners are grown from their tags."""

    @property
    @abstractmethod
    def family(self) -> TagFamily:
        """The tags on it."""

    @property
    @abstractmethod
    def layouts(self) -> "tuple[TagBoard, ...]":
        """This board and those that a specification easily mistakes it for: other orders of the same tags."""

    @abstractmethod
    def with_first_tag(self, tag: int) -> "TagBoard":
        """The same board with tags of its dictionary from another one on. Raises InputError where there are too few."""

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

    @property
    def black_rectangles_m(self) -> Float[np.ndarray, "n 4"]:
        return self.cells.rectangles_m

    def reflectance(
        self, points_m: Float[np.ndarray, "*batch 2"], footprint_m: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch"]:
        """0 on black, 1 on white, from a summed-area table of the print's cells."""
        return self.cells.reflectance(points_m, footprint_m)

    def detect(
        self, image: np.ndarray, *, mirrored: bool = False, options: DetectionOptions = DetectionOptions()
    ) -> tuple[Detection, str | None]:
        """Every visible corner with its id; part of the board is enough, from one tag with its corners on, or two
        where tags have few bits."""
        check_image(image)
        grey = grey_of(image)
        if is_too_small(grey, options.search):
            return Detection.empty(), self._why_not(grey, options, tags_found=False)
        if mirrored:
            grey = np.ascontiguousarray(grey[:, ::-1])
        rivals_m = [layout.tag_corners_m for layout in self.layouts if layout != self]
        tags = find_tags(stretched(grey), self.family, self.tag_corners_m, options, rivals_m)
        found = self._grown(grey, tag_corners(tags, self.tag_corners_m), options) if len(tags.ids) else Detection.empty()
        if len(found) < options.appearance.found_share * len(self.points_m):
            by_look = self._seeds_by_appearance(grey, options)
            again = Detection.empty() if by_look is None else self._grown(grey, by_look, options)
            if len(again) > len(found) == 0 and self._reads_otherwise(grey, options):
                again = found
            found = max(found, again, key=len)
        if not len(found):
            return found, self._why_not(grey, options, tags_found=bool(len(tags.ids)))
        if mirrored:
            pixels = np.array([grey.shape[1] - 1.0, 0.0]) + found.pixels * [-1.0, 1.0]
            found = Detection(found.ids, pixels, found.sigma_px, found.blur_px)
        return found, None

    def _reads_otherwise(self, grey: np.ndarray, options: DetectionOptions) -> bool:
        """Whether tags are read that lie as on another of the layouts: much of this one looks like it."""
        image, rivals = stretched(grey), (layout for layout in self.layouts if layout != self)
        return any(len(find_tags(image, self.family, rival.tag_corners_m, options).ids) for rival in rivals)

    def _grown(self, grey: np.ndarray, seeds: KnownCorners, options: DetectionOptions) -> Detection:
        """The corners grown from known places, none where the tags among them are not seen to be those of the board: clutter
        reads as a tag now and then, and corners of boards with other tags are alike."""
        kind = self.corner_kind(options.fit)
        found = grow_corners(grey, kind, seeds, options)
        if not len(found):
            return found
        known = KnownCorners(kind.corners_m[found.ids], found.pixels, np.maximum(found.sigma_px, options.map.min_sigma_px))
        places = local_map(known, self.tag_corners_m.reshape(-1, 2), kind.spacing_m, options.map)
        quads, sigma_px = places.pixels.reshape(-1, 4, 2), places.sigma_px.reshape(-1, 4).max(1)
        side_px = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).min(1)
        inside = ((quads >= 0) & (quads <= np.array(grey.shape[::-1]) - 1)).all((1, 2))
        tags = np.flatnonzero(inside & (sigma_px < options.tags.certain_share * side_px))
        if not len(tags):
            return Detection.empty()
        codes = codes_of(self.family, len(quads), options.tags.corrected_share)
        alike = likeness(stretched(grey), quads[tags], codes, tags)
        return found if alike > options.tags.min_likeness else Detection.empty()

    def _seeds_by_appearance(self, grey: np.ndarray, options: DetectionOptions) -> KnownCorners | None:
        """Places of the board known without reading a tag, for photos that are too blurred for that: from pieces of its corners
        between which the photo looks like some part of it; None where there are none.

        `grey`: (h, w) of any depth, not mirrored.
        """
        search, factors = searched(grey, options.search)
        limits, together = options.appearance, options.saddles
        tried, grown = np.zeros((0, 2)), 0
        # All scales together, then each alone: where squares are small, the bits of tags are saddle points of the finer scales
        # that lie between the corners.
        for saddles in (together, *(together._replace(scales_px=(scale,)) for scale in together.scales_px)):
            for piece in lattices(saddle_points(search, saddles), LEAST_SEEDS, limits.max_pieces, saddles):
                # Part of what did not stand out does so even less.
                if len(tried) and np.max(cKDTree(tried).query(piece.pixels)[0]) < together.same_place_px:
                    continue
                whole = self._with_more_corners(grey, piece, factors, options)
                seeds = matched(search, whole, self, self.lines_m, options)
                if seeds is not None:
                    pixels = (seeds.pixels + 0.5) * factors - 0.5
                    return KnownCorners(seeds.board_m, pixels, seeds.sigma_px * float(factors.max()))
                tried, grown = np.concatenate([tried, whole.pixels]), grown + (len(whole.places) > len(piece.places))
                if grown == limits.max_grown or len(whole.places) >= limits.enough_share * len(self.points_m):
                    return None
        return None

    def _with_more_corners(
        self, grey: np.ndarray, piece: Lattice, factors: Float[np.ndarray, "2"], options: DetectionOptions
    ) -> Lattice:
        """A piece with the corners around it, where they can be found without ids; `grey` and `factors` as in `visible_part`."""
        return piece

    def marks_agree(self, grey: np.ndarray, project: Project, options: DetectionOptions) -> bool:
        """A quarter of the tags in the image look as printed: the corners alone are the same a few squares on."""
        low, right, _, down = np.moveaxis(self.tag_corners_m, 1, 0)
        share = 0.5 + _INSIDE * ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5)
        s, t = (axis.reshape(1, -1, 1) for axis in np.meshgrid(share, share))
        points = low[:, None] + s * (right - low)[:, None] + t * (down - low)[:, None]
        pixels, valid = project(np.concatenate([points, np.zeros_like(points[..., :1])], -1))
        inside = (valid & inside_photo(pixels, grey.shape)).all(1)
        if not inside.any():
            return False
        places = pixels[inside].astype(np.float32)
        seen = cv2.remap(grey.astype(np.float32), places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(np.float64)
        printed = self.reflectance(points[inside], np.zeros_like(points[inside]))
        seen, printed = seen - seen.mean(1, keepdims=True), printed - printed.mean(1, keepdims=True)
        norm = np.sqrt((seen**2).sum(1) * (printed**2).sum(1))
        correlation = (seen * printed).sum(1) / np.maximum(norm, 1e-12)
        return bool(np.percentile(correlation, 75) > options.guided.min_tag_correlation)

    def _why_not(self, grey: np.ndarray, options: DetectionOptions, *, tags_found: bool) -> str:
        if tags_found:
            return f"Tags like those of a {self.NAME} were found, but no {MIN_CORNERS} corners around them fit its print."
        needs = "it needs one whole tag at least, some 20 px wide, of the family and size of bits given, and not mirrored"
        return why_not(grey, self.NAME, options.search, needs)
