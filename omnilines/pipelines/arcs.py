"""Arcs of many photos and the colours beside them, for lines: `extract`."""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from camera_models import Calibration, CameraEstimate, CameraModel, InputError
from camera_models.formats.camera_check import check_cameras
from camera_models.typed import typed
from camera_models.wording import listed
from omnilines.extraction import ExtractionOptions, extract_arcs
from omnilines.extraction.compressed import coarse_jpegs_note
from omnilines.extraction.extract import EVERYWHERE
from omnilines.files import Photo, PhotoRef, Photos, of_one_range, photo_folder, photos_of
from omnilines.files.masks import Mask, check_masks, looked_at, masks_note, with_masks
from omnilines.files.orientation import by_camera
from omnilines.matching.appearance import side_colours
from omnilines.matching.options import AppearanceOptions
from omnilines.options import require_ranges
from omnilines.photo_file import start_of_photo
from omnilines.photo_size import jpeg_quality
from omnilines.pipelines.kept_results import inputs_of, keep_arrays, kept_arrays, kept_folder, look_at_rest
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.progress import ProgressCallback, silent

SHORT_ARCS = ExtractionOptions(min_length_px=10.0)
"""Shorter arcs than by default are used for lines: other photos confirm them or not."""
MADE_BY = (
    "camera_models",
    "omnilines.extraction",
    "omnilines.geometry",
    "omnilines.matching",
    "omnilines.photo_file",
    "omnilines.photo_size",
    "omnilines.files.masks",
    __name__,
)
"""Whose source decides what the arcs of a photo are."""
BYTES_PER_PIXEL = 80
"""Of a photo being looked through, measured on one full of edges."""
_ARRAYS = ("endpoints_px", "covariance_px2", "length_px", "colours", "looked_at")


