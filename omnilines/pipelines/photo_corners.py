"""The corners of a target in photos of one camera: what `detect` returns, also made of a table."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns.sharpness import blur_remarks
from camera_models import InputError
from camera_models.typed import typed
from omnilines.files import Photo, write_corners
from omnilines.files.sets import claimed
from omnilines.records import Corners, ViewResult

CORNERS = "corners.csv"
IN_MEMORY = "in memory"
"""In the place of a file in the provenance."""


@dataclass(frozen=True)
class PhotoCorners:
    """Corners found in a set of photos of one camera, and with what, so that the camera can lead to more of them."""

    corners: Corners
    image_size: tuple[int, int]
    skipped: tuple[ViewResult, ...] = ()
    """Photos without corners, each with its reason."""
    photo_folder: Path | None = None
    """Which the names of the photos are relative to, where they are files."""
    blur_px: Float[np.ndarray, "n 2"] | None = None
    """Blur of both edges of each corner (`Detection.blur_px`), rows as in `corners`; None where it is not known."""
    photos: tuple[Photo, ...] = ()
    """Those that were looked through; none where the corners are from a table."""
    pattern: Pattern | None = None
    mirrored: bool = False
    """Whether the photos were taken for mirror images."""
    options: DetectionOptions = DetectionOptions()
    """With which they were found, and more of them are."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What they were made from, for the provenance of results."""
    recognised: str | None = None
    """What the photos show of the print of the target that was not given."""
    other: str | None = None
    """What most photos show in place of the target, one sentence, where that was seen."""
    work: Path | None = None
    """The folder in which what is found is kept."""

    def __repr__(self) -> str:
        return f"PhotoCorners({self.corners}, skipped={len(self.skipped)})"

    @staticmethod
    def of_table(
        corners: Corners, image_size: tuple[int, int], source: str | Path = IN_MEMORY, photo_folder: Path | None = None
    ) -> "PhotoCorners":
        """Corners of a table; `source` is named in errors and in the provenance. Raises InputError where a corner lies outside
        the image, or a view has one of the board twice."""
        require_once(corners, source)
        outside = ((corners.pixels < -0.5) | (corners.pixels > np.array(image_size) - 0.5)).any(-1)
        if outside.any():
            row = int(np.flatnonzero(outside)[0])
            u, v = corners.pixels[row]
            raise InputError(
                f"{source}: every corner was expected inside the image of {image_size[0]}x{image_size[1]} px, found "
                f"({u:g}, {v:g}) in view {corners.view_names[corners.view[row]]}; check `image_size` (width x height)."
            )
        return PhotoCorners(corners, image_size, photo_folder=photo_folder, inputs={"corners": source})

    @staticmethod
    def of_detections(
        seen: Sequence[tuple[Photo, Detection]],
        image_size: tuple[int, int],
        pattern: Pattern,
        folder: Path | None,
        *,
        mirrored: bool = False,
        options: DetectionOptions = DetectionOptions(),
    ) -> "PhotoCorners":
        """Of photos in a folder and what was found in each of them."""
        inputs = {"photos": IN_MEMORY if folder is None else folder, "pattern": pattern.specification}
        photos = tuple(photo for photo, _ in seen)
        table, blur = corner_table([(photo.name, found) for photo, found in seen], pattern), blur_of_corners(seen)
        return PhotoCorners(table, image_size, (), folder, blur, photos, pattern, mirrored, options, inputs)

    @property
    def remarks(self) -> tuple[str | None, ...]:
        """Of each view of `corners` what a person should know of its photo, one sentence, or None."""
        views = len(self.corners.images)
        if self.blur_px is None:
            return (None,) * views
        return blur_remarks(self.corners.view, self.blur_px, views, self.options)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of all photos together."""
        remark = None if self.pattern is None else counts_remark(self.pattern, self.corners)
        return tuple(note for note in (self.recognised, remark, self.other) if note)

    def detection(self, name: str) -> Detection:
        """The corners of the photo of that name, none where it was skipped."""
        corners = self.corners
        if name not in corners.view_names or corners.ids is None:
            return Detection.empty()
        rows = corners.view == corners.view_names.index(name)
        sigma_px = np.ones(len(corners)) if corners.sigma_px is None else corners.sigma_px
        blur_px = None if self.blur_px is None else self.blur_px[rows]
        return Detection(corners.ids[rows], corners.pixels[rows], sigma_px[rows], blur_px)

    def updated(self, better: Mapping[str, Detection]) -> "PhotoCorners":
        """With other corners for the photos named, of which those skipped before are views then."""
        assert self.pattern is not None
        kept = [(photo, better.get(photo.name, self.detection(photo.name))) for photo in self.photos]
        kept = [(photo, detection) for photo, detection in kept if len(detection)]
        seen = {photo.name for photo, _ in kept}
        skipped = tuple(view for view in self.skipped if view.name not in seen)
        return replace(
            self,
            corners=corner_table([(photo.name, seen) for photo, seen in kept], self.pattern),
            skipped=skipped,
            blur_px=blur_of_corners(kept),
        )

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `corners.csv` into a folder, which is made if absent; returns the files."""
        with claimed(folder, [CORNERS], by="detect") as out:
            write_corners(out / CORNERS, self.corners)
        return (out / CORNERS,)


