"""Masks: where photos are looked at. What is wholly transparent in a photo shows nothing, and is left out as by a mask.

One image for all photos, or a folder in which a photo has a mask of its own, or a camera one for all of its photos. Of the photo
`cam0/a.jpg` the mask is the first that is there of

    cam0/a.jpg.png    as COLMAP has it
    cam0/a.jpg        of the same name
    cam0/a.png        of the same name but for the ending
    cam0.png          of the folder of the photo, a camera of a rig
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool

from camera_models.errors import InputError
from camera_models.wording import listed
from omnilines.files.photos import PHOTO_SUFFIXES, Photo, PhotoRef
from omnilines.photo_file import opaque_pixels, read_photo

Mask: TypeAlias = Bool[np.ndarray, "h w"] | str | Path | Mapping[str, Any]
"""What a user may give: where all photos are looked at, an image or a folder of images that are white there, or by the names of
photos."""
ENDING = ".png"
Kind = TypeVar("Kind", bound=Photo)


def with_masks(photos: Sequence[Kind], mask: Mask | None) -> list[Kind]:
    """The photos, each with its mask, where there is one. Of a folder that holds photos too, masks are no photos.

    Raises InputError where a mask for all is one of the photos or is white nowhere, and where a folder has a mask for no photo.
    """
    if mask is None:
        return list(photos)
    if isinstance(mask, Mapping):
        known = {name: _array(name, one) for name, one in mask.items()}
        strange = next((name for name in known if name not in {photo.name for photo in photos}), None)
        if strange is not None:
            raise InputError(
                f"Masks were expected under names of photos ({listed([photo.name for photo in photos])}), found {strange}; "
                "correct the name."
            )
        return [replace(photo, mask=known.get(photo.name, photo.mask)) for photo in photos]
    if isinstance(mask, str | Path) and Path(mask).is_dir():
        return _of_folder(photos, Path(mask))
    keep = _of_all(mask, photos)
    return [replace(photo, mask=keep) for photo in photos]


def check_masks(photos: Sequence[Photo], sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raises InputError where a mask that all photos have has not the size of every camera; `sizes` (width, height) are those
    of the photos, by name. A mask of its own is looked at with its photo."""
    first, masks = photos[0].mask, {photo.mask if isinstance(photo.mask, Path) else id(photo.mask) for photo in photos}
    if first is None or len(masks) > 1:
        return
    named = f"The mask {first}" if isinstance(first, Path) else "A mask"
    keep = white(first) if isinstance(first, Path) else first
    for width, height in dict.fromkeys(sizes[photo.name] for photo in photos):
        if keep.shape != (height, width):
            raise InputError(
                f"{named} of {width}x{height} px was expected, as the camera has, found {keep.shape[1]}x{keep.shape[0]} px; give "
                "one of that size."
            )


