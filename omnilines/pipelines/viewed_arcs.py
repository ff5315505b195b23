"""The arcs of photos with poses, as matching and as the tables of a scene use them."""

from collections.abc import Sequence

import numpy as np
import torch

from camera_models import Calibration, GeometryError
from omnilines.matching.arcs import ViewedArcs
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.records import ImagePoses, Segments


def in_order(found: Sequence[FoundArcs], poses: ImagePoses) -> list[FoundArcs]:
    """The photos that have arcs and a pose, in the order of the poses."""
    place = {name: k for k, name in enumerate(poses.images)}
    posed = (arcs for arcs in found if arcs.reason is None and arcs.photo.name in place)
    return sorted(posed, key=lambda arcs: place[arcs.photo.name])


def viewed_arcs(found: Sequence[FoundArcs], poses: ImagePoses, cameras: Calibration) -> ViewedArcs:
    """The arcs of all photos that have a pose as bearings, photos in the order of their poses.

    Raises GeometryError where there are none.
    """
    found = in_order(found, poses)
    if not sum(map(len, found)):
        raise GeometryError(
            f"Arcs of straight lines were expected, found none in {len(found)} photos with poses; see their pictures."
        )
    place = {name: k for k, name in enumerate(poses.images)}
    bearings, by_pixel = [], []
    with torch.no_grad():
        for arcs in found:
            ends = torch.as_tensor(arcs.endpoints_px)
            bearings.append(cameras[arcs.camera].unproject(ends)[0].numpy())
            by_pixel.append(cameras[arcs.camera].unproject_jacobian(ends).numpy())
    return ViewedArcs(
        np.repeat(np.array([place[arcs.photo.name] for arcs in found], dtype=np.int64), [len(arcs) for arcs in found]),
        poses.cam_from_world,
        np.concatenate(bearings),
        np.concatenate(by_pixel),
        np.concatenate([arcs.covariance_px2 for arcs in found]),
        np.concatenate([arcs.colours for arcs in found]),
    )


def segments_of(found: Sequence[FoundArcs], poses: ImagePoses) -> Segments:
    """The same arcs as a table of segments without tracks."""
    found = in_order(found, poses)
    pixels = np.concatenate([arcs.endpoints_px for arcs in found])
    return Segments(
        np.repeat(np.arange(len(found)), [len(arcs) for arcs in found]),
        tuple(arcs.photo.name for arcs in found),
        np.full(len(pixels), -1),
        (),
        pixels,
        covariance_px2=np.concatenate([arcs.covariance_px2 for arcs in found]),
        cameras=tuple(arcs.camera for arcs in found),
    )
