"""Photos on disk: finding them in folders, naming them as the tables do, writing them."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, UInt, UInt8, UInt16

from camera_models._arrays import Array
from camera_models.errors import InputError
from camera_models.formats.disk import read_bytes, require_in_place, write_atomically
from camera_models.formats.values import is_text, stray
from camera_models.typed import typed
from omnilines.files.passed_over import look_beside
from omnilines.machine import available_bytes
from omnilines.photo_file import MOST_PIXELS, levels_of, read_photo, start_of_photo, stretched
from omnilines.photo_size import may_have_16_bits, size_of_photo
from omnilines.progress import ProgressCallback, on_all_cores, silent

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm")
UNREAD_SUFFIXES = (".heic", ".heif", ".avif", ".jxl", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
"""Of photos of phones and cameras that have to be converted."""
_FIRST_BYTES = 64
"""Of a photo, that say whether it may have 16 bits."""
READ_BYTES_PER_PIXEL = 6
"""Of a photo of 16 bits in colour."""
_SHARE = 0.5
"""Of the memory that can be taken, for photos being worked on."""


@dataclass(frozen=True)
class PhotoRef:
    """A photo and the name it has in tables."""

    path: Path
    name: str
    """POSIX path relative to the photo folder."""
    levels: tuple[int, int] | None = None
    """Of photos that are compared: the darkest and the brightest level of them all, from which one of 16 bits is stretched."""
    mask: Path | Bool[np.ndarray, "mh mw"] | None = field(default=None, compare=False)
    """Where it is looked at: true, or an image that is white there; None everywhere."""

    def read(self) -> UInt[np.ndarray, "h w *channels"]:
        """The pixels, as `read_photo` gives them where there are no `levels`."""
        return _of_levels(read_photo(self.path), self.levels)


@dataclass(frozen=True, eq=False)
class PhotoArray:
    """A photo in memory and the name it has in tables."""

    name: str
    pixels: UInt[np.ndarray, "h w *channels"]
    time_s: float | None = None
    """When it was taken, of frames of a video."""
    levels: tuple[int, int] | None = None
    """As those of a `PhotoRef`."""
    mask: Path | Bool[np.ndarray, "mh mw"] | None = None
    """As that of a `PhotoRef`."""

    def read(self) -> UInt[np.ndarray, "h w *channels"]:
        """The pixels, as they are given where there are no `levels`."""
        return _of_levels(self.pixels, self.levels)


def _of_levels(pixels: UInt[np.ndarray, "h w *channels"], levels: tuple[int, int] | None) -> UInt[np.ndarray, "h w *channels"]:
    return pixels if levels is None or pixels.dtype == np.uint8 else stretched(pixels, levels, np.uint16)


Photo: TypeAlias = PhotoRef | PhotoArray
Photos: TypeAlias = str | Path | Sequence[str | Path] | Sequence[Photo] | Sequence[Array] | Mapping[str, Any]
"""What a user may give as photos: a folder, files and folders, what `photos_of` made of them, or pixels, with names of their own
or without (photo0, photo1, ...)."""


@typed
def photos_of(photos: Photos) -> list[Photo]:
    """The photos of a folder, of files and folders, of arrays, or of a mapping of names to arrays: (h, w) grey or (h, w, 3) BGR,
    of 8 or 16 bits.

    Raises InputError as `find_photos` does, and where an array is no photo.
    """
    if isinstance(photos, Mapping):
        if not photos:
            raise InputError("Photos were expected as a mapping of names to arrays, found an empty one; give one or more.")
        return [_photo_array(name, pixels) for name, pixels in photos.items()]
    if isinstance(photos, str | Path):
        return list(find_photos([photos]))
    if any(isinstance(photo, Array) for photo in photos):
        return [_photo_array(f"photo{number}", pixels) for number, pixels in enumerate(photos)]
    given = [photo for photo in photos if isinstance(photo, PhotoRef | PhotoArray)]
    return given if given else list(find_photos([photo for photo in photos if isinstance(photo, str | Path)]))


def _photo_array(name: str, pixels: Any) -> PhotoArray:
    why = stray(name) if isinstance(name, str) and name.strip() else "is none; give it a name"
    if why is not None:
        raise InputError(f"A photo was expected under a name, as tables have it, found that {name!r} {why}.")
    array = np.asarray(pixels)
    if array.dtype not in (np.uint8, np.uint16) or array.shape[2:] not in ((), (3,)) or array.ndim < 2 or not array.size:
        raise InputError(
            f"The photo {name} was expected as an array (h, w) or (h, w, 3) of 8 or 16 bits, found {array.shape} of "
            f"{array.dtype}; convert it."
        )
    return PhotoArray(name, array)


def of_one_range(photos: Sequence[Photo], progress: ProgressCallback = silent) -> list[Photo]:
    """The photos, those of 16 bits stretched from the darkest level of them all to the brightest.

    Cameras seldom fill 16 bits, and what grey levels say would be lost; stretched each by itself, photos would no longer be as
    bright as each other where they were. Photos that cannot be read are left as they are.
    """

    def look(photo: Photo) -> tuple[int, int] | None:
        """The levels of one photo of 16 bits; None of others."""
        try:
            pixels = photo.read()
        except InputError:
            return None
        return levels_of(pixels) if pixels.dtype == np.uint16 else None

    deep = [photo for photo in photos if _may_have_16_bits(photo)]
    found = on_all_cores(look, deep, "reading grey levels", progress, photos_at_once(deep, READ_BYTES_PER_PIXEL))
    known = [levels for levels in found if levels is not None]
    if not known:
        return list(photos)
    every = min(dark for dark, _ in known), max(bright for _, bright in known)
    return [replace(photo, levels=every) for photo in photos]


def _may_have_16_bits(photo: Photo) -> bool:
    if isinstance(photo, PhotoArray):
        return photo.pixels.dtype == np.uint16
    try:
        return may_have_16_bits(read_bytes(photo.path, _FIRST_BYTES))
    except InputError:
        return False


def photo_folder(photos: Sequence[Photo]) -> Path | None:
    """The folder that the photos' names are relative to; None of photos in memory or with names of their own."""
    photo = photos[0]
    if not isinstance(photo, PhotoRef) or photo.path.parts[-len(Path(photo.name).parts) :] != Path(photo.name).parts:
        return None
    return photo.path.parents[len(Path(photo.name).parts) - 1]


