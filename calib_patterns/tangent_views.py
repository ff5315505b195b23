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
from calib_patterns.detection import SEARCH_SIDE_PX, grey_of, stretched
from calib_patterns.guided import corner_kind
from calib_patterns.local_map import KnownCorners
from calib_patterns.saddle_points import lattices, saddle_points
from calib_patterns.tag_board import TagBoard
from camera_models._model import CameraModel
from camera_models.unified import Unified

HALF_ANGLE_RAD = math.radians(75.0)
"""From the middle of a view to its sides."""
SIDE_PX = (480, 800)
"""Views have the photo's resolution, within these limits."""
MOST_PLACES = 2
GATHER_RAD, APART_RAD = math.radians(28.0), math.radians(36.0)
"""Saddle points so near to one are one place with it; other places are so far away at least."""
LEAST_POINTS = 9
"""Saddle points that a place must have, and linked ones that a plain board shows: 3 x 3."""
LEAST_CORNERS = 6
"""Of a detection: fewer are of no use to a calibration."""
MOST_POINTS = 800
"""The strongest saddle points are looked at."""
GRID_PX = 4
UNSEEN = -1e5
"""Pixel coordinates of what the camera does not see: far outside any photo."""
SEED_SIGMA_PX = 0.7
"""Of corners carried back from a view."""


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
        return np.where(valid[..., None], places, UNSEEN)

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


def tangent_view(model: CameraModel, axis: Float[np.ndarray, "3"]) -> TangentView:
    """The view along a unit bearing that the camera sees, its u along the photo's."""
    pixel, _ = model.project(axis[None])
    around, _ = model.unproject(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    by_u, by_v = around[1] - around[0], around[2] - around[0]
    x = by_u - (by_u @ axis) * axis
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    # Pixels per radian where the photo has most of them.
    resolution = 1.0 / np.linalg.svd(np.stack([by_u, by_v]), compute_uv=False)[-1]
    # Stereographic: r = focal tan(theta / 2), focal / 2 pixels per radian in the middle.
    reach = math.tan(0.5 * HALF_ANGLE_RAD)
    side = int(np.clip(4.0 * resolution * reach, *SIDE_PX))
    focal, middle = 0.5 * side / reach, 0.5 * (side - 1)
    camera = Unified([focal, focal, middle, middle, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], (side, side))
    return TangentView(camera, np.stack([x, y, axis], 1), bool(by_v @ y < 0))


def places_of_interest(grey: np.ndarray, model: CameraModel) -> list[Float[np.ndarray, "3"]]:
    """Unit bearings around which a photo has the most and strongest saddle points, at most MOST_PLACES."""
    small = stretched(grey)
    reduction = max(1.0, max(grey.shape) / SEARCH_SIDE_PX)
    if reduction > 1.0:
        small = cv2.resize(small, None, fx=1 / reduction, fy=1 / reduction, interpolation=cv2.INTER_AREA)
    points = saddle_points(small)
    strongest = np.argsort(-points.response)[:MOST_POINTS]
    factors = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
    with torch.no_grad():
        bearings, valid = model.unproject((points.pixels[strongest] + 0.5) * factors - 0.5)
    bearings, response = bearings[valid], points.response[strongest][valid]
    # Corners of a board are among the strongest; the many weak points are texture and noise.
    weight = np.minimum(response / max(response[:LEAST_POINTS].min(initial=np.inf), 1e-12), 1.0)
    places = []
    for _ in range(MOST_PLACES):
        if len(bearings) < LEAST_POINTS:
            break
        near = bearings @ bearings.T > math.cos(GATHER_RAD)
        chosen = near[int((near @ weight).argmax())]
        middle = weight[chosen] @ bearings[chosen]
        middle = middle / np.linalg.norm(middle)
        places.append(middle)
        left = bearings @ middle < math.cos(APART_RAD)
        bearings, weight = bearings[left], weight[left]
    return places


def detect_in_views(image: np.ndarray, pattern: Pattern, model: CameraModel, *, mirrored: bool = False) -> Detection:
    """The corners of a target in a photo of a known camera, found in straightened views; empty where there are none.

    `image` and `mirrored` as in `Pattern.detect`; the photo is of `model.image_size`. Of several views the one with the most
    corners counts, and none is looked at once all are found. Raises InputError for an image that is none.
    """
    check_image(image)
    grey, best = grey_of(image), Detection.empty()
    for view in (tangent_view(model, axis) for axis in places_of_interest(grey, model)):
        shown = view.resampled(grey, model)
        if not _may_show(pattern, shown):
            continue
        found, _ = pattern.detect(shown, mirrored=mirrored != view.reversed)
        if len(found) > len(best):
            there = _fitted_in_photo(grey, pattern, found.ids, view.in_photo(found.pixels, model))
            best = there if len(there) > len(best) else best
        if len(best) == len(pattern.points_m):
            break
    return best if len(best) >= LEAST_CORNERS else Detection.empty()


def _may_show(pattern: Pattern, view: np.ndarray) -> bool:
    """Whether the ordinary detection is worth its time, which is longest where there is no board: a plain board shows squares."""
    return isinstance(pattern, TagBoard) or bool(lattices(saddle_points(stretched(view)), LEAST_POINTS, 1))


def _fitted_in_photo(grey: np.ndarray, pattern: Pattern, ids: np.ndarray, pixels: Float[np.ndarray, "n 2"]) -> Detection:
    """The corners near the given places, and those around them, as the photo itself shows them."""
    kind = corner_kind(pattern)
    seeds = KnownCorners(kind.corners_m[ids], pixels, np.full(len(ids), SEED_SIGMA_PX))
    found = grow_corners(grey, kind, seeds)
    if len(found) or isinstance(pattern, TagBoard):
        return found
    # A plain board may begin with either colour.
    return grow_corners(grey, replace(kind, sign=-kind.sign), seeds)
