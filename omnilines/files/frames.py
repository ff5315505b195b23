"""frames.csv: the frames of videos that were looked at, and why each was taken or not."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from camera_models.formats.disk import write_atomically

COLUMNS = ("image", "video", "frame", "time_s", "motion_px", "sharpness", "corners", "taken", "reason")


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
    motion_px: float
    """Speed of what it shows, in px from this frame to the faster of its neighbours, root mean square over the image."""
    sharpness: float
    """Standard deviation of the Laplacian, grey levels."""
    corners: int
    """Of the target, where one was looked for."""
    taken: bool
    reason: str
    """Why it was taken, or was not."""


def write_frames(path: str | Path, rows: Sequence[FrameRow], videos: Sequence[str]) -> None:
    """Write the table; `videos` are the names of the files of its cameras. Raises InputError where it cannot be written."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        measures = (f"{row.time_s:.4f}", f"{row.motion_px:.3f}", f"{row.sharpness:.3f}", row.corners)
        writer.writerow((row.image, videos[row.lens], row.index, *measures, "yes" if row.taken else "no", row.reason))
    write_atomically(path, text.getvalue())