@typed
def find_photos(paths: Sequence[str | Path]) -> list[PhotoRef]:
    """The photos in folders (and their subfolders) and among files, each once, in natural order (2.jpg before 10.jpg).

    The photo folder, which names are relative to, is the folder given; of several folders or files it is the deepest one that
    holds them all. Links that lead out of a folder are followed. Files whose name begins with a dot are left out. Raises
    InputError where a path does not exist, a file named is not of PHOTO_SUFFIXES, a name is not valid text, there is no photo, or
    one that is the result of a run which was ended before all of them were in place.
    """
    found: dict[str, None] = {}
    folders = []
    for path in map(Path, paths):
        if path.is_dir():
            folders.append(os.path.abspath(path))
            found |= dict.fromkeys(_photos_in(path))
        elif not path.exists():
            raise InputError(f"{path} does not exist; give photos or a folder of photos.")
        elif path.suffix.lower() not in PHOTO_SUFFIXES:
            raise InputError(f"{path} is not a photo; expected a file ending in {' '.join(PHOTO_SUFFIXES)}.")
        else:
            folders.append(os.path.abspath(path.parent))
            found[os.path.abspath(path)] = None
    if not found:
        named = " ".join(map(str, paths)) or "an empty list of paths"
        other = next(iter(_unread_in(paths)), None)
        convert = "" if other is None else f"; {Path(other).name} is of a format that is not read: convert it to JPEG"
        raise InputError(f"No image found in {named}; expected files ending in {' '.join(PHOTO_SUFFIXES)}{convert}.")
    root = os.path.commonpath(folders)
    photos = [PhotoRef(Path(path), Path(os.path.relpath(path, root)).as_posix()) for path in found]
    for photo in photos:
        require_in_place(photo.path)
        # Control characters, and bytes that are not UTF-8: tables could not hold them.
        if not is_text(photo.name):
            raise InputError(f"The name of the image {photo.name!r} holds characters that are not text; rename it.")
    photos.sort(key=lambda photo: _natural(photo.name))
    look_beside([photo.path for photo in photos], map(Path, _unread_in(paths)))
    return photos


