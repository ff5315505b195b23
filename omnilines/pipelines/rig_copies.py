"""Photos of a rig that are there twice: under the names of two cameras, or under two names of one camera.

Two mounted cameras never see a board at the same pixels. A copy ties them together as no measurement does, and which of them
took it is not known, so that neither view is used. Of copies within one camera the first is used, as of one alone (`copies.py`).
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from camera_models import InputError
from omnilines.calibration.duplicates import duplicate_views
from omnilines.calibration.rig.views import views_of
from omnilines.calibration.thresholds import DuplicateThresholds
from omnilines.pipelines.copies import copies
from omnilines.pipelines.detect_rig import corners_of_cameras
from omnilines.pipelines.rig_corners import CameraCorners, RigCorners
from omnilines.records import Corners, ViewResult


def rig_without_copies(
    found: RigCorners, least_views: Mapping[str, int], thresholds: DuplicateThresholds, *, in_cameras: bool
) -> RigCorners:
    """The corners without views that are copies of those of other cameras and, with `in_cameras`, of their own, each with its
    reason. `least_views` are those that each camera needs.

    Raises InputError where views under the names of two cameras are the same and leave one of them fewer.
    """
    corners = found.corners
    pairs = _of_two_cameras(corners, thresholds)
    if len(pairs):
        _require_own(corners, pairs, least_views)
    reasons = _within_cameras(corners) if in_cameras else {}
    for pair in pairs.tolist():
        for view, other in (pair, pair[::-1]):
            reasons[view] = (
                f"it shows the board at the same pixels as {corners.images[other]} of another camera, and which of the two took "
                "it is not known; give each camera its own photo"
            )
    # Of a photo that is a copy no other board is used either.
    photos = list(zip(corners.cameras or ("",) * len(corners.images), corners.images, strict=True))
    of_photo = {photos[v]: reason for v, reason in reasons.items()}
    reasons |= {v: of_photo[photo] for v, photo in enumerate(photos) if photo in of_photo and v not in reasons}
    return _without(found, reasons) if reasons else found


def _of_two_cameras(corners: Corners, thresholds: DuplicateThresholds) -> Int[np.ndarray, "p 2"]:
    """Pairs of views of two cameras that show a board at the same pixels, to within `least_tolerance_px`: of a board that rests,
    which looks alike in many views of a camera, those that are nearest to each other."""
    camera = np.unique(corners.cameras or ("",) * len(corners.view_names), return_inverse=True)[1]
    alike: dict[int, list[int]] = {}
    for first, later in duplicate_views(corners, 0.0, thresholds) if camera.any() else ():
        alike.setdefault(first, [first]).append(later)
    found: list[tuple[int, int]] = []
    for group in alike.values():
        views = np.array(group)
        for one, other in combinations(np.unique(camera[views]).tolist(), 2):
            here, there = views[camera[views] == one], views[camera[views] == other]
            apart = _apart_px(corners, here, there)
            back = apart.argmin(0)
            found += [(here[k], there[j]) for k, j in enumerate(apart.argmin(1)) if back[j] == k]
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


def _apart_px(corners: Corners, here: Int[np.ndarray, " a"], there: Int[np.ndarray, " b"]) -> Float[np.ndarray, "a b"]:
    """Root mean square distance of the corners that views have in common; infinite where there are none."""
    rows = np.isin(corners.view, [*here, *there])
    _, corner = np.unique(np.round(corners.board_m[rows], 8), axis=0, return_inverse=True)
    corner = corner.reshape(-1)
    table: Float[np.ndarray, "views corners 2"] = np.full((len(here) + len(there), int(corner.max()) + 1, 2), np.nan)
    place = {int(view): k for k, view in enumerate([*here, *there])}
    table[[place[v] for v in corners.view[rows].tolist()], corner] = corners.pixels[rows]
    apart = np.empty((len(here), len(there)))
    for k, own in enumerate(table[: len(here)]):
        squares = ((table[len(here) :] - own) ** 2).sum(-1)
        both = np.isfinite(squares)
        apart[k] = np.where(both.any(1), np.sqrt(np.nansum(squares, 1) / np.maximum(both.sum(1), 1)), np.inf)
    return apart


def _require_own(corners: Corners, pairs: Int[np.ndarray, "p 2"], least_views: Mapping[str, int]) -> None:
    assert corners.cameras is not None
    cameras = np.array(corners.cameras)
    copied = np.isin(np.arange(len(cameras)), pairs)
    for name, least in least_views.items():
        of_camera = cameras == name
        if of_camera.sum() < least or (of_camera & ~copied).sum() >= least:
            continue
        own = pairs[(cameras[pairs] == name).any(1)]
        first, second = cameras[own[0]]
        same = (np.sort(cameras[own], 1) == np.sort([first, second])).all(1)
        one, other = (corners.images[v] for v in own[0])
        raise InputError(
            f"The cameras {first} and {second} were expected to have photos of their own, found the board at the same pixels in "
            f"{int(same.sum())} photos of both, first in {one} and {other}; give each camera its own photos, or leave one of the "
            "two out."
        )


def _within_cameras(corners: Corners) -> dict[int, str]:
    """Views that are copies of others of their camera, and why they are left out."""
    order = np.argsort(corners.view, kind="stable")
    ends = np.cumsum(np.bincount(corners.view, minlength=len(corners.view_names)))
    pixels = np.split(corners.pixels[order], ends[:-1])
    names = np.array(corners.cameras or ("",) * len(corners.view_names))
    found = dict[int, str]()
    for camera in np.unique(names):
        views = np.flatnonzero(names == camera).tolist()
        reasons = copies([corners.images[v] for v in views], [pixels[v] for v in views])
        found |= {v: reason for v, reason in zip(views, reasons, strict=True) if reason is not None}
    return found


def _without(found: RigCorners, reasons: Mapping[int, str]) -> RigCorners:
    """The corners without some views, which are told with their reasons, and without their photos."""
    corners = found.corners
    if found.cameras:
        cameras, first = list[CameraCorners](), 0
        for item in found.cameras:
            own = range(first, first := first + len(item.found.corners.images))
            cameras.append(_camera_without(item, {v - own.start: reasons[v] for v in own if v in reasons}))
        fresh = corners_of_cameras(cameras, corners.boards is not None, found.times_s)
        return replace(found, corners=fresh.corners, skipped=fresh.skipped, cameras=tuple(cameras))
    stays = [v for v in range(len(corners.images)) if v not in reasons]

    def of_views(values: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return None if values is None else tuple(values[v] for v in stays)

    fewer = replace(
        views_of(corners, np.array(stays), np.isin(corners.view, stays)),
        cameras=of_views(corners.cameras),
        frames=of_views(corners.frames),
        boards=of_views(corners.boards),
        times_s=None if corners.times_s is None else corners.times_s[stays],
    )
    assert corners.cameras is not None and corners.frames is not None
    left_out = (replace(view, camera=corners.cameras[v], frame=corners.frames[v]) for v, view in _left_out(corners, reasons))
    return replace(found, corners=fewer, skipped=(*found.skipped, *left_out))


def _left_out(corners: Corners, reasons: Mapping[int, str]) -> list[tuple[int, ViewResult]]:
    return [(v, ViewResult(corners.view_names[v], corners.images[v], False, reasons[v])) for v in sorted(reasons)]


def _camera_without(item: CameraCorners, reasons: Mapping[int, str]) -> CameraCorners:
    table = item.found.corners
    stays: Int[np.ndarray, " v"] = np.setdiff1d(np.arange(len(table.images)), list(reasons))
    rows = np.isin(table.view, stays)
    left_out = [view for _, view in _left_out(table, reasons)]
    names = {view.image for view in left_out}
    fewer = replace(
        item.found,
        corners=views_of(table, stays, rows),
        skipped=(*item.found.skipped, *left_out),
        blur_px=None if item.found.blur_px is None else item.found.blur_px[rows],
        photos=tuple(photo for photo in item.found.photos if photo.name not in names),
    )
    return replace(item, found=fewer)
