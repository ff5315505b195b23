"""Chains of edge points of many photos of one camera, without its calibration: `chains_of`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_models import InputError
from omnilines.extraction.options import SmoothChainOptions
from omnilines.extraction.smooth_chains import SmoothChains, smooth_chains
from omnilines.files import Photo, Photos, of_one_range, photos_of
from omnilines.files.masks import Mask, looked_at, with_masks
from omnilines.files.orientation import turned_otherwise
from omnilines.geometry.chains import Chains
from omnilines.pipelines.arcs import BYTES_PER_PIXEL, none_usable
from omnilines.pipelines.copies import copies
from omnilines.pipelines.kept_chains import KeptSmoothChains, Smooth
from omnilines.pipelines.kept_results import look_at_rest
from omnilines.progress import ProgressCallback, silent
from omnilines.records import Detail


@dataclass(frozen=True)
class PhotoChains:
    """What `chains_of` finds."""

    chains: Chains
    circle: tuple[float, float, float] | None
    """Centre (u, v) and radius (px) of the image circle: medians over the photos that show one; None where fewer than half do."""
    skipped: tuple[Detail, ...]
    """Photos that are left out, and why."""


def chains_of(
    photos: Photos,
    *,
    mask: Mask | None = None,
    options: SmoothChainOptions = SmoothChainOptions(),
    work: str | Path | None = None,
    progress: ProgressCallback = silent,
) -> PhotoChains:
    """The smooth curves of edge points in photos of one camera (a folder, files, or arrays), on all cores, one photo
    per core in memory. Photos are looked at where `mask` says, as in `extract`. Photos that cannot be read, and those of another
    size, or turned otherwise by EXIF, than most, and copies, are left out. The curves of each photo are kept in the folder
    `work`, where one is given.

    Raises InputError where there is no photo, none can be used, or masks do not belong to the photos.
    """
    refs = of_one_range(with_masks(photos_of(photos), mask), progress)
    turned = turned_otherwise(refs)

    def look(item: tuple[Photo, str | None]) -> Smooth:
        """Size and chains of one photo, or why it has none."""
        photo, left_out = item
        if left_out is not None:
            return left_out
        try:
            image = photo.read()
            size = (image.shape[1], image.shape[0])
            return size, smooth_chains(image, looked_at(photo, size), options)
        except InputError as error:
            return str(error)

    found = look_at_rest(
        look,
        [(photo, turned.get(photo.name)) for photo in refs],
        refs,
        "following edges",
        None if work is None else KeptSmoothChains.within(work, options.stated),
        executor=None,
        bytes_per_pixel=BYTES_PER_PIXEL,
        progress=progress,
    )
    empty = np.zeros((0, 2))
    alike = copies([photo.name for photo in refs], [empty if isinstance(one, str) else one[1].pixels for one in found])
    found = [one if why is None else why for one, why in zip(found, alike, strict=True)]
    sizes = Counter(one[0] for one in found if not isinstance(one, str))
    if not sizes:
        raise none_usable([str(one) for one in found], "photos")
    size = sizes.most_common(1)[0][0]
    used, left_out = list[tuple[str, SmoothChains]](), list[Detail]()
    for photo, one in zip(refs, found, strict=True):
        if isinstance(one, str):
            left_out.append(Detail(photo.name, f"{photo.name} is skipped: {one}"))
        elif one[0] != size:
            said = f"{one[0][0]}x{one[0][1]} px is not the size of most photos, {size[0]}x{size[1]} px."
            left_out.append(Detail(photo.name, f"{photo.name} is skipped: {said}"))
        else:
            used.append((photo.name, one[1]))
    circles = [one.circle for _, one in used if one.circle is not None]
    circle = None
    if 2 * len(circles) >= len(used):
        u, v, radius = np.median(circles, axis=0).tolist()
        circle = (u, v, radius)
    return PhotoChains(joined_chains(used, size), circle, tuple(left_out))


def joined_chains(photos: Sequence[tuple[str, SmoothChains | Chains]], size: tuple[int, int]) -> Chains:
    """The chains of photos of one size, by their names, as one table."""
    counts = [one.count for _, one in photos]
    first = np.cumsum([0, *counts])
    return Chains(
        tuple(name for name, _ in photos),
        size,
        np.repeat(np.arange(len(photos)), counts),
        np.concatenate([one.chain + before for before, (_, one) in zip(first[:-1], photos, strict=True)]),
        *(np.concatenate([getattr(one, name) for _, one in photos]) for name in ("pixels", "normals", "sigma_px")),
    )