def _unread_in(paths: Sequence[str | Path]) -> list[str]:
    """Photos in folders that have to be converted."""
    return [file for path in map(Path, paths) if path.is_dir() for file in sorted(_photos_in(path, UNREAD_SUFFIXES))]


def _photos_in(folder: Path, suffixes: tuple[str, ...] = PHOTO_SUFFIXES) -> Iterator[str]:
    root = os.path.realpath(folder)
    linked: set[str] = set()

    def is_new(path: str) -> bool:
        """Links may run in circles: they are followed out of the folder only, and to one place once."""
        if not os.path.islink(path):
            return True
        target = os.path.realpath(path)
        new = target not in linked and not Path(target).is_relative_to(root)
        linked.add(target)
        return new

    def refuse(error: OSError) -> None:
        raise InputError(f"The folder {error.filename} cannot be read ({error.strerror}); give photos in folders that can be.")

    for parent, folders, files in os.walk(os.path.abspath(folder), onerror=refuse, followlinks=True):
        folders[:] = [name for name in sorted(folders) if not name.startswith(".") and is_new(os.path.join(parent, name))]
        yield from (os.path.join(parent, name) for name in files if name.lower().endswith(suffixes) and not name.startswith("."))


def require_photos(folder: Path, images: Sequence[str]) -> None:
    """Raises InputError where one of the photos is not in the folder."""
    missing = next((folder / image for image in images if not (folder / image).is_file()), None)
    if missing is not None:
        raise InputError(f"{missing} does not exist; check the path.")


def require_distinct_stems(photos: Sequence[PhotoRef]) -> None:
    """Raises InputError where two photos differ in their suffix alone: what is written of each would have one name."""
    seen: dict[Path, str] = {}
    for photo in photos:
        stem = Path(photo.name).with_suffix("")
        other = seen.setdefault(stem, photo.name)
        if other != photo.name:
            raise InputError(f"Photos with names of their own were expected, found {other} and {photo.name}; rename one of them.")


def _natural(name: str) -> tuple[list[tuple[str, int]], str]:
    pieces = re.findall(r"([^0-9]*)([0-9]*)", name.lower())
    return [(text, int(digits or -1)) for text, digits in pieces], name


def photos_at_once(photos: Sequence[Photo], bytes_per_pixel: int) -> int:
    """How many photos can be worked on at a time where each takes so many bytes for a pixel; one at least."""
    available, most = available_bytes(), max((_pixels(photo) for photo in photos), default=0)
    if available is None or not most:
        return len(photos)
    return max(1, int(_SHARE * available / (bytes_per_pixel * most)))


def _pixels(photo: Photo) -> int:
    """Of one photo; 0 where its first bytes do not say."""
    if isinstance(photo, PhotoArray):
        return photo.pixels.shape[0] * photo.pixels.shape[1]
    try:
        size = size_of_photo(start_of_photo(photo.path))
    except InputError:
        return 0
    return 0 if size is None or size[0] * size[1] > MOST_PIXELS else size[0] * size[1]


@typed
def write_png(path: Path, photo: UInt8[np.ndarray, "h w *channels"] | UInt16[np.ndarray, "h w *channels"]) -> None:
    """Write a photo of 8 or 16 bits; encoded in memory, since cv2.imwrite only says false where a disk is full or a name is not
    ASCII."""
    encoded = cv2.imencode(".png", photo)[1]
    write_atomically(path, encoded.tobytes())
