"""Arcs found in photos: what `extract` returns, and the forms in which the stages after it take them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration, GeometryError, InputError
from camera_models.typed import typed
from camera_models.wording import listed
from omnilines.files import Photo, write_segments
from omnilines.files.sets import claimed
from omnilines.matching.arcs import ViewedArcs
from omnilines.progress import on_all_cores, silent
from omnilines.provenance import provenance
from omnilines.records import Detail, ImagePoses, Segments

SEGMENTS = "segments.csv"


@dataclass(frozen=True)
class FoundArcs:
    """The arcs of one photo, the longest first."""

    photo: Photo
    camera: str
    endpoints_px: Float[np.ndarray, "n 2 2"]
    """(row, end, (u, v))."""
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    """Of each end point."""
    length_px: Float[np.ndarray, " n"]
    colours: Float[np.ndarray, "n 2 3"]
    """Logarithms of the colours on both sides (`side_colours`); NaN where not known."""
    reason: str | None = None
    """Why the photo was skipped, one sentence."""
    looked_at: float = 1.0
    """The share of its pixels that a mask, or transparency, leaves to look at."""

    def __repr__(self) -> str:
        return f"FoundArcs({self.photo.name!r}, arcs={len(self)})"

    def __len__(self) -> int:
        return len(self.length_px)


@dataclass(frozen=True)
class PhotoArcs:
    """Arcs of a set of photos, for `estimate_poses` and `reconstruct`."""

    photos: tuple[FoundArcs, ...]
    """Of every photo, those that were skipped included."""
    cameras: Calibration
    notes: tuple[str, ...] = ()
    """What a person should know of how they came about, one sentence each."""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """What they were made from."""

    def __repr__(self) -> str:
        return f"PhotoArcs(photos={len(self.used)} of {len(self.photos)}, arcs={len(self)})"

    def __len__(self) -> int:
        return sum(map(len, self.photos))

    @property
    def used(self) -> tuple[FoundArcs, ...]:
        """The photos that can be used."""
        return tuple(arcs for arcs in self.photos if arcs.reason is None)

    @property
    def skipped(self) -> dict[str, str]:
        """Why each of the other photos cannot, by name."""
        return {arcs.photo.name: arcs.reason for arcs in self.photos if arcs.reason is not None}

    @property
    def skipped_details(self) -> tuple[Detail, ...]:
        """`skipped` as sentences."""
        return tuple(Detail(name, f"{name} is skipped: {reason}") for name, reason in self.skipped.items())

    @property
    def camera_of(self) -> dict[str, str]:
        """The camera of each photo, by name."""
        return {arcs.photo.name: arcs.camera for arcs in self.photos}

    @property
    def segments(self) -> Segments:
        """All arcs as a table of segments without tracks."""
        return segments_of(self.used)

    @property
    def provenance(self) -> dict[str, Any]:
        """Software, and what the arcs were made from."""
        return provenance(self.inputs)

    @typed
    def save(self, folder: str | Path) -> tuple[Path, ...]:
        """Write segments.csv into a folder, which is made; the files written."""
        with claimed(folder, [SEGMENTS], by="extract") as out:
            write_segments(out / SEGMENTS, self.segments)
        return (out / SEGMENTS,)


def require_cameras_of(arcs: PhotoArcs, cameras: Calibration) -> None:
    """Raises InputError where the calibration lacks a camera that the arcs are of."""
    used = dict.fromkeys(one.camera for one in arcs.photos)
    if any(name not in cameras for name in used):
        raise InputError(
            f"A calibration of the cameras that the arcs are of ({listed(used)}) was expected, found one of {listed(cameras)}; "
            "give the whole calibration that they were extracted with."
        )


def in_order(found: Sequence[FoundArcs], poses: ImagePoses) -> list[FoundArcs]:
    """The photos that have arcs and a pose, in the order of the poses."""
    place = {name: k for k, name in enumerate(poses.images)}
    posed = (arcs for arcs in found if arcs.reason is None and arcs.photo.name in place)
    return sorted(posed, key=lambda arcs: place[arcs.photo.name])


def viewed_arcs(found: Sequence[FoundArcs], poses: ImagePoses, cameras: Calibration) -> ViewedArcs:
    """The arcs of all photos that have a pose as bearings, photos in the order of their poses, as matching uses them.

    Raises GeometryError where there are none.
    """
    found = in_order(found, poses)
    if not sum(map(len, found)):
        raise GeometryError(
            f"Arcs of straight lines were expected, found none in {len(found)} photos with poses; see their pictures."
        )
    place = {name: k for k, name in enumerate(poses.images)}

    def seen(arcs: FoundArcs) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 3 2"]]:
        """The ends of the arcs of one photo as bearings, with their derivatives."""
        ends = torch.as_tensor(arcs.endpoints_px)
        with torch.no_grad():
            return cameras[arcs.camera].unproject(ends)[0].numpy(), cameras[arcs.camera].unproject_jacobian(ends).numpy()

    bearings, by_pixel = zip(*on_all_cores(seen, found, "", silent), strict=True)
    return ViewedArcs(
        np.repeat(np.array([place[arcs.photo.name] for arcs in found], dtype=np.int64), [len(arcs) for arcs in found]),
        poses.cam_from_world,
        np.concatenate(bearings),
        np.concatenate(by_pixel),
        np.concatenate([arcs.covariance_px2 for arcs in found]),
        np.concatenate([arcs.colours for arcs in found]),
    )


def segments_of(found: Sequence[FoundArcs]) -> Segments:
    """Arcs of photos as a table of segments without tracks."""
    pixels = np.concatenate([arcs.endpoints_px for arcs in found])
    return Segments(
        np.repeat(np.arange(len(found)), [len(arcs) for arcs in found]),
        tuple(arcs.photo.name for arcs in found),
        np.full(len(pixels), -1),
        (),
        pixels,
        covariance_px2=np.concatenate([arcs.covariance_px2 for arcs in found]),
        cameras=tuple(arcs.camera for arcs in found),
    )
