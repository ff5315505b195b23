"""What was found of a target in photos: how much, and which parts of the image are without."""

import numpy as np

from omnilines.calibration.lines.check import COLUMNS, ROWS
from omnilines.pages.limits import named, unused_advice
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.records import Advice, Summary


def corners_summary(found: PhotoCorners, table: str) -> Summary:
    """A row for each photo with corners; `table` is where they are."""
    corners = found.corners
    counts = np.bincount(corners.view, minlength=len(corners.images)).tolist()
    remarks = (f"; {remark}" if remark else "" for remark in found.remarks)
    rows = tuple((image, f"{n} corners{more}") for image, n, more in zip(corners.images, counts, remarks, strict=True))
    total = len(rows) + len(found.skipped)
    verdict = f"{len(corners)} corners in {len(rows)} of {total} photos."
    return Summary(
        f"Corners of {found.inputs['pattern']}",
        rows,
        (f"{len(corners)} corners in {table}",),
        of_photos=True,
        verdict=verdict,
        advice=(*unused_advice(found.skipped, total), *_bare(found)),
    )


def _bare(found: PhotoCorners) -> tuple[Advice, ...]:
    """Ninths of the image in which no photo has a corner."""
    column, row = np.clip(3 * (found.corners.pixels + 0.5) / np.array(found.image_size), 0, 2).astype(np.int64).T
    seen = set((3 * row + column).tolist())
    bare = [f"{ROWS[k // 3]} {COLUMNS[k % 3]}" for k in range(9) if k not in seen]
    if not bare:
        return ()
    return (Advice(f"No photo has a corner in the {named(bare)} of the image.", "Shoot photos with the board there."),)
