"""Photos with what was observed and what the model predicts drawn over them."""

import base64
import os
import pathlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from markupsafe import Markup

from camera_models.errors import InputError
from omnilines.photo_file import eight_bits, jpeg_of, read_photo
from omnilines.progress import ahead
from omnilines.records import Polyline
from omnilines.report.page import Section, fragment

MAX_WIDTH_PX = 1600
_STEPS = ((1600, 88), (1600, 78), (1600, 66), (1280, 72), (1280, 60), (960, 66), (800, 58), (640, 50))
"""(width in pixels, JPEG quality) tried in turn until a photo fits its share of the page."""
_AT_ONCE = 4
"""Photos that are read at a time: a large one takes some tens of megabytes."""
_SMALLEST_SHARE_BYTES = 60_000
"""Below this a photo shows too little: fewer photos are embedded instead."""


@dataclass(frozen=True)
class _Photo:
    name: str
    size: tuple[int, int]
    """Of the original, which the curves refer to."""
    data_uri: str
    caption: str
    model: tuple[tuple[str, Markup], ...]
    """(label, SVG path) of each curve."""
    observed: tuple[tuple[str, Markup], ...]


def photos_section(
    photo_folder: str | os.PathLike[str],
    curves: Sequence[Polyline],
    *,
    images: Sequence[str] | None = None,
    title: str = "Photos",
) -> Section:
    """The photos under `photo_folder` with `curves` over them: kind `model` as lines, kind `observed` as points.

    `images` orders and limits the photos (by default those that `curves` name, in that order); paths are relative to the
    folder. Pixels are those of the photo as OpenCV reads it, the centre of the first pixel at (0, 0). Photos are scaled and
    compressed to the page's limit; those that do not fit or cannot be read are named in the page.
    """
    names = list(dict.fromkeys(images if images is not None else (c.image for c in curves)))
    by_image: dict[str, list[Polyline]] = {name: [] for name in names}
    for curve in curves:
        if curve.image in by_image:
            by_image[curve.image].append(curve)
    return drawn_photos_section(photo_folder, names, by_image.__getitem__, title=title)


def drawn_photos_section(
    photo_folder: str | os.PathLike[str], names: Sequence[str], curves: Callable[[str], Sequence[Polyline]], *, title: str
) -> Section:
    """As `photos_section`, with the curves of a photo asked for where it is shown: of many photos a page has room for some."""
    folder = pathlib.Path(photo_folder)
    return Section(title, lambda allowed_bytes: _render(lambda name: _read(folder / name), names, curves, allowed_bytes))


def pictures_section(
    names: Sequence[str], drawn: Callable[[str], UInt8[np.ndarray, "h w 3"]], said: str, title: str = "Pictures"
) -> Section:
    """Photos with what was found drawn over them already, under a sentence that says what is to be seen; `drawn` makes that of a
    photo. They are scaled and compressed to the page's limit, as those of `photos_section`."""
    return Section(title, lambda allowed_bytes: _render(drawn, list(dict.fromkeys(names)), lambda name: (), allowed_bytes, said))


