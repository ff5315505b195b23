"""Photos that are copies of others: the same shot twice confirms nothing, and would count twice."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from omnilines.pipelines.arcs import skipped
from omnilines.pipelines.photo_arcs import PhotoArcs


def copies(names: Sequence[str], pixels: Sequence[Float[np.ndarray, "_ *_"]]) -> list[str | None]:
    """Of each photo why it is left out, None where it is not: all that was found in it lies at exactly the same pixels as in one
    before it. Two shots differ by their noise; photos in which nothing was found are no copies."""
    first = dict[bytes, str]()
    reasons = list[str | None]()
    for name, own in zip(names, pixels, strict=True):
        before = first.setdefault(own.tobytes(), name)
        copied = own.size and before != name
        reasons.append(f"It is a copy of {before}, and would count twice." if copied else None)
    return reasons


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
