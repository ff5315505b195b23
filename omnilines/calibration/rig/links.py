"""What ties the cameras of a rig together: which pairs see the same board at once, how well, and the weakest link."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from camera_models.pose import Pose, adjoint, hat


@dataclass(frozen=True)
class Link:
    """Two cameras that see the target at the same instants."""

    first: int
    second: int
    frames: int
    """Frames in which both see the target."""
    corners: int
    """Corners that both see, over these frames."""
    rms_px_per_point: float
    """Over the corners of both cameras in these frames."""
    baseline_m: float
    baseline_sigma_m: float
    rotation_sigma_deg: float
    """Standard deviation of the relative rotation about its least certain axis."""
    translation_sigma_m: float
    """Standard deviation of the place of the second camera, in the frame of the first, in its least certain direction."""


def links(
    camera: Int[np.ndarray, " n"],
    frame: Int[np.ndarray, " n"],
    place: Int[np.ndarray, "n d"],
    residual_px: Float[np.ndarray, "n 2"],
    *,
    cam_from_rig: Pose,
    covariance: Float[Tensor, "k k"],
) -> tuple[Link, ...]:
    """All pairs with a common frame. Of every corner used: camera, frame, what it is on the target (board and position), and
    residual; `covariance` is that of the poses of all cameras, 6 each."""
    found = []
    frames = [np.unique(frame[camera == c]) for c in range(len(cam_from_rig))]
    keys = _numbers(np.column_stack([frame, place]))
    for first, second in itertools.combinations(range(len(cam_from_rig)), 2):
        common = np.intersect1d(frames[first], frames[second])
        if not len(common):
            continue
        shared = np.isin(frame, common)
        both = shared & np.isin(camera, (first, second))
        relative, spread = relative_pose(cam_from_rig, covariance, first, second)
        placed = translation_covariance(relative, spread)
        baseline = relative.translation.norm()
        along = relative.translation / baseline.clamp_min(1e-300)
        worst = [math.sqrt(max(0.0, float(torch.linalg.eigvalsh(block)[-1]))) for block in (spread[:3, :3], placed)]
        found.append(
            Link(
                first=first,
                second=second,
                frames=len(common),
                corners=len(np.intersect1d(keys[camera == first], keys[camera == second])),
                rms_px_per_point=float(np.sqrt((residual_px[both] ** 2).sum(-1).mean())),
                baseline_m=float(baseline),
                baseline_sigma_m=math.sqrt(max(0.0, float(along @ placed @ along))),
                rotation_sigma_deg=math.degrees(worst[0]),
                translation_sigma_m=worst[1],
            )
        )
    return tuple(found)


def _numbers(rows: Int[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
    """A number for each row, the same for equal rows."""
    found = np.zeros(len(rows), dtype=np.int64)
    for column in rows.T:
        values, index = np.unique(column, return_inverse=True)
        # Numbers stay below the count of rows: products do not overflow.
        found = np.unique(found * len(values) + index, return_inverse=True)[1].astype(np.int64)
    return found


def relative_pose(
    cam_from_rig: Pose, covariance: Float[Tensor, "k k"], first: int, second: int
) -> tuple[Pose, Float[Tensor, "6 6"]]:
    """The pose of the second camera's frame in the first's, first_from_second, and its covariance (left perturbation):
    with T = T1 T2^-1, d = d1 - Ad(T) d2."""
    pose = cam_from_rig[first] @ cam_from_rig[second].inverse()
    jacobian = torch.zeros(6, len(covariance), dtype=torch.float64)
    jacobian[:, 6 * first : 6 * first + 6] = torch.eye(6, dtype=torch.float64)
    jacobian[:, 6 * second : 6 * second + 6] -= adjoint(pose)
    return pose, jacobian @ covariance @ jacobian.mT


def translation_covariance(pose: Pose, covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "3 3"]:
    """Of the translation t of a pose from that of its left perturbation (w, v), which moves it by w x t + v."""
    jacobian = torch.cat([-hat(pose.translation), torch.eye(3, dtype=torch.float64)], -1)
    return jacobian @ covariance @ jacobian.mT


def weakest_link(found: Sequence[Link], cameras: int) -> Link | None:
    """The link with the fewest common corners among those that the rig hangs on: of all ways to tie the cameras together by as
    many common corners as can be (a maximum spanning tree; J. Kruskal 1956), the one with the fewest; None where boards tie
    cameras that never see one at the same time."""
    group = list(range(cameras))
    weakest = None
    for link in sorted(found, key=lambda item: (-item.corners, -item.frames)):
        a, b = group[link.first], group[link.second]
        if a != b:
            group = [a if g == b else g for g in group]
            weakest = link
    return weakest
