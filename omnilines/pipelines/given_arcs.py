"""Segments that a user brings, not yet matched, in place of the arcs that we would find in the photos: `given_arcs`."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from camera_models import Calibration, CameraModel, InputError
from camera_models.typed import typed
from omnilines.extraction.arcs import steps
from omnilines.files import Photo, PhotoRef, Photos, of_one_range, photo_folder, photos_of
from omnilines.matching.appearance import side_colours
from omnilines.matching.options import AppearanceOptions
from omnilines.pipelines.arcs import calibration_of, cameras_of_photos, require_any, skipped
from omnilines.pipelines.inside import require_inside
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.records import Segments


@typed
def given_arcs(
    segments: Segments,
    photos: Photos,
    camera: CameraModel | Calibration,
    *,
    camera_of: Mapping[str, str] | None = None,
    sigma_px: float = 0.2,
    appearance: AppearanceOptions = AppearanceOptions(),
    name: str = "The table of segments",
    progress: ProgressCallback = silent,
) -> PhotoArcs:
    """The segments of every photo with the colours beside them; those with an end that the camera cannot see are left out.

    `camera_of` is as for `extract`. `sigma_px` is the standard deviation of an end where the table states none: that of a good
    detector; what is missing is found as the tolerance. `name` is what messages call the table. A photo without segments, or one
    that cannot be read, is skipped with its reason.

    Raises InputError where the table is not of these photos (`check_given`), a segment lies outside its image, or none is left.

        >>> camera = ol.load("room/calibration.yaml")
        >>> arcs = ol.given_arcs(ol.read_segments("unmatched.csv"), "room/", camera)
        >>> len(arcs) == len(ol.read_segments("unmatched.csv"))
        True
    """
    cameras, refs = calibration_of(camera), photos_of(photos)
    camera_of = cameras_of_photos(refs, cameras, camera_of)
    check_given(segments, refs, camera_of, name)
    require_inside(segments, [camera_of[image] for image in segments.images], cameras)
    covariance = _covariance_px2(segments, sigma_px)
    refs = of_one_range(refs, progress)

    def look(photo: Photo) -> FoundArcs:
        """The segments of one photo, or why it has none."""
        own = camera_of[photo.name]
        rows = _rows_of(segments, photo.name)
        try:
            image = photo.read()
        except InputError as error:
            return skipped(photo, own, str(error))
        width, height = cameras[own].image_size
        if image.shape[1::-1] != (width, height):
            found = f"{image.shape[1]}x{image.shape[0]}"
            called = photo.path if isinstance(photo, PhotoRef) else photo.name
            return skipped(photo, own, f"{called} has {found} px, the calibration of {own} is for {width}x{height}.")
        bearings, seen = cameras[own].unproject(segments.endpoints_px[rows])
        rows, bearings = rows[seen.all(-1)], bearings[seen.all(-1)]
        if not len(rows):
            return skipped(photo, own, f"{name} has no segment of it that the camera sees.")
        ends = segments.endpoints_px[rows]
        length = np.linalg.norm(steps(cameras[own], ends)[:, 0], axis=-1)
        return FoundArcs(photo, own, ends, covariance[rows], length, side_colours(image, cameras[own], bearings, appearance))

    found = on_all_cores(look, refs, "reading photos", progress)
    require_any(found, "photos, segments and calibration")
    notes = _remarks(segments, found, sigma_px, name)
    return PhotoArcs(tuple(found), cameras, notes, {"photos": photo_folder(refs), "segments": name})


def check_given(segments: Segments, photos: Sequence[Photo], camera_of: Mapping[str, str], name: str) -> None:
    """Raises InputError where a segment has a track already, and where its photo or camera is another one."""
    if segments.tracks:
        raise InputError(
            f"{name}: an empty column track was expected beside photos, found {segments.tracks[0]}; leave the photos out to use "
            "these tracks, or empty the column to match the segments anew."
        )
    names = [photo.name for photo in photos]
    for k, image in enumerate(segments.images):
        if image not in camera_of:
            raise InputError(
                f"{name}: one of the {len(names)} photos was expected, found the image {image}; name them alike, as {names[0]}."
            )
        if segments.cameras is not None and segments.cameras[k] != camera_of[image]:
            raise InputError(
                f"{name}: the camera {camera_of[image]} was expected for the image {image}, found {segments.cameras[k]}; "
                "correct it."
            )


def _covariance_px2(segments: Segments, sigma_px: float) -> Float[np.ndarray, "n 2 2 2"]:
    """Of both ends."""
    if segments.covariance_px2 is not None:
        return segments.covariance_px2
    sigma = np.full(len(segments), sigma_px) if segments.sigma_px is None else segments.sigma_px
    return np.broadcast_to(sigma[:, None, None, None] ** 2 * np.eye(2), (len(segments), 2, 2, 2)).copy()


def _rows_of(segments: Segments, photo: str) -> Int[np.ndarray, " k"]:
    """The segments of one photo."""
    if photo not in segments.images:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(segments.image == segments.images.index(photo))


def _remarks(segments: Segments, found: Sequence[FoundArcs], sigma_px: float, name: str) -> tuple[str, ...]:
    """What a user should know of how the table was taken."""
    unseen = len(segments) - sum(map(len, found))
    lost = (f"{unseen} of {len(segments)} segments were not used: photos that were skipped, or ends that no camera sees.",)
    noise = (f"{name} states no noise: {sigma_px} px were taken for each end, and the slack holds the rest.",)
    stated = segments.covariance_px2 is not None or segments.sigma_px is not None
    return (lost if unseen else ()) + (() if stated else noise)
