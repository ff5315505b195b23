"""How a board with tags is printed where its specification does not say so: black on white or white on black, in which layout,
and with which tags of its dictionary.

A wrong layout, a wrong first tag and a negative leave the tags of a photo at odds with each other or unread. So the tags of a few
photos are read once, black on white and white on black, and the print that most of them agree with is taken.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib_patterns._pattern import Pattern
from calib_patterns.detection import grey_of, is_too_small, stretched
from calib_patterns.inverted import Inverted, negative
from calib_patterns.options import DetectionOptions
from calib_patterns.tag_board import TagBoard
from calib_patterns.tags import Tags, agreeing, read_tags, tags_in_place

_WINDOW_SHARE = 0.8
"""A range of tags is tried where it holds this share of as many tags as the best one."""
_MOST_RANGES = 64


@dataclass(frozen=True)
class Recognised:
    """The print that the tags of some photos agree with."""

    pattern: Pattern
    tags: int
    """That agree with it, in all photos together."""
    photos: int
    """In which they do."""


class TagsOfPhotos:
    """The tags that photos show, of the whole dictionary of a board; each photo and its negative are searched when asked for."""

    def __init__(self, pattern: Pattern, options: DetectionOptions, *, mirrored: bool) -> None:
        self.given, self.options, self.mirrored = pattern, options, mirrored
        board = pattern.printed if isinstance(pattern, Inverted) else pattern
        assert isinstance(board, TagBoard)
        self.board = board
        self._every = board.with_first_tag(0).family
        self._photos: list[np.ndarray] = []
        self._read: dict[tuple[int, bool], Tags] = {}

    def __len__(self) -> int:
        return len(self._photos)

    def add(self, photo: np.ndarray) -> None:
        """One more photo, as `Pattern.detect` takes it."""
        if not is_too_small(photo, self.options.search):
            grey = stretched(grey_of(photo))
            self._photos.append(np.ascontiguousarray(grey[:, ::-1]) if self.mirrored else grey)

    def of(self, photo: int, inverted: bool) -> Tags:
        """By their numbers in the dictionary."""
        key = photo, inverted
        if key not in self._read:
            image = negative(self._photos[photo]) if inverted else self._photos[photo]
            # The first search is the quickest: a few photos in which the tags are large are enough.
            self._read[key] = next(read_tags(image, self._every, self._every.count, self.options))
        return self._read[key]

    def agreeing(self, board: TagBoard, inverted: bool) -> tuple[int, int]:
        """How many of them lie as on a board, and in how many photos."""
        first, corners_m = board.family.first, board.tag_corners_m
        counts = []
        for photo in range(len(self)):
            tags = self.of(photo, inverted)
            own = (tags.ids >= first) & (tags.ids < first + len(corners_m))
            on_board = Tags(tags.ids[own] - first, tags.pixels[own], tags.sigma_px[own])
            kept = agreeing(on_board, board.family, corners_m, self.options)
            counts.append(tags_in_place(kept, corners_m, self.options.tags.max_misfit))
        return sum(counts), int(np.count_nonzero(counts))


def recognised(seen: TagsOfPhotos, *, any_tags: bool) -> Recognised | None:
    """The print of a board that photos show: the one given, unless their tags clearly agree with another; None where they agree
    with none.

    `any_tags`: also with other tags of the dictionary, which only holds where no other board is seen.
    """
    as_given = isinstance(seen.given, Inverted)
    given = Recognised(seen.given, *seen.agreeing(seen.board, as_given))
    # A board and its negative are not both read.
    sides = (as_given,) if given.tags else (as_given, not as_given)
    prints = [(layout, side) for side in sides for layout in seen.board.layouts]
    found = _best(seen, prints)
    if found is None and any_tags:
        found = _best(seen, [(other, side) for layout, side in prints for other in _with_other_tags(seen, layout, side)])
    if found is None or found.tags < seen.options.recognition.clear_factor * given.tags:
        return given if given.tags else None
    return found


def _best(seen: TagsOfPhotos, prints: Sequence[tuple[TagBoard, bool]]) -> Recognised | None:
    """The print that most tags agree with, of several the first; None where none do."""
    best: Recognised | None = None
    for board, inverted in prints:
        tags, photos = seen.agreeing(board, inverted)
        if tags > (0 if best is None else best.tags):
            best = Recognised(Inverted(board) if inverted else board, tags, photos)
    return best


def _with_other_tags(seen: TagsOfPhotos, board: TagBoard, inverted: bool) -> Iterator[TagBoard]:
    """The board with every range of tags that holds most of those read, multiples of its number of tags first: so are the boards
    of a set numbered."""
    count, total = len(board.tag_corners_m), board.family.count
    read = np.zeros(total)
    for photo in range(len(seen)):
        read[np.unique(seen.of(photo, inverted).ids)] += 1
    within = np.convolve(read, np.ones(count), "valid")
    if not len(within) or within.max() == 0:
        return
    starts = np.flatnonzero(within >= _WINDOW_SHARE * within.max())
    order = np.lexsort((starts, starts % count != 0))
    for first in starts[order][:_MOST_RANGES].tolist():
        yield board.with_first_tag(first)
