"""Segments that a user brings, not yet matched, in place of the arcs that we would find in the photos."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from camera_models import Calibration, InputError
from omnilines.files import PhotoRef, read_photo, read_segments
from omnilines.matching.appearance import side_colours
from omnilines.pipelines.photo_arcs import FoundArcs, skipped
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.records import Segments

SIGMA_PX = 0.2
"""Standard deviation of an end where the table states none: that of a good detector. What is missing is found as slack."""


@dataclass(frozen=True)
class GivenSegments:
    """A table of segments whose photos and cameras are known."""

    path: Path
    table: Segments
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    """Of both ends."""
    stated: bool
    """Whether the table states noise."""

    def rows_of(self, photo: str) -> Int[np.ndarray, " k"]:
        """The segments of one photo."""
        if photo not in self.table.images:
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(self.table.image == self.table.images.index(photo))


def read_given(path: Path, photos: Sequence[PhotoRef], camera_of: Mapping[str, str]) -> GivenSegments:
    """The table `path` of unmatched segments in `photos`.

    Raises InputError where a segment has a track already, and where its photo or camera is another one.
    """
    table = read_segments(path)
    if table.tracks:
        raise InputError(
            f"{path}: an empty column track was expected beside photos, found {table.tracks[0]}; leave the photos out to use "
            "these tracks, or empty the column to match the segments anew."
        )
    names = [photo.name for photo in photos]
    for k, image in enumerate(table.images):
        if image not in camera_of:
            raise InputError(
                f"{path}: one of the {len(names)} photos was expected, found the image {image}; name them alike, as {names[0]}."
            )
        if table.cameras is not None and table.cameras[k] != camera_of[image]:
            raise InputError(
                f"{path}: the camera {camera_of[image]} was expected for the image {image}, found {table.cameras[k]}; correct it."
            )
    sigma = np.full(len(table), SIGMA_PX) if table.sigma_px is None else table.sigma_px
    covariance = table.covariance_px2
    if covariance is None:
        covariance = np.broadcast_to(sigma[:, None, None, None] ** 2 * np.eye(2), (len(table), 2, 2, 2)).copy()
    return GivenSegments(path, table, covariance, table.covariance_px2 is not None or table.sigma_px is not None)


def given_arcs(
    given: GivenSegments,
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    progress: ProgressCallback,
) -> list[FoundArcs]:
    """The segments of every photo with the colours beside them; those with an end that the camera cannot see are left out.

    A photo without segments, or one that cannot be read, is skipped with its reason. Raises InputError when none is left.
    """

    def look(photo: PhotoRef) -> FoundArcs:
        """The segments of one photo, or why it has none."""
        name = camera_of[photo.name]
        rows = given.rows_of(photo.name)
        try:
            image = read_photo(photo.path)
        except InputError as error:
            return skipped(photo, name, str(error))
        width, height = cameras[name].image_size
        if image.shape[1::-1] != (width, height):
            found = f"{image.shape[1]}x{image.shape[0]}"
            return skipped(photo, name, f"{photo.path} has {found} px, the calibration of {name} is for {width}x{height}.")
        bearings, seen = cameras[name].unproject(given.table.endpoints_px[rows])
        rows, bearings = rows[seen.all(-1)], bearings[seen.all(-1)]
        if not len(rows):
            return skipped(photo, name, f"{given.path} has no segment of it that the camera sees.")
        ends = given.table.endpoints_px[rows]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        return FoundArcs(photo, name, ends, given.covariance_px2[rows], length, side_colours(image, cameras[name], bearings))

    results = on_all_cores(look, photos, "reading photos", progress)
    if all(result.reason is not None for result in results):
        raise InputError(
            f"No photo of {len(photos)} can be used (first reason: {results[0].reason}); check photos, segments and calibration."
        )
    return results


def remarks_on(given: GivenSegments, found: Sequence[FoundArcs]) -> tuple[str, ...]:
    """What a user should know of how the table was taken."""
    unseen = len(given.table) - sum(len(arcs) for arcs in found)
    lost = (f"{unseen} of {len(given.table)} segments were not used: photos that were skipped, or ends that no camera sees.",)
    noise = (f"{given.path} states no noise: {SIGMA_PX} px were taken for each end, and the slack holds the rest.",)
    return (lost if unseen else ()) + (() if given.stated else noise)
