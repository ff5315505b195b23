"""Corners that were found, fitted once more along the edges that a camera sees.

A detection learns how the edges at a corner run from the corners around it. At the end of a board, where a wide lens bends its
edges within a few squares, that is too little: the fit is off by up to a tenth of a pixel while its noise is a hundredth.
A camera knows the bend of every edge. It only says how the edges run; where they cross, the photo does.
"""

from dataclasses import replace

import numpy as np

from calib_patterns._pattern import Detection, Pattern
from calib_patterns.camera_map import camera_map
from calib_patterns.corner_growth import inside_photo, places_at
from calib_patterns.corner_kind import accepted
from calib_patterns.detection import grey_of
from calib_patterns.options import DetectionOptions
from camera_models._model import CameraModel
from camera_models.pose import Pose

MOST_SIGMAS = 1.1
"""A fit that is so many times as uncertain as the one before has more in its window than a corner, of which a narrower window
kept clear."""


def fitted_again(
    image: np.ndarray,
    pattern: Pattern,
    model: CameraModel,
    cam_from_board: Pose,
    found: Detection,
    options: DetectionOptions = DetectionOptions(),
) -> Detection:
    """The same corners, those that the camera sees with their surroundings fitted anew; others stay as they were.

    `image` as in `Pattern.detect`, of `model.image_size`; camera and pose have to be right to some pixels. Corners whose new
    fit is no corner of the board (corner_kind.py), or is the less certain, stay too.
    """
    kind, grey = pattern.corner_kind(options.fit), grey_of(image)
    edges, seen = camera_map(model, cam_from_board, pattern.points_m[found.ids], kind.spacing_m, 0.0)
    if not seen.any():
        return found
    kind, places = kind.at(found.ids[seen]), replace(places_at(edges, seen), pixels=found.pixels[seen])
    blur_px = 1.0 if found.blur_px is None else float(np.clip(np.median(found.blur_px.max(-1)), 0.5, 4.0))
    fit = kind.fit(grey, places, blur_px, options.fit)
    if pattern.plain_grid is not None and np.median(kind.sign * fit.contrast) < 0:
        kind = replace(kind, sign=-kind.sign)
    contrast = float(np.median(np.abs(fit.contrast)))
    taken = accepted(kind, fit, places, contrast, np.inf if found.blur_px is None else blur_px, options)
    taken &= (fit.sigma_px < MOST_SIGMAS * found.sigma_px[seen]) & inside_photo(fit.pixels, grey.shape)
    rows = np.flatnonzero(seen)[taken]
    blurs = None if found.blur_px is None else found.blur_px.copy()
    again = Detection(found.ids, found.pixels.copy(), found.sigma_px.copy(), blurs)
    again.pixels[rows], again.sigma_px[rows] = fit.pixels[taken], fit.sigma_px[taken]
    if blurs is not None:
        blurs[rows] = fit.blur_px[taken]
    return again
