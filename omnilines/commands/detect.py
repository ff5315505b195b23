"""omnilines detect: photos -> corners.csv."""

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from calib_patterns import pattern as parse_pattern
from calib_patterns._pattern import Detection, Pattern
from calib_patterns.sharpness import blur_remarks
from camera_models import InputError
from omnilines.commands._common import CommandResult, ProgressCallback, output_folder, silent
from omnilines.files import PhotoRef, find_photos, read_photo, write_corners
from omnilines.records import Corners, Summary, ViewResult


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


def detect_corners(
    photos: Sequence[PhotoRef], pattern: Pattern, *, mirrored: bool = False, progress: ProgressCallback = silent
) -> PhotoCorners:
    """Find the pattern in every photo, on all cores, one photo per core in memory.

    A photo that cannot be read, is of another size than most, or shows no pattern is skipped with its reason. Raises InputError
    when no photo shows the pattern.
    """

    def look(photo: PhotoRef) -> tuple[Detection, str | None, tuple[int, int] | None]:
        try:
            image = read_photo(photo.path)
        except InputError as error:
            return Detection.empty(), str(error), None
        detection, reason = pattern.detect(image, mirrored=mirrored)
        return detection, reason, (image.shape[1], image.shape[0])

    found = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, result in enumerate(pool.map(look, photos), 1):
            found.append(result)
            progress("detecting corners", done, len(photos))
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
    blurs = [detection.blur_px for _, detection in kept if detection.blur_px is not None]
    blur_px = np.concatenate(blurs) if len(blurs) == len(kept) else None
    return PhotoCorners(_table(kept, pattern), size, tuple(skipped), _folder(photos), blur_px)


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


def detect(
    photos: Sequence[Path], pattern_spec: str, out: Path, *, mirror: bool = False, progress: ProgressCallback = silent
) -> CommandResult:
    """Write the corners of a target seen in photos to `out/corners.csv`.

    Raises InputError when there is no photo, the specification is malformed or no photo shows the pattern.
    """
    pattern = parse_pattern(pattern_spec)
    found = detect_corners(find_photos(photos), pattern, mirrored=mirror, progress=progress)
    path = output_folder(out) / "corners.csv"
    write_corners(path, found.corners)
    counts = np.bincount(found.corners.view, minlength=len(found.corners.images))
    seen = list(zip(found.corners.images, counts.tolist(), found.remarks, strict=True))
    rows = tuple((image, f"{count} corners" + (f"; {remark}" if remark else "")) for image, count, remark in seen)
    skipped = tuple((view.image, f"skipped: {view.reason}") for view in found.skipped)
    data = {
        "pattern": pattern.specification,
        "image_size": list(found.image_size),
        "photos": [{"image": image, "corners": count, "reason": None, "remark": remark} for image, count, remark in seen]
        + [{"image": view.image, "corners": 0, "reason": view.reason, "remark": None} for view in found.skipped],
    }
    summary = Summary(f"Corners of {pattern.specification}", rows + skipped, (f"{len(found.corners)} corners in {path}",))
    return CommandResult((summary,), data, files=(path,))
