"""The corners of targets in photos of several cameras: what `detect_rig` returns, also made of a table."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from calib_patterns import Pattern
from camera_models import InputError
from camera_models.typed import typed
from camera_models.wording import listed
from omnilines.calibration.numbering import Numbering
from omnilines.files import write_corners
from omnilines.files.sets import claimed
from omnilines.pipelines.photo_corners import CORNERS, IN_MEMORY, PhotoCorners, require_once
from omnilines.posing.instant_names import frame_of
from omnilines.records import Corners, ViewResult

SHOWN_NAMES = 5
"""Photos without a partner are listed up to this number."""


@dataclass(frozen=True)
class CameraCorners:
    """What was found of one pattern in the photos of one camera."""

    camera: str
    found: PhotoCorners

    @property
    def pattern(self) -> Pattern:
        """The target that was looked for."""
        assert self.found.pattern is not None
        return self.found.pattern


@dataclass(frozen=True)
class RigCorners:
    """Corners of a rig, and what is known beside them, so that the rig can lead to more of them."""

    corners: Corners
    image_sizes: Mapping[str, tuple[int, int]]
    """Of every camera with corners."""
    numberings: Mapping[str, Numbering] | None = None
    """Of each board, where the pattern is known."""
    seen_from_front: bool = False
    photo_folder: Path | None = None
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What they were made from, for the provenance of results."""
    skipped: tuple[ViewResult, ...] = ()
    notes: tuple[str, ...] = ()
    blind: Mapping[str, str] = field(default_factory=dict)
    """Cameras in whose photos nothing was found, and why."""
    cameras: tuple[CameraCorners, ...] = ()
    """One by one; none where the corners are from a table."""
    times_s: Mapping[str, float] = field(default_factory=dict)
    """When photos were taken, by name and by the clock of each camera, as far as that is known."""

    def __repr__(self) -> str:
        return f"RigCorners({', '.join(self.image_sizes)}, {self.corners}, skipped={len(self.skipped)})"

    @staticmethod
    def of_table(
        corners: Corners,
        image_sizes: Mapping[str, tuple[int, int]],
        source: str | Path = IN_MEMORY,
        photo_folder: Path | None = None,
    ) -> "RigCorners":
        """Corners of a table; `image_sizes` by camera, "" standing for all others; `source` is named in errors and in the
        provenance.

        Without frames the instant is the view, where two cameras have views of one name, and else the name of the photo as in
        folders. Raises InputError where the table names no cameras, a size is missing, a view has a corner twice or a corner lies
        outside the image.
        """
        cameras = corners.cameras or ()
        if not cameras:
            raise InputError(f"{source}: the camera of every view was expected, found none; name them, or calibrate one camera.")
        require_all_named("`image_size`", image_sizes, tuple(dict.fromkeys(cameras)))
        sizes = {name: image_sizes.get(name, image_sizes.get("")) for name in dict.fromkeys(cameras)}
        found = {name: size for name, size in sizes.items() if size is not None}
        missing = [name for name in sizes if name not in found]
        if missing:
            raise InputError(
                f"`image_size` was expected for every camera of {source}, found none for '{missing[0]}'; give one for all, or "
                f"{missing[0]}=WIDTHxHEIGHT."
            )
        require_once(corners, source)
        _require_inside(corners, cameras, found, source)
        frames = corners.frames or _frames(corners, cameras)
        return RigCorners(replace(corners, frames=frames), found, photo_folder=photo_folder, inputs={"corners": source})

    @property
    def remarks(self) -> dict[str, str]:
        """What a person should know of single photos that are used all the same: blur."""
        views = [(item.found.corners.view_names, item.found.remarks) for item in self.cameras]
        return {name: remark for names, own in views for name, remark in zip(names, own, strict=True) if remark}

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write `corners.csv` into a folder, which is made if absent; returns the files."""
        with claimed(folder, [CORNERS], by="detect") as out:
            write_corners(out / CORNERS, self.corners)
        return (out / CORNERS,)


def require_all_named(option: str, given: Mapping[str, Any], cameras: Collection[str]) -> None:
    """Raises InputError where a value by camera is of none of these, or that for all others, under "", is of no other."""
    unknown = [name for name in given if name and name not in cameras]
    if unknown:
        raise InputError(f"{option}: cameras among {listed(cameras)} were expected, found '{unknown[0]}'; correct the name.")
    if "" in given and not set(cameras) - set(given):
        raise InputError(f"{option}: a value for other cameras was given, found all of them named; leave it out.")


def _require_inside(corners: Corners, cameras: Sequence[str], sizes: Mapping[str, tuple[int, int]], source: str | Path) -> None:
    limit = np.array([sizes[name] for name in cameras])[corners.view] - 0.5
    outside = ((corners.pixels < -0.5) | (corners.pixels > limit)).any(-1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        view, (u, v) = int(corners.view[row]), corners.pixels[row]
        width, height = sizes[cameras[view]]
        raise InputError(
            f"{source}: every corner was expected inside the image of {width}x{height} px of {cameras[view]}, found ({u:g}, "
            f"{v:g}) in view {corners.view_names[view]}; check `image_size` (width x height)."
        )


def _frames(corners: Corners, cameras: Sequence[str]) -> tuple[str, ...]:
    """The instant of every view by its name."""
    seen = Counter({(camera, name): 1 for camera, name in zip(cameras, corners.view_names, strict=True)})
    common = max(Counter(name for _, name in seen).values()) > 1
    names = [PurePosixPath(image) for image in corners.images]
    return corners.view_names if common else tuple(frame_of(n) if len(n.parts) > 1 else n.stem for n in names)
