"""What photos were found to show, kept from one run to the next: an interrupted run goes on where it was stopped."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from camera_models import InputError
from camera_models.formats.disk import read_bytes
from omnilines.files import Photo, PhotoRef
from omnilines.files.fingerprint import revision
from omnilines.files.folders import output_folder, work_folder
from omnilines.files.kept import read_kept, write_kept
from omnilines.pipelines.batches import look_at
from omnilines.progress import ProgressCallback, on_all_cores

T = TypeVar("T")
R = TypeVar("R")
Item = TypeVar("Item", contravariant=True)


@runtime_checkable
class Kept(Protocol[Item, R]):
    """Results in files."""

    def known(self, item: Item) -> tuple[str | None, R | None]:
        """What the result of an item is kept by, None where none is kept, and the result, where it is there."""

    def write(self, inputs: str | None, result: R) -> None:
        """Keep a result by what `known` said."""


def look_at_rest(
    work: Callable[[T], R],
    items: Sequence[T],
    photos: Sequence[Photo],
    stage: str,
    kept: Kept[T, R] | None,
    *,
    executor: Executor | None,
    bytes_per_pixel: int,
    progress: ProgressCallback,
) -> list[R]:
    """`look_at`, but for results that are kept; each of the others is kept as soon as it is there."""
    if kept is None:
        return look_at(work, items, photos, stage, executor=executor, bytes_per_pixel=bytes_per_pixel, progress=progress)
    known = on_all_cores(kept.known, items, "looking for what is kept", progress)
    found = {k: result for k, (_, result) in enumerate(known) if result is not None}
    places = [k for k in range(len(items)) if k not in found]

    def keep(place: int, result: R) -> None:
        kept.write(known[places[place]][0], result)

    if places:
        # The first result may take long.
        progress(stage, 0, len(places))
    fresh = look_at(
        work,
        [items[k] for k in places],
        [photos[k] for k in places],
        stage,
        executor=executor,
        bytes_per_pixel=bytes_per_pixel,
        progress=progress,
        keep=keep,
    )
    found |= dict(zip(places, fresh, strict=True))
    return [found[k] for k in range(len(items))]


def kept_folder(work: str | Path, name: str) -> Path:
    """A folder within the one for what a run keeps; both are made. Raises InputError as `work_folder` does."""
    return output_folder(work_folder(work) / name)


def kept_arrays(folder: Path, inputs: str | None) -> dict[str, np.ndarray] | None:
    """What is kept by these inputs; None where nothing is."""
    return None if inputs is None else read_kept(folder / f"{inputs}.npz", inputs)


def keep_arrays(folder: Path, inputs: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Keep something by its inputs."""
    write_kept(folder / f"{inputs}.npz", inputs, arrays)


def inputs_of(photo: Photo, asked: str, *made_by: str) -> str | None:
    """A fingerprint of all that the result of a photo depends on: its pixels, its mask, what is `asked`, and the sources of
    packages and modules; None of those that cannot be read."""
    try:
        what = hashlib.sha256(_pixels_of(photo))
        if photo.mask is not None:
            what.update(read_bytes(photo.mask) if isinstance(photo.mask, Path) else np.packbits(photo.mask).tobytes())
    except InputError:
        return None
    what.update(f"{revision(*made_by)} {asked}".encode())
    return what.hexdigest()[:32]


def _pixels_of(photo: Photo) -> bytes:
    if isinstance(photo, PhotoRef):
        return read_bytes(photo.path)
    return f"{photo.pixels.dtype} {photo.pixels.shape} ".encode() + photo.pixels.tobytes()
