"""Photos of a target -> its corners in each, and with the camera what only it leads to."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_patterns import Detection, DetectionOptions, Pattern
from calib_patterns import pattern as parse_pattern
from calib_patterns.guided import seen_ids
from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from camera_models.typed import typed
from omnilines.files import Photo, Photos, photo_folder, photos_of
from omnilines.files.orientation import turned_otherwise
from omnilines.options import require_ranges
from omnilines.pipelines.camera_search import completed, searched
from omnilines.pipelines.kept_corners import Again, KeptCorners, KeptSearch, Looked, said_of
from omnilines.pipelines.kept_results import look_at_rest
from omnilines.pipelines.photo_corners import IN_MEMORY, PhotoCorners, blur_of_corners, corner_table
from omnilines.pipelines.recognise import as_printed
from omnilines.pipelines.seen_boards import other_board
from omnilines.progress import ProgressCallback, silent
from omnilines.records import ViewResult

BYTES_PER_PIXEL = 40
"""Of a photo being looked through, at most."""


@dataclass(frozen=True)
class FirstLook:
    """The first look at photos, each given with the reason why it is left out."""

    target: Pattern
    camera: CameraModel | None
    mirrored: bool
    options: DetectionOptions

    def __call__(self, item: tuple[Photo, str | None]) -> Looked:
        photo, left_out = item
        if left_out is not None:
            return Detection.empty(), left_out, None
        try:
            image = photo.read()
        except InputError as error:
            return Detection.empty(), str(error), None
        size = (image.shape[1], image.shape[0])
        detection, reason = self.target.detect(image, mirrored=self.mirrored, options=self.options)
        if self.camera is not None and size == self.camera.image_size:
            detection = searched(image, self.target, self.camera, detection, mirrored=self.mirrored, options=self.options)
            reason = None if len(detection) else reason
        return detection, reason, size

    def kept(self, work: str | Path | None) -> KeptCorners | None:
        """What it finds in files of a folder, where one is given."""
        asked = (self.target.specification, said_of(self.camera), self.mirrored, self.options.stated)
        return None if work is None else KeptCorners.within(work, asked)


@dataclass(frozen=True)
class _Again:
    """What photos show of the target once the camera is known; each is given with what was found, and its pose where it is
    known."""

    target: Pattern
    camera: CameraModel
    mirrored: bool
    options: DetectionOptions

    def __call__(self, item: Again) -> Detection:
        photo, known, pose = item
        try:
            image = photo.read()
        except InputError:
            return known  # the reason why it was skipped stands
        if (image.shape[1], image.shape[0]) != self.camera.image_size:
            return known
        if pose is None:
            return searched(image, self.target, self.camera, known, mirrored=self.mirrored, options=self.options)
        whole = completed(image, self.target, self.camera, known, pose, options=self.options)
        return known if whole is None else whole


@typed
def detect(
    photos: Photos,
    pattern: Pattern | str,
    *,
    camera: CameraModel | None = None,
    mirrored: bool = False,
    recognise: bool = True,
    work: str | Path | None = None,
    options: DetectionOptions = DetectionOptions(),
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> PhotoCorners:
    """Find a target in photos of one camera, on all cores, one photo per core in memory, or by the workers of an `executor`.

    `photos` are a folder, files and folders, arrays (NumPy or torch, grey or BGR), which are called photo0, photo1, ..., or a
    mapping of names to arrays; `pattern` may be its specification. A `camera` that is known leads to corners, and photos, that
    are hard to find. `mirrored`: the camera looks into a mirror. `recognise`: a board with tags that a few photos show in
    another print than the one given (white on black, in the layout of OpenCV before 4.6, with other tags of its dictionary) is
    taken for what it is. What is found is kept in the folder `work`, where one is given, and read from there by another run
    that would find the same. A photo that cannot be read, is of another size or EXIF orientation than most, or shows no target
    is skipped with its reason.

    Raises InputError when there is no photo, the specification is malformed, no photo shows the target, or the camera is of
    another image size.

        >>> corners = ol.detect("board/", "checkerboard:8x6:30mm")
        >>> len(corners.corners.images), corners.image_size
        (8, (640, 480))
        >>> corners.corners.pixels.shape, corners.corners.board_m.shape
        ((384, 2), (384, 3))
    """
    require_ranges(options)
    found_photos = photos_of(photos)
    target, otherwise = parse_pattern(pattern) if isinstance(pattern, str) else pattern, None
    if recognise:
        target, otherwise = as_printed(target, found_photos, any_tags=True, mirrored=mirrored, options=options, progress=progress)

    turned = turned_otherwise(found_photos)
    first = FirstLook(target, camera, mirrored, options)
    found = look_at_rest(
        first,
        [(photo, turned.get(photo.name)) for photo in found_photos],
        found_photos,
        "detecting corners",
        first.kept(work),
        executor=executor,
        bytes_per_pixel=BYTES_PER_PIXEL,
        progress=progress,
    )
    without = [
        photo for photo, (detection, _, its_size) in zip(found_photos, found, strict=True) if its_size and not len(detection)
    ]
    few = 2 * len(without) > len(found)
    in_none = not any(len(detection) for detection, _, _ in found)
    other = other_board(without, target, mirrored, options, progress, in_no_photo=in_none) if few else None
    size = _common_size(found, target, other)
    if camera is not None:
        _require_size(camera, size)
    kept, skipped = _of_size(found_photos, found, size)
    folder = photo_folder(found_photos)
    return PhotoCorners(
        corner_table([(photo.name, detection) for photo, detection in kept], target),
        size,
        tuple(skipped),
        folder,
        blur_of_corners(kept),
        tuple(found_photos),
        target,
        mirrored,
        options,
        {"photos": IN_MEMORY if folder is None else folder, "pattern": target.specification},
        otherwise,
        other,
        None if work is None else Path(work),
    )


def _require_size(camera: CameraModel, size: tuple[int, int]) -> None:
    """Raises InputError where a camera is of another image size than the photos."""
    if size != camera.image_size:
        photo_size, camera_size = (f"{width}x{height} px" for width, height in (size, camera.image_size))
        raise InputError(
            f"The `camera` of the photos, of {photo_size}, was expected, found one of {camera_size}; give that of these photos, "
            "or leave it out."
        )


def _of_size(
    photos: Sequence[Photo], found: Sequence[Looked], size: tuple[int, int]
) -> tuple[list[tuple[Photo, Detection]], list[ViewResult]]:
    """The photos of a size that show the target, and why each of the others is skipped."""
    kept, skipped = list[tuple[Photo, Detection]](), list[ViewResult]()
    for photo, (detection, reason, its_size) in zip(photos, found, strict=True):
        if its_size is not None and len(detection) and its_size != size:
            own, most = (f"{width}x{height} px" for width, height in (its_size, size))
            reason = f"its size is {own} where most photos have {most}; give it as the camera took it"
        if reason is None and len(detection):
            kept.append((photo, detection))
        else:
            skipped.append(ViewResult(photo.name, photo.name, False, reason or "no corner was found"))
    return kept, skipped


def _common_size(found: Sequence[Looked], pattern: Pattern, other: str | None) -> tuple[int, int]:
    """That of most photos with corners. Raises InputError where none has any, with what they show instead."""
    sizes = Counter(size for detection, _, size in found if size is not None and len(detection))
    if not sizes:
        reasons = [reason for _, reason, _ in found if reason]
        raise InputError(
            f"The pattern {pattern.specification} was expected in at least one of {len(found)} photos, found in none "
            f"(first reason: {reasons[0].rstrip('.')}). {other or 'Check the specification and the photos.'}"
        )
    return sizes.most_common(1)[0][0]


def search_again(
    found: PhotoCorners,
    model: CameraModel,
    poses: Mapping[str, Pose],
    *,
    first: bool,
    executor: Executor | None = None,
    progress: ProgressCallback = silent,
) -> PhotoCorners:
    """The corners found and those that a camera leads to, fitted along the edges that it sees, worked on as `detect` does.

    `poses`: cam_from_board of the photos, by name, whose corners fit the camera. `first`: look through all photos, the others,
    and those skipped, included; without it through those of `poses` that may show more.
    """
    pattern = found.pattern
    assert pattern is not None

    turned = turned_otherwise(found.photos)

    def may_gain(photo: Photo) -> bool:
        if photo.name in turned:
            return False
        if first or photo.name not in poses:
            return first
        return len(np.setdiff1d(seen_ids(pattern, model, poses[photo.name]), found.detection(photo.name).ids)) > 0

    again = [photo for photo in found.photos if may_gain(photo)]
    asked = ("again", pattern.specification, said_of(model), found.mirrored, found.options.stated)
    better = look_at_rest(
        _Again(pattern, model, found.mirrored, found.options),
        [(photo, found.detection(photo.name), poses.get(photo.name)) for photo in again],
        again,
        "searching with the camera",
        None if found.work is None else KeptSearch.within(found.work, asked),
        executor=executor,
        bytes_per_pixel=BYTES_PER_PIXEL,
        progress=progress,
    )
    return found.updated({photo.name: detection for photo, detection in zip(again, better, strict=True)})
