"""omnilines extract: photos + calibration -> segments.csv and pictures of the arcs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from camera_models import Calibration, CameraModel, InputError, load
from camera_models.formats.disk import write_atomically
from omnilines.commands.result import CommandResult
from omnilines.extraction import ExtractedArcs, extract_arcs
from omnilines.files import PhotoRef, find_photos, read_photo, write_segments
from omnilines.files.folders import output_folder
from omnilines.progress import ProgressCallback, on_all_cores, silent
from omnilines.records import Segments, Summary

TABLE, PICTURES = "segments.csv", "pictures"
COLOURS = ((80, 255, 80), (255, 190, 60), (80, 200, 255), (255, 110, 220), (90, 120, 255), (230, 230, 90))
"""BGR, one after another."""
DRAWN_EVERY_PX = 4.0
LONG_DEG = 10.0
"""Share of arcs longer than this is told."""
_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class PhotoArcs:
    """What was found in one photo."""

    photo: PhotoRef
    camera: str
    found: ExtractedArcs | None
    reason: str | None
    """Why it was skipped, one sentence."""


def extract(
    photos: Sequence[Path],
    calibration: Path,
    out: Path,
    *,
    mask: Path | None = None,
    progress: ProgressCallback = silent,
) -> CommandResult:
    """Write the arcs seen in photos to `out/segments.csv` and a picture of each photo with its arcs to `out/pictures`.

    The white pixels of the image `mask` are looked at. Of a calibration of several cameras, a photo is of the one whose name a
    folder of its path has. A photo that cannot be read or has not the size of its camera is skipped with its reason. Raises
    InputError when there is no photo, no photo can be used, or the mask is not of the camera's size.
    """
    refs = find_photos(photos)
    cameras = load(calibration)
    camera_of = {photo.name: camera_of_photo(photo, cameras) for photo in refs}
    keep = None if mask is None else read_mask(mask, [cameras[name] for name in set(camera_of.values())])
    folder = output_folder(out)

    def look(photo: PhotoRef) -> PhotoArcs:
        """The arcs of one photo, or why it has none."""
        camera = camera_of[photo.name]
        try:
            image = read_photo(photo.path)
            least = math.radians(cameras.estimates[camera].min_angle_deg) if camera in cameras.estimates else 0.0
            found = extract_arcs(image, cameras[camera], keep, least)
        except InputError as error:
            return PhotoArcs(photo, camera, None, str(error))
        _write_picture(folder / PICTURES / _picture_name(photo), image, cameras[camera], found)
        return PhotoArcs(photo, camera, found, None)

    results = on_all_cores(look, refs, "extracting arcs", progress)
    used = [result for result in results if result.found is not None]
    if not used:
        raise InputError(
            f"No photo of {len(refs)} can be used (first reason: {results[0].reason}); check photos and calibration."
        )
    write_segments(folder / TABLE, _table(used))
    files = (folder / TABLE, *(folder / PICTURES / _picture_name(result.photo) for result in used))
    return _result(results, files)


def camera_of_photo(photo: PhotoRef, cameras: Calibration) -> str:
    """The only camera, or the one that a folder of the photo's path is named like; raises InputError where none is."""
    if len(cameras) == 1:
        return next(iter(cameras))
    folders = [part for part in reversed(photo.path.parent.parts) if part in cameras]
    if not folders:
        raise InputError(
            f"The photo {photo.name} was expected in a folder named like one of the cameras {', '.join(cameras)}, found "
            f"{photo.path.parent}; move it, or give the calibration of its camera alone."
        )
    return folders[0]


def read_mask(path: Path, cameras: Sequence[CameraModel]) -> Bool[np.ndarray, "h w"]:
    """Where an image is white; raises InputError where it has not the size of the photos of all cameras."""
    image = read_photo(path)
    for camera in cameras:
        if image.shape[1::-1] != camera.image_size:
            raise InputError(
                f"The mask {path} was expected with {camera.image_size[0]}x{camera.image_size[1]} px, as the camera has, found "
                f"{image.shape[1]}x{image.shape[0]} px; give one of that size."
            )
    bright = image if image.ndim == 2 else image.max(-1)
    return bright >= (128 if image.dtype == np.uint8 else 32768)


