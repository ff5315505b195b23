"""What a command was given beside its photos, and does not look at: files that have to be converted, pages behind the first.

with passed_over() as found:
    find_photos(["photos/"])
found.notes
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes
from omnilines.photo_file import start_of_photo
from omnilines.photo_size import MOST_TAG_BYTES, is_animated, is_picture_of_its_own, next_page, with_tags_before

_PAGED_SUFFIXES = (".tif", ".tiff", ".png", ".webp")
"""Of photos that may hold several."""


@dataclass(frozen=True)
class PassedOver:
    """Files, each once, in the order in which they were found."""

    unread: dict[Path, None] = field(default_factory=dict)
    """Of formats that are not read."""
    paged: dict[Path, None] = field(default_factory=dict)
    """Photos with pages, or pictures of an animation, behind the first."""

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence on each kind that there is."""
        said = []
        if self.unread:
            which = _counted(self.unread)
            said.append(f"{which} of a format that is not read, and passed over: convert to JPEG what should count.")
        if self.paged:
            said.append(
                f"{_counted(self.paged)} of several pages, of which the first alone is looked at: save the others as files of "
                "their own if they should count."
            )
        return tuple(said)


def _counted(files: dict[Path, None]) -> str:
    first = next(iter(files)).name
    return f"{first} is" if len(files) == 1 else f"{len(files)} files, such as {first}, are"


_found: ContextVar[PassedOver | None] = ContextVar("_found", default=None)


@contextmanager
def passed_over() -> Iterator[PassedOver]:
    """What is told to `look_beside` as long as this lasts."""
    found = PassedOver()
    before = _found.set(found)
    try:
        yield found
    finally:
        _found.reset(before)


def look_beside(photos: Sequence[Path], unread: Iterable[Path]) -> None:
    """Remember what is not looked at, where someone wants to know: pages of photos, and files that have no readable twin, as raw
    files beside the JPEG of the same picture have."""
    found = _found.get()
    if found is None:
        return
    read = {photo.with_suffix("") for photo in photos}
    found.unread.update(dict.fromkeys(file for file in unread if file.with_suffix("") not in read))
    found.paged.update(dict.fromkeys(photo for photo in photos if _has_pages(photo)))


def _has_pages(file: Path) -> bool:
    if file.suffix.lower() not in _PAGED_SUFFIXES:
        return False
    try:
        start = start_of_photo(file)
        place = next_page(start)
        if place is None:
            return is_animated(start)
        return is_picture_of_its_own(with_tags_before(start, read_bytes(file, MOST_TAG_BYTES, place)))
    except InputError:  # said where the photo is read
        return False