def require_once(corners: Corners, source: str | Path) -> None:
    """Raises InputError where a view has a corner of the board twice; `source` is named."""
    rows = np.column_stack([corners.view, corners.board_m])
    _, first = np.unique(rows, axis=0, return_index=True)
    if len(first) < len(corners):
        row = int(np.setdiff1d(np.arange(len(corners)), first)[0])
        raise InputError(
            f"{source}: each corner of the board was expected once in a view, found one of view "
            f"{corners.view_names[corners.view[row]]} again in row {row}; remove one of the two."
        )


def counts_remark(pattern: Pattern, corners: Corners) -> str | None:
    """What tells of a wrong count of corners: three photos or more of which most show the same smaller grid, the others less; or
    nearly all show it, as a corner beside the board may be taken for one of it."""
    grid = pattern.plain_grid
    if grid is None or corners.ids is None or len(corners.images) < 3:
        return None
    extents = Counter(
        (int(np.ptp(ids % grid.columns)) + 1, int(np.ptp(ids // grid.columns)) + 1)
        for ids in np.split(corners.ids, np.flatnonzero(np.diff(corners.view)) + 1)
    )
    photos, usual = len(corners.images), max(extents, key=lambda extent: extents[extent])
    largest = max(extents, key=lambda extent: (max(extent) * min(extent), extents[extent]))
    most = usual if 4 * extents[usual] > 3 * photos else largest
    count = sum(number for extent, number in extents.items() if sorted(extent) == sorted(most))
    if 2 * count <= photos or sorted(most) == sorted((grid.columns, grid.rows)):
        return None
    seen, asked = "{}x{}".format(*most), f"{grid.columns}x{grid.rows}"
    return (
        f"{'All' if count == photos else f'{count} of'} {photos} photos show {seen} inner corners of a board of {asked}: if that "
        f"is the whole board, give {pattern.NAME}:{seen} with its square."
    )


def blur_of_corners(kept: Sequence[tuple[Photo, Detection]]) -> Float[np.ndarray, "n 2"] | None:
    """Of all corners of the photos in one table; None where it is not known of every photo."""
    blurs = [detection.blur_px for _, detection in kept if detection.blur_px is not None]
    return np.concatenate(blurs) if len(blurs) == len(kept) else None


def corner_table(kept: Sequence[tuple[str, Detection]], pattern: Pattern) -> Corners:
    """The corners seen in photos, which are given by their names."""
    names = tuple(name for name, _ in kept)
    ids = np.concatenate([d.ids for _, d in kept])
    view = np.repeat(np.arange(len(kept)), [len(d) for _, d in kept])
    pixels: Float[np.ndarray, "n 2"] = np.concatenate([d.pixels for _, d in kept])
    sigma: Float[np.ndarray, " n"] = np.concatenate([d.sigma_px for _, d in kept])
    return Corners(view, names, names, pattern.points_m[ids], pixels, sigma, ids)
