"""How a target is printed, decided on a few photos before all are searched."""

from collections.abc import Sequence

from calib_patterns import DetectionOptions, Pattern
from calib_patterns.recognition import TagsOfPhotos, recognised
from camera_models import InputError
from omnilines.files import Photo
from omnilines.progress import ProgressCallback

OTHERWISE = "The board is "
"""How the sentence begins that says that a target is not printed as it was given."""
FIRST = 2
"""Photos looked at first: where both show the board as it was given, that is enough."""
MOST_TIMES = 4
"""So many times `recognition.photos` are looked at where these show no tag of it."""


def as_printed(
    pattern: Pattern,
    photos: Sequence[Photo],
    *,
    any_tags: bool,
    mirrored: bool,
    options: DetectionOptions,
    progress: ProgressCallback,
) -> tuple[Pattern, str | None]:
    """The target as the photos show it, and where that is not as it was given one sentence that says so.

    `any_tags`: also with other tags of its dictionary.
    """
    if pattern.plain_grid is not None:
        return pattern, None
    seen = TagsOfPhotos(pattern, options, mirrored=mirrored)
    order = _from_all_over(len(photos))
    some = options.recognition.photos
    found, looked = None, 0
    for count in (FIRST, some, MOST_TIMES * some):
        for index in order[looked:count]:
            progress("recognising the board", looked, 0)
            looked += 1
            try:
                seen.add(photos[index].read())
            except InputError:
                # Why it cannot be read is said where all are searched.
                continue
        found = recognised(seen, any_tags=any_tags)
        if found is not None and (found.photos >= FIRST or looked == len(photos)):
            break
    if found is None or found.pattern == pattern:
        return pattern, None
    return found.pattern, (
        f"{OTHERWISE}{found.pattern.specification}, not {pattern.specification}: {found.tags} tags in {found.photos} of "
        f"{len(seen)} photos lie so. It is taken for that in all photos."
    )


def _from_all_over(photos: int) -> list[int]:
    """The numbers of all photos, any first few of them spread over all (van der Corput's sequence)."""
    bits = max(photos - 1, 1).bit_length()
    turned = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [index for index in turned if index < photos]
