"""frames.csv: the frames of videos that were looked at, and why each was taken or not."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from camera_models.formats.disk import read_text, write_atomically
from omnilines.files.photos import Photo, PhotoArray
from omnilines.files.tables import Table, read_table

TABLE = "frames.csv"
LATEST_S = 1e9
"""Of a frame: some years."""
COLUMNS = ("image", "video", "frame", "time_s", "stamp_ns", "motion_px", "sharpness", "corners", "taken", "reason")


@dataclass(frozen=True)
class FrameRow:
    """A frame that was looked at closely."""

    image: str
    """Its name as a photo."""
    lens: int
    """Number of its camera."""
    index: int
    """From 0, within the video."""
    time_s: float
    """From the beginning."""
    stamp_ns: int | None
    """By the clock of a bag; None of a video."""
    motion_px: float
    """Speed of what it shows, in px from this frame to the faster of its neighbours, root mean square over the image."""
    sharpness: float
    """Standard deviation of the Laplacian, grey levels."""
    corners: int
    """Of the target, where one was looked for."""
    taken: bool
    reason: str
    """Why it was taken, or was not."""


def read_times(folder: str | Path) -> dict[str, float]:
    """When each photo in a folder was taken, by its name, where the folder holds a `frames.csv` with these columns; else nothing.

    Raises InputError where a time in it is not a finite number.
    """
    table = _beside(folder)
    if table is None:
        return {}
    image, images = table.names("image")
    return {images[k]: time_s for k, time_s in zip(image.tolist(), table.within(LATEST_S, "time_s")[:, 0].tolist(), strict=True)}


def read_stamps(folder: str | Path) -> dict[str, int]:
    """The stamp (ns) of each photo in a folder, by its name, where the folder holds a `frames.csv` that has them, as those of
    bags do. Raises InputError where one is no number."""
    table = _beside(folder)
    if table is None:
        return {}
    image, images = table.names("image")
    stamps_ns = table.numbers_or_nan("stamp_ns")[:, 0].tolist()
    return {images[k]: int(stamp) for k, stamp in zip(image.tolist(), stamps_ns, strict=True) if not math.isnan(stamp)}


def _beside(folder: str | Path) -> Table | None:
    """The table in a folder, if it is one of frames."""
    path = Path(folder) / TABLE
    if not path.is_file() or read_text(path).split("\n", 1)[0].strip() != ",".join(COLUMNS):
        return None
    return read_table(path, COLUMNS)


def times_of(photos: Sequence[Photo], folder: Path | None) -> dict[str, float]:
    """When photos were taken, by their names, of those of which it is known: frames in memory, and what `read_times` says of a
    folder."""
    beside = {} if folder is None else read_times(folder)
    return beside | {one.name: one.time_s for one in photos if isinstance(one, PhotoArray) and one.time_s is not None}


def write_frames(path: str | Path, rows: Sequence[FrameRow], videos: Sequence[str]) -> None:
    """Write the table; `videos` are the names of the files of its cameras. Raises InputError where it cannot be written."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        stamp = "" if row.stamp_ns is None else row.stamp_ns
        measures = (f"{row.time_s:.6f}", stamp, f"{row.motion_px:.3f}", f"{row.sharpness:.3f}", row.corners)
        writer.writerow((row.image, videos[row.lens], row.index, *measures, "yes" if row.taken else "no", row.reason))
    write_atomically(path, text.getvalue())
