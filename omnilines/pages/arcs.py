"""What was found in photos: figures for tables and `--json`, and pictures of the photos with their arcs."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8

from camera_models import CameraModel
from camera_models.formats.disk import write_atomically
from omnilines.files import Photo, photos_at_once
from omnilines.geometry.sphere import angle_between, arc_normal
from omnilines.pages.limits_of_lines import arcs_advice
from omnilines.photo_file import eight_bits, jpeg_of
from omnilines.pipelines.arcs import BYTES_PER_PIXEL
from omnilines.pipelines.photo_arcs import FoundArcs, PhotoArcs
from omnilines.progress import ProgressCallback, on_all_cores
from omnilines.records import Summary
from omnilines.report.numbers import figure

COLOURS = ((80, 255, 80), (255, 190, 60), (80, 200, 255), (255, 110, 220), (90, 120, 255), (230, 230, 90))
"""BGR, one after another."""
QUALITY = 92
"""Of a JPEG."""
GREY = (150, 150, 150)
DRAWN_EVERY_PX = 4.0
LONG_DEG = 10.0
"""Share of arcs longer than this is told."""
_SUBPIXEL_BITS = 4


def arcs_summary(arcs: PhotoArcs, table: Path) -> Summary:
    """A row for each photo that was used; `table` is where the arcs are."""
    rows = tuple((one.photo.name, _row(one, arcs.cameras[one.camera])) for one in arcs.used)
    notes = (f"{len(arcs)} arcs in {table}",)
    return Summary("Arcs", rows, notes, of_photos=True, verdict=_verdict(arcs), advice=arcs_advice(arcs))


def _verdict(arcs: PhotoArcs) -> str:
    """How many there are, and how well their ends are known across them."""
    used = [one for one in arcs.used if len(one)]
    if not used:
        return f"None of {len(arcs.photos)} photos shows a straight line."
    half = float(np.median([len(one) for one in used]))
    across = [_across_px(one, arcs.cameras[one.camera]).ravel() for one in used]
    known = float(np.median(np.concatenate(across)))
    return (
        f"{len(arcs)} arcs of straight lines in {len(used)} of {len(arcs.photos)} photos, {half:.0f} in the "
        f"median photo; half of "
        f"their ends are known to {figure(known, '.2g', 'px')} across or better."
    )


def _across_px(found: FoundArcs, model: CameraModel) -> Float[np.ndarray, "n 2"]:
    """Standard deviation of both ends of each arc across its image there, which may bend, or cross the seam of a panorama."""
    pixels = torch.as_tensor(found.endpoints_px)
    with torch.no_grad():
        ends, _ = model.unproject(pixels)
        normal = arc_normal(ends[:, 0], ends[:, 1])[:, None, :, None]
        way = torch.nn.functional.normalize((model.unproject_jacobian(pixels).mT @ normal)[..., 0], dim=-1).numpy()
    return np.sqrt(np.einsum("nei,neij,nej->ne", way, found.covariance_px2, way).clip(0))


def arcs_data(arcs: PhotoArcs) -> dict[str, Any]:
    """What `--json` prints."""
    photos = [
        {"image": one.photo.name, "camera": one.camera, "reason": one.reason, **_figures(one, arcs.cameras[one.camera])}
        for one in arcs.photos
    ]
    return {"photos": photos, "arcs": len(arcs)}


def _figures(found: FoundArcs, model: CameraModel) -> Mapping[str, float | int | None]:
    if not len(found):
        return {"arcs": 0, "mean_length_px": None, "mean_length_deg": None, "longer_than_10_deg": None}
    ends, _ = model.unproject(torch.as_tensor(found.endpoints_px))
    angle = np.degrees(angle_between(ends[:, 0], ends[:, 1]).numpy())
    return {
        "arcs": len(found),
        "mean_length_px": float(found.length_px.mean()),
        "mean_length_deg": float(angle.mean()),
        "longer_than_10_deg": float((angle > LONG_DEG).mean()),
    }


def _row(found: FoundArcs, model: CameraModel) -> str:
    figures = _figures(found, model)
    if not figures["arcs"]:
        return "0 arcs"
    share = 100 * float(figures["longer_than_10_deg"] or 0.0)
    return (
        f"{figures['arcs']} arcs, mean {figures['mean_length_px']:.0f} px and {figures['mean_length_deg']:.1f} degrees, "
        f"{share:.0f} percent longer than {LONG_DEG:g} degrees"
    )


def write_pictures(folder: Path, arcs: PhotoArcs, progress: ProgressCallback) -> tuple[Path, ...]:
    """A JPEG of each photo that was used, with its arcs over it; the files."""
    return write_drawn(
        folder, arcs.used, lambda found: draw_arcs(found.photo.read(), arcs.cameras[found.camera], found), progress
    )


def write_drawn(
    folder: Path,
    photos: Sequence[FoundArcs],
    drawn: Callable[[FoundArcs], UInt8[np.ndarray, "h w 3"]],
    progress: ProgressCallback,
) -> tuple[Path, ...]:
    """A JPEG of each photo as it is drawn; the files."""

    def draw(found: FoundArcs) -> Path:
        """The picture of one photo."""
        path = folder / picture_name(found.photo)
        write_atomically(path, jpeg_of(drawn(found), QUALITY))
        return path

    at_once = photos_at_once([found.photo for found in photos], BYTES_PER_PIXEL)
    return tuple(on_all_cores(draw, photos, "drawing arcs", progress, at_once))


def picture_name(photo: Photo) -> str:
    """Of the picture of a photo, beside those of the others."""
    return f"{PurePosixPath(photo.name).with_suffix('')}.jpg"


def draw_arcs(
    image: Shaped[np.ndarray, "h w *c"], model: CameraModel, found: FoundArcs, kind: Int[np.ndarray, " n"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The photo, darkened, with its arcs as curves, sampled through the model, and their end points, in the colour of their kind
    (grey for -1), else one after another."""
    grey = eight_bits(image)
    picture = (cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if grey.ndim == 2 else grey) // 2
    width = 1 if max(model.image_size) < 3000 else 3
    for k, curve in enumerate(curves(model, found)):
        number = k if kind is None else int(kind[k])
        colour = COLOURS[number % len(COLOURS)] if number >= 0 else GREY
        # Across the seam of a panorama the curve goes on at the other side.
        cuts = np.flatnonzero(np.abs(np.diff(curve[:, 0])) > 0.5 * model.image_size[0]) + 1
        for piece in np.split(curve, cuts):
            points = np.round(piece * 2**_SUBPIXEL_BITS).astype(np.int32)
            cv2.polylines(picture, [points], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
        for end in (curve[0], curve[-1]):
            cv2.circle(picture, (round(float(end[0])), round(float(end[1]))), 1 + width, colour, -1, cv2.LINE_AA)
    return picture


def curves(model: CameraModel, found: FoundArcs) -> list[Float[np.ndarray, "k 2"]]:
    """Each arc as pixels DRAWN_EVERY_PX apart."""
    if not len(found):
        return []
    count = np.maximum(np.ceil(found.length_px / DRAWN_EVERY_PX).astype(np.int64), 1) + 1
    owner = np.repeat(np.arange(len(found)), count)
    share = (np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)) / (count[owner] - 1)
    ends, _ = model.unproject(torch.as_tensor(found.endpoints_px))
    first, last = ends[:, 0], ends[:, 1]
    across = torch.linalg.cross(arc_normal(first, last), first)
    angle = (torch.as_tensor(share) * angle_between(first, last)[owner])[:, None]
    pixels, _ = model.project(torch.cos(angle) * first[owner] + torch.sin(angle) * across[owner])
    return np.split(pixels.detach().numpy(), np.cumsum(count)[:-1])
