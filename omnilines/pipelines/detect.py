"""Photos of a target -> its corners in each, and with the camera what only it leads to."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from calib_patterns import Detection, Pattern
from calib_patterns.guided import seen_ids
from calib_patterns.sharpness import blur_remarks
from camera_models import CameraModel, InputError
from camera_models.pose import Pose
from omnilines.files import PhotoRef, read_photo
from omnilines.pipelines.camera_search import completed, searched
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.records import Corners, ViewResult

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class PhotoCorners:
    """Corners found in a set of photos of one camera."""

    corners: Corners
    image_size: tuple[int, int]
    skipped: tuple[ViewResult, ...]
    """Photos without corners, each with its reason."""
    photo_folder: Path
    blur_px: Float[np.ndarray, "n 2"] | None = None
    """Blur of both edges of each corner (`Detection.blur_px`), rows as in `corners`; None where it is not known."""

    @property
    def remarks(self) -> tuple[str | None, ...]:
        """Of each view of `corners` what a person should know of its photo, one sentence, or None."""
        views = len(self.corners.images)
        return (None,) * views if self.blur_px is None else blur_remarks(self.corners.view, self.blur_px, views)

    def detection(self, name: str) -> Detection:
        """The corners of the photo of that name, none where it was skipped."""
        corners = self.corners
        if name not in corners.view_names or corners.ids is None:
            return Detection.empty()
        rows = corners.view == corners.view_names.index(name)
        sigma_px = np.ones(len(corners)) if corners.sigma_px is None else corners.sigma_px
        blur_px = None if self.blur_px is None else self.blur_px[rows]
        return Detection(corners.ids[rows], corners.pixels[rows], sigma_px[rows], blur_px)

    def updated(self, photos: Sequence[PhotoRef], better: Mapping[str, Detection], pattern: Pattern) -> "PhotoCorners":
        """With other corners for the photos named, of which those skipped before are views then."""
        kept = [(photo, better.get(photo.name, self.detection(photo.name))) for photo in photos]
        kept = [(photo, detection) for photo, detection in kept if len(detection)]
        seen = {photo.name for photo, _ in kept}
        skipped = tuple(view for view in self.skipped if view.name not in seen)
        return PhotoCorners(_table(kept, pattern), self.image_size, skipped, self.photo_folder, _blur_px(kept))


def detect_corners(
    photos: Sequence[PhotoRef],
    pattern: Pattern,
    *,
    model: CameraModel | None = None,
    mirrored: bool = False,
    progress: ProgressCallback = silent,
) -> PhotoCorners:
    """Find the pattern in every photo, on all cores, one photo per core in memory; with the camera's `model` also what only it
    leads to.

    A photo that cannot be read, is of another size than most (than the camera's), or shows no pattern is skipped with its
    reason. Raises InputError when no photo shows the pattern.
    """

    def look(photo: PhotoRef) -> tuple[Detection, str | None, tuple[int, int] | None]:
        """What one photo shows of the target, why it was skipped, and its size."""
        try:
            image = read_photo(photo.path)
        except InputError as error:
            return Detection.empty(), str(error), None
        size = (image.shape[1], image.shape[0])
        detection, reason = pattern.detect(image, mirrored=mirrored)
        if model is not None and size == model.image_size:
            detection = searched(image, pattern, model, detection, mirrored=mirrored)
            reason = None if len(detection) else reason
        return detection, reason, size

    found = on_all_cores(look, photos, "detecting corners", progress)
    sizes = Counter(size for detection, _, size in found if size is not None and len(detection))
    if not sizes:
        reasons = [reason for _, reason, _ in found if reason]
        raise InputError(
            f"The pattern {pattern.specification} was expected in at least one of {len(photos)} photos, found in none "
            f"(first reason: {reasons[0].rstrip('.')}); check the counts of inner corners and the photos."
        )
    size = sizes.most_common(1)[0][0]
    kept: list[tuple[PhotoRef, Detection]] = []
    skipped = []
    for photo, (detection, reason, its_size) in zip(photos, found, strict=True):
        if its_size is not None and len(detection) and its_size != size:
            reason = f"its size is {its_size[0]}x{its_size[1]} px where most photos have {size[0]}x{size[1]} px"
        if reason is None and len(detection):
            kept.append((photo, detection))
        else:
            skipped.append(ViewResult(photo.name, photo.name, False, reason or "no corner was found"))
    return PhotoCorners(_table(kept, pattern), size, tuple(skipped), _folder(photos), _blur_px(kept))


def search_again(
    photos: Sequence[PhotoRef],
    found: PhotoCorners,
    pattern: Pattern,
    model: CameraModel,
    poses: Mapping[str, Pose],
    *,
    lost_too: bool,
    mirrored: bool = False,
    progress: ProgressCallback = silent,
) -> PhotoCorners:
    """The corners found and those that a camera leads to, on all cores, one photo per core in memory.

    `poses`: cam_from_board of the photos, by name, whose corners fit the camera; photos of which all corners in the camera's
    view are known are not read. `lost_too`: look through the other photos as well, those skipped included.
    """

    def may_gain(photo: PhotoRef) -> bool:
        if photo.name not in poses:
            return lost_too
        return len(np.setdiff1d(seen_ids(pattern, model, poses[photo.name]), found.detection(photo.name).ids)) > 0

    def look(photo: PhotoRef) -> Detection:
        """What one photo shows of the target once the camera is known."""
        known = found.detection(photo.name)
        try:
            image = read_photo(photo.path)
        except InputError:
            return known  # the reason why it was skipped stands
        if (image.shape[1], image.shape[0]) != model.image_size:
            return known
        if photo.name not in poses:
            return searched(image, pattern, model, known, mirrored=mirrored)
        whole = completed(image, pattern, model, known, poses[photo.name])
        return known if whole is None else whole

    again = [photo for photo in photos if may_gain(photo)]
    better = on_all_cores(look, again, "searching with the camera", progress)
    return found.updated(photos, {photo.name: detection for photo, detection in zip(again, better, strict=True)}, pattern)


def counts_remark(pattern: Pattern, corners: Corners) -> str | None:
    """What tells of a wrong count of corners: three photos or more that all show the same smaller grid."""
    grid = pattern.plain_grid
    if grid is None or corners.ids is None or len(corners.images) < 3:
        return None
    extents = {
        (int(np.ptp(ids % grid.columns)) + 1, int(np.ptp(ids // grid.columns)) + 1)
        for ids in np.split(corners.ids, np.flatnonzero(np.diff(corners.view)) + 1)
    }
    counts = {tuple(sorted(extent)) for extent in extents}
    if len(counts) > 1 or counts == {tuple(sorted((grid.columns, grid.rows)))}:
        return None
    seen, asked = "{}x{}".format(*next(iter(extents))), f"{grid.columns}x{grid.rows}"
    return (
        f"All {len(corners.images)} photos show {seen} inner corners of a board of {asked}: if that is the whole board, give "
        f"{pattern.NAME}:{seen} with its square."
    )


def _blur_px(kept: list[tuple[PhotoRef, Detection]]) -> Float[np.ndarray, "n 2"] | None:
    blurs = [detection.blur_px for _, detection in kept if detection.blur_px is not None]
    return np.concatenate(blurs) if len(blurs) == len(kept) else None


def _table(kept: list[tuple[PhotoRef, Detection]], pattern: Pattern) -> Corners:
    names = tuple(photo.name for photo, _ in kept)
    ids = np.concatenate([d.ids for _, d in kept])
    view = np.repeat(np.arange(len(kept)), [len(d) for _, d in kept])
    pixels: Float[np.ndarray, "n 2"] = np.concatenate([d.pixels for _, d in kept])
    sigma: Float[np.ndarray, " n"] = np.concatenate([d.sigma_px for _, d in kept])
    return Corners(view, names, names, pattern.points_m[ids], pixels, sigma, ids)


def _folder(photos: Sequence[PhotoRef]) -> Path:
    """The folder that the photos' names are relative to."""
    photo = photos[0]
    return photo.path.parents[len(Path(photo.name).parts) - 1]