def _table(used: Sequence[PhotoArcs]) -> Segments:
    found = [result.found for result in used if result.found is not None]
    image = np.repeat(np.arange(len(used)), [len(one) for one in found])
    return Segments(
        image,
        tuple(result.photo.name for result in used),
        np.full(len(image), -1),
        (),
        np.concatenate([one.endpoints_px for one in found]),
        covariance_px2=np.concatenate([one.covariance_px2 for one in found]),
        cameras=tuple(result.camera for result in used),
    )


def _picture_name(photo: PhotoRef) -> str:
    return f"{PurePosixPath(photo.name).with_suffix('')}.jpg"


def _write_picture(path: Path, image: Shaped[np.ndarray, "h w *c"], model: CameraModel, found: ExtractedArcs) -> None:
    output_folder(path.parent)
    encoded = cv2.imencode(".jpg", draw_arcs(image, model, found), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    write_atomically(path, encoded.tobytes())


def draw_arcs(image: Shaped[np.ndarray, "h w *c"], model: CameraModel, found: ExtractedArcs) -> UInt8[np.ndarray, "h w 3"]:
    """The photo, darkened, with its arcs as curves, sampled through the model, and their end points."""
    grey = image if image.dtype == np.uint8 else (image // 257).astype(np.uint8)
    picture = (cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if grey.ndim == 2 else grey) // 2
    width = 1 if max(model.image_size) < 3000 else 3
    for k, curve in enumerate(curves(model, found)):
        colour = COLOURS[k % len(COLOURS)]
        # Across the seam of a panorama the curve goes on at the other side.
        cuts = np.flatnonzero(np.abs(np.diff(curve[:, 0])) > 0.5 * model.image_size[0]) + 1
        for piece in np.split(curve, cuts):
            points = np.round(piece * 2**_SUBPIXEL_BITS).astype(np.int32)
            cv2.polylines(picture, [points], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
        for end in (curve[0], curve[-1]):
            cv2.circle(picture, (round(float(end[0])), round(float(end[1]))), 1 + width, colour, -1, cv2.LINE_AA)
    return picture


def curves(model: CameraModel, found: ExtractedArcs) -> list[Float[np.ndarray, "k 2"]]:
    """Each arc as pixels DRAWN_EVERY_PX apart."""
    arcs = found.arcs
    count = np.maximum(np.ceil(found.length_px / DRAWN_EVERY_PX).astype(np.int64), 1) + 1
    owner = np.repeat(np.arange(len(arcs)), count)
    share = (np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)) / (count[owner] - 1)
    pixels, _ = model.project(arcs.bearings(owner, arcs.low[owner] + share * (arcs.high - arcs.low)[owner]))
    return np.split(pixels, np.cumsum(count)[:-1]) if len(arcs) else []


def _result(results: Sequence[PhotoArcs], files: tuple[Path, ...]) -> CommandResult:
    rows = tuple((result.photo.name, _row(result)) for result in results)
    total = sum(len(result.found) for result in results if result.found is not None)
    photos = [
        {"image": result.photo.name, "camera": result.camera, "reason": result.reason, **_figures(result.found)}
        for result in results
    ]
    summary = Summary("Arcs", rows, (f"{total} arcs in {files[0]}",))
    skipped = tuple(f"{result.photo.name} is skipped: {result.reason}" for result in results if result.found is None)
    return CommandResult((summary,), {"photos": photos, "arcs": total}, files=files, warnings=skipped)


def _figures(found: ExtractedArcs | None) -> Mapping[str, float | int | None]:
    if found is None or not len(found):
        return {"arcs": 0, "mean_length_px": None, "mean_length_deg": None, "longer_than_10_deg": None}
    angle = np.degrees(found.arcs.high - found.arcs.low)
    return {
        "arcs": len(found),
        "mean_length_px": float(found.length_px.mean()),
        "mean_length_deg": float(angle.mean()),
        "longer_than_10_deg": float((angle > LONG_DEG).mean()),
    }


def _row(result: PhotoArcs) -> str:
    if result.found is None:
        return f"skipped: {result.reason}"
    figures = _figures(result.found)
    if not figures["arcs"]:
        return "0 arcs"
    share = 100 * float(figures["longer_than_10_deg"] or 0.0)
    return (
        f"{figures['arcs']} arcs, mean {figures['mean_length_px']:.0f} px and {figures['mean_length_deg']:.1f} degrees, "
        f"{share:.0f} percent longer than {LONG_DEG:g} degrees"
    )
