"""Photos that show what another one shows from the same place, as those of a burst, or of a video while the camera stands.

They say nothing of distances, and would count twice: two planes always meet in a line, which two photos of each place would
then confirm. Such are photos whose arcs lie where those of the other do, as seen in the world, and whose distance from it would
not move what they see by a pixel or two.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from camera_models import Calibration
from omnilines.matching.arcs import ViewedArcs
from omnilines.pipelines.arcs import skipped
from omnilines.pipelines.options import SamePlaceOptions
from omnilines.pipelines.photo_arcs import PhotoArcs, in_order, viewed_arcs
from omnilines.pipelines.still_camera import NEAR_PX, lies_near
from omnilines.posing.photo_poses import PhotoPoses
from omnilines.records import ImagePoses

_SAME_PLACE = "shows from the same place, which tells no distances."
ARCS = 300
"""Of each photo that are compared."""
LEAST_PLACES = 3
"""That lines are seen from."""


def is_same_place(reason: str) -> bool:
    """Whether a photo is left out for that reason of `without_same_place`."""
    return reason.endswith(_SAME_PLACE)


def without_same_place(
    arcs: PhotoArcs,
    posed: PhotoPoses,
    cameras: Calibration,
    options: SamePlaceOptions = SamePlaceOptions(),
    asked: Collection[str] = (),
) -> tuple[PhotoArcs, PhotoPoses]:
    """The photos with those skipped that show what another shows from the same place, and the poses of the others. The first of
    them stays, or one of `asked`. Where fewer than LEAST_PLACES are left, none is skipped: what is wrong is said of all."""
    found = [one for one in in_order(arcs.photos, posed.poses) if len(one)]
    if len(found) < 2:
        return arcs, posed
    whole, reasons = viewed_arcs(found, posed.poses, cameras), dict[str, str]()
    near = _nearness_px(whole, posed.poses) < options.near_px
    kept = list[int]()
    first = sorted(found, key=lambda one: one.photo.name not in asked)
    for row in (posed.poses.images.index(one.photo.name) for one in first):
        same = next((other for other in kept if near[row, other] and _shown(whole, row, other) >= options.shown), None)
        if same is None:
            kept.append(row)
        else:
            names = posed.poses.images[row], posed.poses.images[same]
            reasons[names[0]] = f"It shows what {names[1]} {_SAME_PLACE}"
    if not reasons or len(kept) < LEAST_PLACES:
        return arcs, posed
    photos = [
        skipped(one.photo, one.camera, why) if (why := reasons.get(one.photo.name)) is not None else one for one in arcs.photos
    ]
    poses = _some(posed.poses, [k for k, name in enumerate(posed.poses.images) if name not in reasons])
    return replace(arcs, photos=tuple(photos)), replace(posed, poses=poses)


def _nearness_px(arcs: ViewedArcs, poses: ImagePoses) -> Float[np.ndarray, "n n"]:
    """By how much the distance of two photos would move, in the image, what is as far away as the photos are from their middle
    (root mean square)."""
    centre = poses.cam_from_world.centre
    spread = float((centre - centre.mean(0)).norm(dim=-1).square().mean().sqrt())
    px_rad = float(np.median(arcs.px_rad))
    return (torch.cdist(centre, centre) / max(spread, 1e-300) / px_rad).numpy()


def _shown(arcs: ViewedArcs, photo: int, other: int) -> float:
    """Share of the arcs of a photo that another one shows where they are."""
    own, there = (np.flatnonzero(arcs.image == k) for k in (photo, other))
    own = own[:: 1 + len(own) // ARCS]
    near_rad = NEAR_PX * float(np.median(arcs.px_rad[own]))
    seen, others = (arcs.bearings[some] @ arcs.poses[k].rotation.numpy() for some, k in ((own, photo), (there, other)))
    return float(lies_near(seen, others, near_rad).mean())


def _some(poses: ImagePoses, rows: list[int]) -> ImagePoses:
    named = (None if names is None else tuple(names[k] for k in rows) for names in (poses.cameras, poses.frames))
    cameras, frames = named
    covariance = None if poses.covariance is None else poses.covariance[rows]
    return ImagePoses(tuple(poses.images[k] for k in rows), poses.cam_from_world[rows], cameras, covariance, frames)
