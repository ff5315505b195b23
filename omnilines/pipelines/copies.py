"""Photos that are copies of others: the same shot twice confirms nothing, and would count twice."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from camera_models.wording import listed
from omnilines.calibration.rig.views import views_of
from omnilines.pipelines.arcs import skipped
from omnilines.pipelines.photo_arcs import PhotoArcs
from omnilines.pipelines.photo_corners import PhotoCorners
from omnilines.records import Segments, ViewResult

_COPY = "It is a copy of "


def copies(names: Sequence[str], pixels: Sequence[Float[np.ndarray, "_ *_"]]) -> list[str | None]:
    """Of each photo why it is left out, None where it is not: all that was found in it lies at exactly the same pixels as in one
    before it. Two shots differ by their noise; photos in which nothing was found are no copies."""
    first = dict[bytes, str]()
    reasons = list[str | None]()
    for name, own in zip(names, pixels, strict=True):
        before = first.setdefault(own.tobytes(), name)
        copied = own.size and before != name
        reasons.append(f"{_COPY}{before}, and would count twice." if copied else None)
    return reasons


def is_copy(reason: str | None) -> bool:
    """Whether a photo is left out for that reason of `copies`."""
    return reason is not None and reason.startswith(_COPY)


def without_copies(arcs: PhotoArcs, posed: Collection[str] = ()) -> PhotoArcs:
    """The photos with those skipped that are copies of others of the same camera; of copies the first of `posed` stays, those
    whose poses are known."""
    reason, known = dict[str, str | None](), set(posed)
    for camera in arcs.cameras:
        own = sorted((one for one in arcs.used if one.camera == camera), key=lambda one: one.photo.name not in known)
        names = [one.photo.name for one in own]
        reason |= zip(names, copies(names, [one.endpoints_px for one in own]), strict=True)
    photos = [one if (why := reason.get(one.photo.name)) is None else skipped(one.photo, one.camera, why) for one in arcs.photos]
    return replace(arcs, photos=tuple(photos))


def copied_segments(segments: Segments) -> tuple[str, ...]:
    """A sentence where photos of a table of matched segments have all of them at exactly the pixels of another photo."""
    matched = np.flatnonzero(segments.track >= 0)
    rows = np.column_stack([segments.image, segments.track, segments.endpoints_px.reshape(-1, 4)])[matched]
    rows = rows[np.lexsort(rows.T[::-1])]
    photos = np.split(rows[:, 1:], np.searchsorted(rows[:, 0], np.arange(1, len(segments.images))))
    found = copies(segments.images, photos)
    named = [name for name, reason in zip(segments.images, found, strict=True) if reason is not None]
    if not named:
        return ()
    has, counts = ("has", "counts") if len(named) == 1 else ("have", "count")
    return (
        f"{listed(named)} {has} exactly the segments of another photo, and {counts} as one of its own: copies make lines seem "
        "more certain than they are; leave them out.",
    )


def corners_without_copies(found: PhotoCorners) -> PhotoCorners:
    """The corners with those photos, or views of a table, skipped that are copies of others."""
    corners = found.corners
    pixels = [corners.pixels[corners.view == view] for view in range(len(corners.view_names))]
    reasons = copies(corners.view_names, pixels)
    stays = np.array([reason is None for reason in reasons], dtype=bool)
    if stays.all():
        return found
    rows, times_s = stays[corners.view], corners.times_s
    left_out = [
        ViewResult(name, image, False, reason)
        for name, image, reason in zip(corners.view_names, corners.images, reasons, strict=True)
        if reason is not None
    ]
    names = {view.image for view in left_out}
    return replace(
        found,
        corners=replace(views_of(corners, np.flatnonzero(stays), rows), times_s=None if times_s is None else times_s[stays]),
        skipped=(*found.skipped, *left_out),
        blur_px=None if found.blur_px is None else found.blur_px[rows],
        photos=tuple(photo for photo in found.photos if photo.name not in names),
    )
