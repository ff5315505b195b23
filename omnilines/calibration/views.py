"""The views of a calibration: which can be used, what became of each, and the corners as tensors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from camera_models import InputError
from camera_models.pose import Pose
from camera_models.wording import rounded
from omnilines.calibration.initialise import BoardPoints
from omnilines.calibration.thresholds import ViewThresholds
from omnilines.records import Corners, ViewResult


def board_points(corners: Corners, rows: Bool[np.ndarray, " n"], views: list[int]) -> BoardPoints:
    """The chosen rows as tensors, their views renumbered to positions in `views`."""
    place = np.full(len(corners.view_names), -1)
    place[views] = np.arange(len(views))
    return BoardPoints(
        torch.as_tensor(place[corners.view[rows]]),
        len(views),
        torch.as_tensor(corners.board_m[rows]),
        torch.as_tensor(corners.pixels[rows]),
    )


def corner_weights(corners: Corners, rows: Bool[np.ndarray, " n"]) -> Float[Tensor, " m"] | None:
    """Inverse standard deviations relative to their rms, so that residuals stay pixels; None where none are given."""
    if corners.sigma_px is None:
        return None
    sigma = torch.as_tensor(corners.sigma_px[rows])
    return (sigma**2).mean().sqrt() / sigma


def stated_rms_px(corners: Corners, rows: Bool[np.ndarray, " n"]) -> float:
    """Root mean square of their stated standard deviations, to which weights are relative; 0 where none are given."""
    return 0.0 if corners.sigma_px is None else float(np.sqrt(np.mean(corners.sigma_px[rows] ** 2)))


@dataclass(frozen=True)
class UsableCorners:
    """The corners of the views that can be used whatever the camera is."""

    corners: Corners
    refusals: Mapping[int, str]
    """Why the other views cannot."""
    views: list[int]
    rows: Bool[np.ndarray, " n"]
    points: BoardPoints
    weight: Float[Tensor, " m"] | None
    stated_px: float
    """Of weight 1."""

    @staticmethod
    def of(corners: Corners, thresholds: ViewThresholds) -> "UsableCorners":
        """Raises InputError for too few views."""
        refusals = unusable_views(corners, thresholds.least_corners)
        views = [v for v in range(len(corners.view_names)) if v not in refusals]
        require_views(len(views), len(corners.view_names), refusals, thresholds.least_views)
        rows = np.isin(corners.view, views)
        return UsableCorners(
            corners=corners,
            refusals=refusals,
            views=views,
            rows=rows,
            points=board_points(corners, rows, views),
            weight=corner_weights(corners, rows),
            stated_px=stated_rms_px(corners, rows),
        )


def unusable_views(corners: Corners, least_corners: int, rows: Bool[np.ndarray, " n"] | None = None) -> dict[int, str]:
    """Views that cannot be used whatever the camera is, each with its reason; by the corners of `rows` only, where given."""
    views = len(corners.view_names)
    view, board = (corners.view, corners.board_m) if rows is None else (corners.view[rows], corners.board_m[rows])
    counts = np.bincount(view, minlength=views)
    share = np.maximum(counts, 1)[:, None]
    mean = np.stack([np.bincount(view, board[:, k], views) for k in (0, 1)], -1) / share
    x, y = (board[:, :2] - mean[view]).T
    xx, xy, yy = (np.bincount(view, product, views) for product in (x * x, x * y, y * y))
    # On one line where the smaller principal moment vanishes beside the larger.
    on_line = xx * yy - xy**2 <= 1e-12 * (xx + yy) ** 2
    raised = np.bincount(view, board[:, 2] != 0, views) > 0
    refusals = {}
    for v in np.flatnonzero((counts < least_corners) | on_line | raised):
        if counts[v] < least_corners:
            refusals[int(v)] = f"only {counts[v]} corners, at least {least_corners} are needed"
        elif on_line[v]:
            refusals[int(v)] = "all its corners lie on one line of the board"
        else:
            refusals[int(v)] = "its corners do not lie in the plane z = 0 of the board"
    return refusals


def views_lost(
    corners: Corners, rows: Bool[np.ndarray, " n"], kept: Bool[np.ndarray, " n"], least_corners: int
) -> dict[int, str]:
    """Of the views with corners in `rows`, those that cannot be used with the corners `kept` that fit the camera, and why."""
    count = len(corners.view_names)
    seen, used = (np.bincount(corners.view[chosen], minlength=count) for chosen in (rows, kept))
    unusable = unusable_views(corners, least_corners, kept)
    lost = {v: f"of the corners that fit the camera: {reason}" for v, reason in unusable.items() if seen[v]}
    wrong = "more than half of its corners do not fit the camera (wrong detection or numbering)"
    return lost | {int(v): wrong for v in np.flatnonzero(2 * used < seen)}


def require_views(found: int, total: int, refusals: Mapping[int, str], least_views: int) -> None:
    """Raise InputError where too few views are left, with the reason that the first was dropped for."""
    if found < least_views:
        why = f" ({len(refusals)} of {total} dropped, the first because {next(iter(refusals.values()))})" if refusals else ""
        raise InputError(
            f"Too few views: a calibration needs at least {least_views}, found {found}{why}; "
            "add photos of the board at other angles."
        )


def view_results(
    corners: Corners,
    kept: Bool[np.ndarray, " n"],
    views: list[int],
    residual_px: Float[np.ndarray, "n 2"],
    poses: Pose,
    *,
    refusals: Mapping[int, str],
    leverage: Float[Tensor, " v"],
    limit_px: float | None,
    many_rejected_share: float,
) -> tuple[ViewResult, ...]:
    """One record a view, used or not; `limit_px` is the distance beyond which corners were rejected."""
    count = len(corners.view_names)
    seen = np.bincount(corners.view, minlength=count)
    used = np.bincount(corners.view[kept], minlength=count)
    squares = np.bincount(corners.view[kept], (residual_px[kept] ** 2).sum(-1), count)
    place = {v: k for k, v in enumerate(views)}
    results = []
    for v, (name, image) in enumerate(zip(corners.view_names, corners.images, strict=True)):
        result = ViewResult(
            name=name, image=image, used=v in place, reason=refusals.get(v), corners_used=0, corners_rejected=int(seen[v])
        )
        if v in place:
            rejected = int(seen[v] - used[v])
            remarks: tuple[str, ...] = ()
            if rejected > many_rejected_share * seen[v] and limit_px is not None:
                remarks = (
                    f"{rejected} of {seen[v]} corners rejected: more than {rounded(limit_px)} px from where the camera sees them",
                )
            result = replace(
                result,
                corners_used=int(used[v]),
                corners_rejected=rejected,
                rms_px_per_point=float(np.sqrt(squares[v] / used[v])),
                cam_from_board=poses[place[v]],
                leverage=float(leverage[place[v]]),
                remarks=remarks,
            )
        results.append(result)
    return tuple(results)