@typed
def extract(
    photos: Photos,
    camera: CameraModel | Calibration,
    *,
    camera_of: Mapping[str, str] | None = None,
    mask: Mask | None = None,
    options: ExtractionOptions = SHORT_ARCS,
    appearance: AppearanceOptions = AppearanceOptions(),
    work: str | Path | None = None,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> PhotoArcs:
    """The arcs of straight lines in photos (a folder, files, or arrays), on all cores, one photo per core in memory,
    or by the workers of an `executor`.

    Of a calibration of several cameras, a photo is of the one whose name a folder of its path has, or that `camera_of` has under
    the photo's name. `mask` is where photos are
    looked at, for arcs and for poses after that: an array that is true there, an image that is white there, a folder of such
    images (`files.masks`), or arrays by the names of photos. `appearance` is which pixels beside an arc are its colours. Arcs are
    kept in the folder `work`, where one is given, and read from there by another run that would find the same. A photo that
    cannot be read, has not the size of its camera or another EXIF orientation than its others is skipped with its reason.

    Raises InputError where there is no photo, none can be used, masks do not belong to the photos, or an option is beyond reason.

        >>> arcs = ol.extract("room/", ol.load("room/calibration.yaml"))
        >>> len(arcs.photos), arcs.skipped
        (6, {})
        >>> arcs.segments.endpoints_px.shape[1:], arcs.segments.covariance_px2.shape[1:]
        ((2, 2), (2, 2, 2))
    """
    require_ranges(options)
    cameras = calibration_of(camera)
    refs = with_masks(photos_of(photos), mask)
    camera_of = cameras_of_photos(refs, cameras, camera_of)
    check_masks(refs, {name: cameras[camera].image_size for name, camera in camera_of.items()})
    refs = of_one_range(refs, progress)
    turned = by_camera(refs, camera_of)
    items = [_Item(photo, camera_of[photo.name], turned.get(photo.name)) for photo in refs]
    look = _Look(
        dict(cameras.cameras),
        {name: known_angles_rad(cameras.estimates.get(name)) for name in cameras},
        options,
        appearance,
    )
    kept = None if work is None else _Kept(look, kept_folder(work, "arcs"))
    found = look_at_rest(
        look,
        items,
        refs,
        "extracting arcs",
        kept,
        executor=executor,
        bytes_per_pixel=BYTES_PER_PIXEL,
        progress=progress,
    )
    every = tuple(found)
    require_any(every, "photos and calibration")
    used = [one for one in every if one.reason is None]
    notes = (*masks_note(refs), *_little_looked_at(used), *coarse_jpegs_note(_qualities(used), options))
    return PhotoArcs(every, cameras, notes, {"photos": photo_folder(refs), "extraction": options})


def _little_looked_at(found: Sequence[FoundArcs]) -> tuple[str, ...]:
    """That masks hide more of photos than they leave, as one does that is black where to look."""
    hidden = [one for one in found if one.looked_at < 0.5]
    if not hidden:
        return ()
    least = min(hidden, key=lambda one: one.looked_at)
    return (
        f"Masks hide more than half of {len(hidden)} of {len(found)} photos: of {least.photo.name} they leave "
        f"{100 * least.looked_at:.0f} percent to look at, where they are white. Invert them if that is what to leave out.",
    )


def _qualities(found: Sequence[FoundArcs]) -> dict[str, int | None]:
    """Of each photo, where it is a JPEG."""
    photos = [one.photo for one in found]
    return {photo.name: jpeg_quality(start_of_photo(photo.path)) if isinstance(photo, PhotoRef) else None for photo in photos}


def calibration_of(camera: CameraModel | Calibration) -> Calibration:
    """A camera alone as a calibration, of the name cam0. Raises InputError for anything else than one of both, and for cameras
    that see nothing, as `load` does."""
    if not isinstance(camera, CameraModel | Calibration):
        raise InputError(
            f"A camera model or a calibration was expected, found {type(camera).__name__}; give what `load` returns."
        )
    cameras = camera if isinstance(camera, Calibration) else Calibration({"cam0": camera})
    check_cameras(cameras)
    return cameras


def cameras_of_photos(photos: Sequence[Photo], cameras: Calibration, named: Mapping[str, str] | None = None) -> dict[str, str]:
    """Of each photo, by name, the only camera, or the one that a folder of its path is named like, or that is `named` for it.

    Raises InputError where neither says it, both contradict each other, or the calibration has no camera of that name.
    """
    if len(cameras) == 1:
        return dict.fromkeys((photo.name for photo in photos), next(iter(cameras)))
    found = {}
    for photo in photos:
        parent = photo.path.parent if isinstance(photo, PhotoRef) else Path(photo.name).parent
        folder = next((part for part in reversed(parent.parts) if part in cameras), None)
        told = None if named is None else named.get(photo.name)
        camera = folder if told is None else told
        if camera is None:
            raise InputError(
                f"The photo {photo.name} was expected in a folder named like one of the cameras {listed(cameras)}, or with "
                f"one in the column camera of poses.csv, found {parent}; move it, or give the calibration of its camera alone."
            )
        if camera not in cameras:
            raise InputError(
                f"The photo {photo.name} was expected to be of one of the cameras {listed(cameras)}, found the camera {camera} "
                "in the column camera; correct it, or give the calibration of that camera."
            )
        if folder not in (None, camera):
            raise InputError(
                f"The photo {photo.name} was expected to be of one camera, found {camera} in the column camera and the folder "
                f"{folder} in {parent}; correct the one that is wrong."
            )
        found[photo.name] = camera
    return found


def skipped(photo: Photo, camera: str, reason: str) -> FoundArcs:
    """A photo that cannot be used, and why."""
    none = np.zeros((0, 2, 2))
    return FoundArcs(photo, camera, none, np.zeros((0, 2, 2, 2)), np.zeros(0), np.zeros((0, 2, 3)), reason)


def require_any(found: Sequence[FoundArcs], what: str) -> None:
    """Raises InputError where every photo was skipped."""
    reasons = [arcs.reason for arcs in found if arcs.reason is not None]
    if len(reasons) == len(found):
        raise none_usable(reasons, what)


def none_usable(reasons: Sequence[str], what: str) -> InputError:
    """The error that no photo can be used, each for its reason."""
    first = reasons[0].rstrip(".")
    return InputError(f"No photo of {len(reasons)} can be used (first reason: {first}); check {what}.")


class _Item(NamedTuple):
    """One photo to be looked at."""

    photo: Photo
    camera: str
    left_out: str | None
    """Why it is not looked at."""


@dataclass(frozen=True)
class _Look:
    """What is looked for in photos, and how."""

    cameras: Mapping[str, CameraModel]
    known_rad: Mapping[str, tuple[float, float]]
    """Angles off the axis between which each camera is known."""
    options: ExtractionOptions
    appearance: AppearanceOptions

    def __call__(self, item: _Item) -> FoundArcs:
        """The arcs of one photo, or why it has none."""
        if item.left_out is not None:
            return skipped(item.photo, item.camera, item.left_out)
        model = self.cameras[item.camera]
        try:
            image = item.photo.read()
            keep = looked_at(item.photo, image.shape[1::-1])
            found = extract_arcs(image, model, keep, self.known_rad[item.camera], self.options)
            bearings, seen = model.unproject(found.endpoints_px)
            usable = seen.all(-1)
            colours = side_colours(image, model, bearings[usable], self.appearance)
        except InputError as error:
            return skipped(item.photo, item.camera, str(error))
        arrays = (found.endpoints_px[usable], found.covariance_px2[usable], found.length_px[usable], colours)
        return FoundArcs(item.photo, item.camera, *arrays, looked_at=1.0 if keep is None else float(keep.mean()))


def known_angles_rad(estimate: CameraEstimate | None) -> tuple[float, float]:
    """The angles off the axis between which a camera is known, for `extract_arcs`."""
    if estimate is None:
        return EVERYWHERE
    most = estimate.max_angle_deg
    return math.radians(estimate.min_angle_deg), math.inf if most is None else math.radians(most)


@dataclass(frozen=True)
class _Kept:
    """The arcs of photos in files, kept from one run to the next."""

    look: _Look
    folder: Path

    def known(self, item: _Item) -> tuple[str | None, FoundArcs | None]:
        """What the arcs of one photo are kept by, and they, where they are."""
        inputs = self._inputs(item)
        arrays = kept_arrays(self.folder, inputs)
        if arrays is None:
            return inputs, None
        pixels, covariance, length, colours, share = (arrays[name] for name in _ARRAYS)
        return inputs, FoundArcs(item.photo, item.camera, pixels, covariance, length, colours, looked_at=float(share))

    def write(self, inputs: str | None, arcs: FoundArcs) -> None:
        """Keep those of a photo that was looked at."""
        if inputs is not None and arcs.reason is None:
            keep_arrays(self.folder, inputs, {name: np.asarray(getattr(arcs, name)) for name in _ARRAYS})

    def _inputs(self, item: _Item) -> str | None:
        """A fingerprint of all that the arcs of a photo depend on; None where none are kept."""
        if item.left_out is not None:
            return None
        look, model = self.look, self.look.cameras[item.camera]
        camera = (model.NAME, model.image_size, model.parameters.detach().tolist(), look.known_rad[item.camera])
        asked = (camera, look.options.stated, look.appearance, item.photo.levels)
        return inputs_of(item.photo, repr(asked), *MADE_BY)