def looked_at(photo: Photo, size: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
    """Where a photo of this size (width, height) is looked at: where its mask is true and it is not wholly transparent; None
    where that is everywhere. Raises InputError where its mask cannot be read, is white nowhere or has another size, and where all
    of it is transparent."""
    keep = white(photo.mask) if isinstance(photo.mask, Path) else photo.mask
    shown = _opaque(photo)
    for what, area in (("mask", keep), ("transparency", shown)):
        if area is not None and area.shape[::-1] != size:
            raise InputError(f"Its {what} has {area.shape[1]}x{area.shape[0]} px, where the photo has {size[0]}x{size[1]}.")
    areas = [area for area in (keep, shown) if area is not None]
    return np.logical_and.reduce(areas) if areas else None


def _opaque(photo: Photo) -> Bool[np.ndarray, "h w"] | None:
    """Where a photo shows anything, upright; None where that is everywhere. Raises InputError where it is nowhere."""
    opaque = opaque_pixels(photo.path) if isinstance(photo, PhotoRef) else None
    if opaque is None:
        return None
    if not opaque.any():
        raise InputError("It was expected to show something, found every pixel transparent; give it without transparency.")
    return opaque


def white(path: Path) -> Bool[np.ndarray, "h w"]:
    """Where an image is white; raises InputError where it is nowhere."""
    image = read_photo(path)
    bright = image if image.ndim == 2 else image.max(-1)
    most = np.iinfo(image.dtype).max
    keep: Bool[np.ndarray, "h w"] = bright > most // 2
    if not keep.any():
        raise InputError(
            f"The mask {path} was expected to be white (above {most // 2} of {most}) where to look, found nothing brighter than "
            f"{bright.max()}; draw white what counts."
        )
    return keep


def mask_files(photos: Sequence[Photo]) -> list[Path]:
    """The images of masks, each once."""
    return list(dict.fromkeys(photo.mask for photo in photos if isinstance(photo.mask, Path)))


def masks_note(photos: Sequence[Photo]) -> tuple[str, ...]:
    """That some photos have a mask and others have none."""
    without = [photo.name for photo in photos if photo.mask is None]
    if not without or len(without) == len(photos):
        return ()
    return (f"{len(without)} of {len(photos)} photos have no mask and are looked at as a whole, such as {without[0]}.",)


def _of_folder(photos: Sequence[Kind], folder: Path) -> list[Kind]:
    own = [os.path.realpath(photo.path) if isinstance(photo, PhotoRef) else "" for photo in photos]
    found = [
        next((path for path in _places(folder, photo.name) if path.is_file() and os.path.realpath(path) != real), None)
        for photo, real in zip(photos, own, strict=True)
    ]
    masks = {os.path.realpath(path) for path in found if path is not None}
    if not masks:
        first = photos[0].name
        raise InputError(
            f"Masks were expected in {folder} under the names of photos, such as {first}{ENDING} or "
            f"{PurePosixPath(first).with_suffix(ENDING)}, found none for any of {len(photos)}; name them so, or give one image "
            "for all."
        )
    return [
        replace(photo, mask=path) for photo, path, real in zip(photos, found, own, strict=True) if not real or real not in masks
    ]


def _places(folder: Path, name: str) -> Iterator[Path]:
    """Where the mask of a photo may lie."""
    photo = PurePosixPath(name)
    yield folder / f"{name}{ENDING}"
    yield folder / name
    yield folder / photo.with_suffix(ENDING)
    yield from (folder / f"{parent}{ENDING}" for parent in photo.parents if parent != PurePosixPath("."))


def _of_all(mask: Bool[np.ndarray, "h w"] | str | Path, photos: Sequence[Photo]) -> Path | Bool[np.ndarray, "h w"]:
    if isinstance(mask, np.ndarray):
        if not mask.any():
            raise InputError("A mask was expected to be true where photos are looked at, found it false everywhere; correct it.")
        return mask
    path = Path(mask)
    if path.suffix.lower() not in PHOTO_SUFFIXES or not path.is_file():
        there = "which is none" if path.exists() else "which does not exist"
        kinds = " ".join(PHOTO_SUFFIXES)
        raise InputError(
            f"A mask was expected as an image ({kinds}) or a folder of them, found {path}, {there}; correct the path."
        )
    white(path)
    if os.path.realpath(path) in {os.path.realpath(photo.path) for photo in photos if isinstance(photo, PhotoRef)}:
        raise InputError(f"The mask {path} was expected apart from the photos, found it among them; keep it in another folder.")
    return path


def _array(name: str, mask: Any) -> Bool[np.ndarray, "h w"]:
    array = np.asarray(mask)
    if array.dtype != bool or array.ndim != 2 or not array.any():
        raise InputError(
            f"The mask of {name} was expected as an array (h, w) of truth values, true where to look, found {array.shape} of "
            f"{array.dtype}{'' if array.dtype != bool else ', false everywhere'}; correct it."
        )
    return array
