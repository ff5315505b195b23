"""A board that the ordinary detection lost, looked for in views in which the camera has straightened the photo.

At the rim of a fisheye or in a mirror a board is bent and squeezed. Once the camera is known, the photo is resampled into a few
stereographic views around the places with the most saddle points. Such a view keeps angles: a board in its middle is nearly
straight, one that fills it is bent mildly, while a perspective view is too narrow for that. What the ordinary detection finds
there is carried back, and every corner is fitted in the photo itself.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float

from calib_patterns._pattern import Detection, Pattern, check_image
from calib_patterns.corner_growth import grow_corners
from calib_patterns.detection import grey_of, stretched
from calib_patterns.local_map import KnownCorners
from calib_patterns.options import DetectionOptions, ViewOptions
from calib_patterns.partial import BLOCK_CORNERS
from calib_patterns.saddle_points import saddle_points
from camera_models._model import CameraModel
from camera_models.unified import Unified

MOST_POINTS = 800
"""The strongest saddle points are looked at."""
GRID_PX = 4
LEAST_CHANGE_RAD = 1e-12
"""Of a bearing for a pixel: a lens of 10^12 pixels of focal length is none."""
UNSEEN = -1e5
"""Pixel coordinates of what the camera does not see: far outside any photo."""


@dataclass(frozen=True)
class TangentView:
    """A view into one direction of a camera."""

    camera: Unified
    camera_from_view: Float[np.ndarray, "3 3"]
    reversed: bool
    """Whether the photo shows the world mirrored where the view shows it as it is, or the other way round."""

    def in_photo(self, pixels: Float[np.ndarray, "*n 2"], model: CameraModel) -> Float[np.ndarray, "*n 2"]:
        """Pixels of the view in the photo, far outside it where the camera sees nothing."""
        with torch.no_grad():
            rays, _ = self.camera.unproject(pixels)
            places, valid = model.project(rays @ self.camera_from_view.T)
        # So far out that the numbers of a map overflow, a place is as good as unseen.
        return np.where(valid[..., None], places.clip(UNSEEN, -UNSEEN), UNSEEN)

    def resampled(self, grey: np.ndarray, model: CameraModel) -> np.ndarray:
        """What the view shows of a photo; the photo's median beyond its border. The map is computed for every GRID_PX-th pixel
        and interpolated, which moves it by hundredths of a pixel."""
        side = self.camera.image_size[0]
        coarse = np.arange(-(-side // GRID_PX) + 1) * float(GRID_PX)
        places = self.in_photo(np.stack(np.meshgrid(coarse, coarse), -1), model)
        pixels = np.arange(side, dtype=np.float32) / GRID_PX
        at_u, at_v = np.meshgrid(pixels, pixels)
        fine = cv2.remap(places.astype(np.float32), at_u, at_v, cv2.INTER_LINEAR)
        # Between a place that is seen and one that is not, the map means nothing.
        seen = cv2.remap((places[..., 0] > UNSEEN).astype(np.float32), at_u, at_v, cv2.INTER_LINEAR)
        fine[seen < 1.0 - 1e-3] = UNSEEN
        beyond = float(np.median(grey[::8, ::8]))
        return cv2.remap(grey, fine[..., 0], fine[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond)


def tangent_view(model: CameraModel, axis: Float[np.ndarray, "3"], options: ViewOptions) -> TangentView | None:
    """The view along a unit bearing that the camera sees, its u along the photo's; None where the bearing stays as the pixel
    moves, or is none."""
    pixel, _ = model.project(axis[None])
    around, _ = model.unproject(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    by_u, by_v = around[1] - around[0], around[2] - around[0]
    x, change = by_u - (by_u @ axis) * axis, np.stack([by_u, by_v])
    slowest = np.linalg.svd(change, compute_uv=False)[-1] if np.isfinite(change).all() else 0.0
    if min(slowest, np.linalg.norm(x)) < LEAST_CHANGE_RAD:
        return None
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    # Pixels per radian where the photo has most of them.
    resolution = 1.0 / slowest
    # Stereographic: r = focal tan(theta / 2), focal / 2 pixels per radian in the middle.
    reach = math.tan(0.5 * math.radians(options.half_angle_deg))
    side = int(np.clip(4.0 * resolution * reach, *options.side_px))
    focal, middle = 0.5 * side / reach, 0.5 * (side - 1)
    camera = Unified([focal, focal, middle, middle, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], (side, side))
    return TangentView(camera, np.stack([x, y, axis], 1), bool(by_v @ y < 0))


def places_of_interest(grey: np.ndarray, model: CameraModel, options: DetectionOptions) -> list[Float[np.ndarray, "3"]]:
    """Unit bearings around which a photo has the most and strongest saddle points, at most `ViewOptions.max_places`."""
    small = stretched(grey)
    reduction = max(1.0, max(grey.shape) / options.search.side_px)
    if reduction > 1.0:
        small = cv2.resize(small, None, fx=1 / reduction, fy=1 / reduction, interpolation=cv2.INTER_AREA)
    points = saddle_points(small, options.saddles)
    strongest = np.argsort(-points.response)[:MOST_POINTS]
    factors = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
    with torch.no_grad():
        bearings, valid = model.unproject((points.pixels[strongest] + 0.5) * factors - 0.5)
    valid &= np.isfinite(bearings).all(-1)
    bearings, response = bearings[valid], points.response[strongest][valid]
    # Corners of a board are among the strongest; the many weak points are texture and noise.
    weight = np.minimum(response / max(response[:BLOCK_CORNERS].min(initial=np.inf), 1e-12), 1.0)
    views = options.views
    gather, apart = math.cos(math.radians(views.gather_deg)), math.cos(math.radians(views.apart_deg))
    places = []
    for _ in range(views.max_places):
        if len(bearings) < BLOCK_CORNERS:
            break
        near = bearings @ bearings.T > gather
        chosen = near[int((near @ weight).argmax())]
        middle = weight[chosen] @ bearings[chosen]
        middle = middle / np.linalg.norm(middle)
        places.append(middle)
        left = bearings @ middle < apart
        bearings, weight = bearings[left], weight[left]
    return places


def detect_in_views(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    *,
    mirrored: bool = False,
    options: DetectionOptions = DetectionOptions(),
) -> Detection:
    """The corners of a target in a photo of a known camera, found in straightened views; empty where there are none.

    `image` and `mirrored` as in `Pattern.detect`; the photo is of `model.image_size`. Of several views the one with the most
    corners counts, and none is looked at once all are found. Raises InputError for an image that is none.
    """
    check_image(image)
    grey, best = grey_of(image), Detection.empty()
    for axis in places_of_interest(grey, model, options):
        view = tangent_view(model, axis, options.views)
        if view is None:
            continue
        shown = view.resampled(grey, model)
        if not pattern.may_be_in(shown, options):
            continue
        found, _ = pattern.detect(shown, mirrored=mirrored != view.reversed, options=options)
        if len(found) > len(best):
            there = _fitted_in_photo(grey, pattern, found.ids, view.in_photo(found.pixels, model), options)
            best = there if len(there) > len(best) else best
        if len(best) == len(pattern.points_m):
            break
    return best if len(best) >= options.min_corners else Detection.empty()


def _fitted_in_photo(
    grey: np.ndarray, pattern: Pattern, ids: np.ndarray, pixels: Float[np.ndarray, "n 2"], options: DetectionOptions
) -> Detection:
    """The corners near the given places, and those around them, as the photo itself shows them."""
    kind = pattern.corner_kind(options.fit)
    seeds = KnownCorners(kind.corners_m[ids], pixels, np.full(len(ids), options.saddles.sigma_px))
    found = grow_corners(grey, kind, seeds, options)
    if len(found) or pattern.plain_grid is None:
        return found
    # A plain board may begin with either colour.
    return grow_corners(grey, replace(kind, sign=-kind.sign), seeds, options)
