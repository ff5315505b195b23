"""Arcs of many photos and the colours beside them, kept on disk so that a second run need not look again."""

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from camera_models import Calibration, CameraModel, InputError
from camera_models.formats.disk import write_atomically
from omnilines.extraction import ExtractionOptions, extract_arcs
from omnilines.files import PhotoRef, read_photo
from omnilines.files.folders import output_folder
from omnilines.matching.appearance import side_colours
from omnilines.progress import ProgressCallback, on_all_cores

SHORT_ARCS = ExtractionOptions(min_length_px=13.0)
"""Shorter arcs than by default are used: other photos confirm them or not."""
_ARRAYS = ("endpoints_px", "covariance_px2", "length_px", "colours")


@dataclass(frozen=True)
class FoundArcs:
    """What was found in one photo."""

    photo: PhotoRef
    camera: str
    endpoints_px: Float[np.ndarray, "n 2 2"]
    covariance_px2: Float[np.ndarray, "n 2 2 2"]
    length_px: Float[np.ndarray, " n"]
    colours: Float[np.ndarray, "n 2 3"]
    reason: str | None = None
    """Why the photo was skipped, one sentence."""

    def __len__(self) -> int:
        return len(self.length_px)


def find_arcs(
    photos: Sequence[PhotoRef],
    cameras: Calibration,
    camera_of: Mapping[str, str],
    mask: Bool[np.ndarray, "h w"] | None,
    folder: Path,
    progress: ProgressCallback,
) -> list[FoundArcs]:
    """The arcs of every photo, on all cores, one photo per core in memory; those kept in `folder` by an earlier run are read.

    A photo that cannot be read or has not the size of its camera is skipped with its reason. Raises InputError when none is left.
    """
    output_folder(folder)

    def look(photo: PhotoRef) -> FoundArcs:
        """The arcs of one photo, or why it has none."""
        name = camera_of[photo.name]
        try:
            content = photo.path.read_bytes()
        except OSError as error:
            return skipped(photo, name, f"{photo.path} cannot be read ({error.strerror}).")
        least = math.radians(cameras.estimates[name].min_angle_deg) if name in cameras.estimates else 0.0
        kept = folder / f"{fingerprint(content, cameras[name], mask, least)}.npz"
        found = _kept(kept)
        if found is None:
            try:
                found = _looked(photo, cameras[name], mask, least)
            except InputError as error:
                return skipped(photo, name, str(error))
            buffer = io.BytesIO()
            np.savez(buffer, **found)  # type: ignore[arg-type]
            write_atomically(kept, buffer.getvalue())
        pixels, covariance, length, colours = (found[key] for key in _ARRAYS)
        return FoundArcs(photo, name, pixels, covariance, length, colours)

    results = on_all_cores(look, photos, "extracting arcs", progress)
    if all(result.reason is not None for result in results):
        raise InputError(
            f"No photo of {len(photos)} can be used (first reason: {results[0].reason}); check photos and calibration."
        )
    return results


def fingerprint(content: bytes, model: CameraModel, mask: Bool[np.ndarray, "h w"] | None, least_angle_rad: float) -> str:
    """Of all that the arcs of a photo depend on."""
    what = hashlib.sha256(content)
    parameters = repr((model.NAME, model.image_size, model.parameters.detach().tolist(), least_angle_rad, SHORT_ARCS))
    what.update(f"{version('omnilines')} {parameters}".encode())
    if mask is not None:
        what.update(np.packbits(mask).tobytes())
    return what.hexdigest()[:32]


def skipped(photo: PhotoRef, camera: str, reason: str) -> FoundArcs:
    """A photo that cannot be used, and why."""
    none = np.zeros((0, 2, 2))
    return FoundArcs(photo, camera, none, np.zeros((0, 2, 2, 2)), np.zeros(0), np.zeros((0, 2, 3)), reason)


def _looked(
    photo: PhotoRef, model: CameraModel, mask: Bool[np.ndarray, "h w"] | None, least_angle_rad: float
) -> dict[str, np.ndarray]:
    image = read_photo(photo.path)
    found = extract_arcs(image, model, mask, least_angle_rad, SHORT_ARCS)
    bearings, seen = model.unproject(found.endpoints_px)
    usable = seen.all(-1)
    colours = side_colours(image, model, bearings[usable])
    arrays = (found.endpoints_px[usable], found.covariance_px2[usable], found.length_px[usable], colours)
    return dict(zip(_ARRAYS, arrays, strict=True))


def _kept(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of an earlier run; None where there are none, or a file that is damaged."""
    if not path.exists():
        return None
    try:
        with np.load(path) as file:
            return {key: file[key] for key in _ARRAYS}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
