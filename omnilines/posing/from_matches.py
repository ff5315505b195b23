"""Poses of photos from given matches of points and calibrated cameras: two photos, then one after the other, then all together.

1. The pair of photos with most points, counted by their parallax, gives the first two poses (five-point algorithm with RANSAC,
   D. Nister 2004, of OpenCV) and their points.
2. Of the others, the photo that sees most known points is resected from them (`resection.py`); points that two photos see then
   are found and poses and points refined together (`point_adjustment.py`).
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from camera_models import GeometryError
from camera_models.pose import Pose
from omnilines.posing.bearing_residual import across
from omnilines.posing.options import GivenOptions, PosingOptions, ResectionOptions
from omnilines.posing.point_adjustment import Adjusted, Frames, PosesAndPoints, adjust_points
from omnilines.posing.resection import resect
from omnilines.posing.tracks import Observations


def poses_from_matches(
    bearings: Float[np.ndarray, "n 3"],
    photo: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    sigma_rad: Float[np.ndarray, " n"],
    options: PosingOptions = PosingOptions(),
) -> Pose:
    """`cam_from_world` of all photos, numbered from 0: the first photo is the world, the scale is open.

    Row i sees point `point[i]` from `photo[i]` along a unit bearing, with a standard deviation in either direction across it.
    Bearings of the first pair have to lie before their cameras (z > 0). Raises GeometryError where photos share too few points.
    """
    its = options.given
    b, sigma = torch.as_tensor(bearings), torch.as_tensor(sigma_rad)
    seen = Observations(torch.as_tensor(photo), torch.arange(len(b)), torch.as_tensor(point), b, across(b) / sigma[:, None, None])
    photos = int(photo.max()) + 1
    first, second, pose = _first_pair(seen, float(np.median(sigma_rad)), photos, its)
    poses, known = [Pose.identity() for _ in range(photos)], torch.zeros(photos, dtype=torch.bool)
    poses[second], known[[first, second]] = pose, True
    adjusted = _together(seen, poses, known, options.resection)
    while not bool(known.all()):
        points, found = _points(seen, adjusted.state.rig_from_world, known)
        usable = found[seen.point] & ~known[seen.photo]
        count = torch.bincount(seen.photo[usable], minlength=photos)
        following = int(count.argmax())
        if int(count[following]) < its.min_common:
            raise GeometryError(
                f"At least {its.min_common} points were expected that photo {following} shares with the photos that have a pose, "
                f"found {int(count[following])}; give more matches."
            )
        rows = torch.nonzero(usable & (seen.photo == following)).flatten()
        spread = its.ransac_sigmas * sigma[rows].numpy()
        resected = resect(b[rows].numpy(), points[seen.point[rows]].numpy(), spread, options=options.resection)
        poses = [adjusted.state.rig_from_world[k] for k in range(photos)]
        poses[following], known[following] = resected.pose, True
        adjusted = _together(seen, poses, known, options.resection)
    whole = adjusted.state.rig_from_world
    return whole @ whole[:1].inverse()


def _first_pair(seen: Observations, sigma_rad: float, photos: int, options: GivenOptions) -> tuple[int, int, Pose]:
    """Two photos and the pose of the second in the frame of the first, with a baseline of 1."""
    best, answer = 0.0, None
    for i in range(photos):
        for j in range(i + 1, photos):
            found = _relative(*_common(seen, i, j), sigma_rad, options)
            if found is not None and found[1] > best:
                best, answer = found[1], (i, j, found[0])
    if answer is None:
        raise GeometryError(
            f"Two photos with {options.min_common} points of one scene in common were expected, found none; give more."
        )
    return answer


def _common(seen: Observations, i: int, j: int) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """Bearings in two photos of the points that both see."""
    rows = [torch.nonzero(seen.photo == k).flatten() for k in (i, j)]
    _, a, b = np.intersect1d(seen.point[rows[0]].numpy(), seen.point[rows[1]].numpy(), return_indices=True)
    return seen.bearings[rows[0][a]].numpy(), seen.bearings[rows[1][b]].numpy()


def _relative(
    a: Float[np.ndarray, "m 3"], b: Float[np.ndarray, "m 3"], sigma_rad: float, options: GivenOptions
) -> tuple[Pose, float] | None:
    """The pose of the second photo in the frame of the first, and the sum of the parallax of the points that agree."""
    if len(a) < options.min_common:
        return None
    left, right = a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:]
    within = options.ransac_sigmas * sigma_rad
    essential, inlier = cv2.findEssentialMat(left, right, np.eye(3), cv2.RANSAC, 0.9999, within)
    if essential is None or essential.shape != (3, 3):
        return None
    count, rotation, translation, inlier = cv2.recoverPose(essential, left, right, np.eye(3), mask=inlier)
    good = inlier.ravel() > 0
    if count < options.min_common:
        return None
    turned = a[good] @ rotation.T
    parallax = np.arctan2(np.linalg.norm(np.cross(turned, b[good]), axis=1), (turned * b[good]).sum(1))
    return Pose.of(rotation, translation.ravel()), float(np.minimum(parallax, options.enough_parallax_rad).sum())


def _points(seen: Observations, poses: Pose, known: Bool[Tensor, " v"]) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, " p"]]:
    """The points nearest to the rays of the photos with a pose, and which two of these see: sum (I - r r') (X - C) = 0."""
    rows = torch.nonzero(known[seen.photo]).flatten()
    own = poses[seen.photo[rows]]
    ray = (own.rotation.mT @ seen.bearings[rows, :, None])[..., 0]
    off = torch.eye(3, dtype=torch.float64) - ray[:, :, None] * ray[:, None]
    count = int(seen.point.max()) + 1
    normal = torch.zeros(count, 3, 3, dtype=torch.float64).index_add_(0, seen.point[rows], off)
    right = torch.zeros(count, 3, dtype=torch.float64).index_add_(0, seen.point[rows], (off @ own.centre[..., None])[..., 0])
    found = torch.bincount(seen.point[rows], minlength=count) >= 2
    eye = torch.eye(3, dtype=torch.float64)
    return torch.linalg.solve(torch.where(found[:, None, None], normal, eye), right), found


def _together(seen: Observations, poses: list[Pose], known: Bool[Tensor, " v"], options: ResectionOptions) -> Adjusted:
    """Poses that are known and the points that they see, refined."""
    start = Pose.stack(poses)
    points, found = _points(seen, start, known)
    number = torch.cumsum(found.long(), 0) - 1
    rows = torch.nonzero(known[seen.photo] & found[seen.point]).flatten()
    own = seen.chosen(rows)
    inner = Observations(own.photo, own.feature, number[own.point], own.bearings, own.rows)
    frames = Frames(torch.arange(len(start)), Pose.identity(len(start)))
    try:
        return adjust_points(inner, frames, PosesAndPoints(start, points[found]), options)
    except np.linalg.LinAlgError:
        raise GeometryError(
            "Point matches that determine the poses of their photos were expected, found some that do not; check the matches."
        ) from None