def _render(
    read: Callable[[str], UInt8[np.ndarray, "h w 3"] | None],
    names: Sequence[str],
    curves: Callable[[str], Sequence[Polyline]],
    allowed_bytes: int,
    said: str | None = None,
) -> Markup:
    places = max(1, allowed_bytes // _SMALLEST_SHARE_BYTES)
    chosen = names if len(names) <= places else [names[k] for k in np.linspace(0, len(names) - 1, places).round().astype(int)]
    left_out = dict.fromkeys(set(names) - set(chosen), "no room in the page")
    left = allowed_bytes - sum(len(name.encode()) + 100 for name in names)
    photos, share_bytes = [], left // max(len(chosen), 1)

    def shrunk(name: str) -> _Shrunk | None:
        """A photo as it fits its share without curves."""
        pixels = read(name)
        return None if pixels is None else _Shrunk.to(share_bytes, pixels)

    for k, (name, shown) in enumerate(zip(chosen, ahead(shrunk, chosen, _AT_ONCE), strict=True)):
        if shown is None:
            left_out[name] = "it cannot be read"
            continue
        photo = _embed(name, shown, curves(name), left // (len(chosen) - k))
        if photo is None:
            left_out[name] = "no room in the page"
            continue
        photos.append(photo)
        left -= _size_bytes(photo)
    ordered = [(name, left_out[name]) for name in names if name in left_out]
    return fragment("photos", photos=photos, left_out=ordered, total=len(names), said=said)


def _read(path: pathlib.Path) -> UInt8[np.ndarray, "h w 3"] | None:
    """The photo in colours of 8 bits; None where there is none that can be read."""
    try:
        pixels = read_photo(path)
    except InputError:
        return None
    shown = eight_bits(pixels)
    return shown if shown.ndim == 3 else cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)


@dataclass
class _Shrunk:
    """A photo, and what it takes in the page at the first steps."""

    pixels: UInt8[np.ndarray, "h w 3"]
    uris: list[str]

    @staticmethod
    def to(most_bytes: int, pixels: UInt8[np.ndarray, "h w 3"]) -> "_Shrunk":
        """Down to the first step that takes `most_bytes` at most."""
        shown = _Shrunk(pixels, [])
        for step in range(len(_STEPS)):
            if len(shown.uri(step)) <= most_bytes:
                break
        return shown

    def width(self, step: int) -> int:
        """In pixels."""
        return min(self.pixels.shape[1], _STEPS[step][0])

    def uri(self, step: int) -> str:
        """The photo at a step, each asked for after the one before."""
        if step == len(self.uris):
            height, width = self.pixels.shape[:2]
            size = (self.width(step), max(1, round(height * self.width(step) / width)))
            scaled = self.pixels if size[0] == width else cv2.resize(self.pixels, size, interpolation=cv2.INTER_AREA)
            self.uris.append("data:image/jpeg;base64," + base64.b64encode(jpeg_of(scaled, _STEPS[step][1])).decode("ascii"))
        return self.uris[step]


def _embed(name: str, shown: _Shrunk, curves: Sequence[Polyline], share_bytes: int) -> _Photo | None:
    """The photo in at most `share_bytes` with its curves; None where even the smallest is larger."""
    height, width = shown.pixels.shape[:2]
    model = tuple((c.label, _line_path(c.pixels)) for c in curves if c.kind == "model")
    observed = tuple((c.label, _point_path(c.pixels)) for c in curves if c.kind != "model")
    points = sum(int(np.isfinite(c.pixels).all(1).sum()) for c in curves if c.kind != "model")
    # What the paths take does not depend on the size of the photo.
    photo = _Photo(name, (width, height), "", "", model, observed)
    left = share_bytes - _size_bytes(photo)
    for step in range(len(_STEPS)):
        uri = shown.uri(step)
        scale = "" if shown.width(step) == width else f", shown {shown.width(step)} px wide"
        caption = f"{width} × {height} px{scale}" + (f"; {points:,} observed points, {len(model):,} curves" if curves else "")
        if len(uri) <= left:
            return replace(photo, data_uri=uri, caption=caption)
    return None


def _size_bytes(photo: _Photo) -> int:
    """What the photo takes in the page: its data, its curves (an observed path is written twice) and the tags around them."""
    paths = sum(len(label.encode()) + len(path) + 80 for label, path in (*photo.model, *photo.observed, *photo.observed))
    return len(photo.data_uri) + paths + 4 * len(photo.name.encode()) + 800


def _line_path(pixels: Float[np.ndarray, "k 2"]) -> Markup:
    """SVG path through the points, lifted over those that are not finite."""
    known = np.isfinite(pixels).all(1)
    starts = known & ~np.concatenate([[False], known[:-1]])
    pen = "".join("M%.1f %.1f" if start else "L%.1f %.1f" for start in starts[known].tolist())
    return Markup(pen % tuple(pixels[known].ravel().tolist()))


def _point_path(pixels: Float[np.ndarray, "k 2"]) -> Markup:
    """SVG path of one dot per point: strokes of no length with round ends."""
    known = pixels[np.isfinite(pixels).all(1)]
    return Markup("M%.2f %.2fh0" * len(known) % tuple(known.ravel().tolist()))
